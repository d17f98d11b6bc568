"""Setup of a filter run from a record, filtering, and smoothing in chunks of bounded memory."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.signal import sosfilt

from estimators.common.bending import sensed_bending
from estimators.common.block_means import BlockMeans
from estimators.common.model_inputs import MOVING_STD, REST_STD, ModelInputs, rest_state
from estimators.kalman.filter import filter_forward
from estimators.kalman.friction_linearization import RATE_STDS, STD_INFLATION, smoothed_tables
from estimators.kalman.jumps import JUMP_LENGTH, REAR_REACH, empty_jumps
from estimators.kalman.linearization import max_columns
from estimators.kalman.profile_output import (
    HALF_WINDOW,
    VARIANCE_STRIDE,
    ProfileOutput,
    decay_per_node,
    emit,
)
from estimators.kalman.road_process import ARModel, fit_ar_model, prior_covariance
from estimators.kalman.rts_smoother import BackwardState, smooth_backward
from estimators.kalman.state import (
    BIAS,
    MAX_PENDING,
    NODES,
    RETIRED,
    FilterInputs,
    FilterModel,
    FilterState,
    LinearizedBlock,
    empty_blocks,
)
from road_envs.analysis.information_bound import RoadPrior
from road_envs.data.record import F_C, Record, profile_stations, scored_band
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle import body_bending
from road_envs.vehicle.equations import THETA, Z_B, build_plant
from road_envs.vehicle.linear_model import linearise
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import settled_strut_state

NODE_SPACING = 0.05
"""Distance of the road's nodes [m]."""

INCREMENT_LENGTH = 0.5
"""Length [m] of the increments from which roughness is estimated."""

ROUGHNESS_LENGTH = 8.0
"""Length of road [m] over which roughness is averaged."""

NOISE_TIME = 1.2
"""Time constant [s] of the noise scale."""

FORCE_CORRELATION_TIME = 0.005
"""Correlation time [s] of a strut force residual."""

BIAS_STD = 0.05
"""Prior standard deviation [m/s²] of the sensor biases."""

N_MAX_OUTPUT = 5.0
"""Highest spatial frequency [cycles/m] of the output, unless the speed puts 25 Hz below it."""

MAX_WHEELBASES_PER_BLOCK = 0.5
"""Greatest advance of the vehicle in one block, in wheelbases."""

MAX_SPEED = 110.0
"""Speed [m/s] above which the scored band is empty."""

END = 2**62
"""Block number before which every station is due."""

CHUNK_BLOCKS = 10_000
"""Blocks in one chunk of a smoothed drive. A chunk is smoothed by itself and the next chunk only;
long waves, which later measurements still change, would show at the joints of shorter chunks."""


@dataclass(frozen=True, eq=False)
class FilterRun:
    """A drive prepared for the filter: `model`, `inputs` and the current `state`. A station s has
    the node number (s - `origin`) / NODE_SPACING; a block has at most `max_columns` columns.
    """

    model: FilterModel
    inputs: FilterInputs
    state: FilterState
    origin: float
    max_columns: int

    @property
    def n_states(self) -> int:
        """Size n of the state vector."""
        return int(self.state.x.size)

    def empty_blocks(self, count: int) -> LinearizedBlock:
        """Return `count` blocks of zeros, stacked along the first axis of each field."""
        n, n_vehicle = self.n_states, self.model.force_to_state.shape[0]
        n_candidates = self.state.jumps.score.size
        return empty_blocks(n, n_vehicle, self.max_columns, n_candidates, count)

    @property
    def n_blocks(self) -> int:
        """Blocks of measurements."""
        return int(self.inputs.y.shape[1])

    @property
    def node_stations(self) -> np.ndarray:
        """Stations (N,) [m] of all nodes of the drive."""
        return self.origin + NODE_SPACING * np.arange(self.state.jumps.square.shape[0])

    def known_front(self, sensor_latency: float) -> np.ndarray:
        """Return the front axle's station (J,) [m] when a block is known, `sensor_latency` [s]
        after its end.
        """
        h, node = self.model.h, self.inputs.front_node
        t = sensor_latency + h * self.model.steps_per_block * np.arange(1, self.n_blocks + 1)
        return self.origin + NODE_SPACING * np.interp(t, 0.5 * h * np.arange(node.size), node)


def setup_run(
    record: Record,
    car: VehicleParameters,
    instruments: Instruments,
    model_inputs: ModelInputs,
    measurements: BlockMeans,
    *,
    noise_variance: float,
    prior: RoadPrior,
    level_ends: bool,
    lag: float,
) -> FilterRun:
    """Return the run of a record before its first block.

    `noise_variance` [(m/s²)²] of a sample; stations are emitted up to `lag` [m] behind the front
    axle; with `level_ends` the road is level before station 0 and after its end. Raises ValueError
    if the odometer jumps.
    """
    steps_per_block = measurements.sample_weight.shape[2] * model_inputs.decimation
    s, half_steps = model_inputs.s, 2 * steps_per_block
    moved = float(np.max(s[half_steps:] - s[:-half_steps]))
    if moved > (most := MAX_WHEELBASES_PER_BLOCK * car.wheelbase):
        raise ValueError(
            f"the odometer jumps by {moved:.2f} m within {steps_per_block * model_inputs.h:.3g} s; "
            f"at most {most:.2f} m are allowed: cut the record at the jump or correct s"
        )
    in_block = moved / NODE_SPACING
    reach = max(lag, car.wheelbase) + HALF_WINDOW
    K = int(np.ceil(reach / NODE_SPACING) + np.ceil(in_block)) + 8
    origin = float(s[0]) - K * NODE_SPACING
    ends = np.array([0.0, record.length]) if level_ends else np.array([-np.inf, np.inf])
    inputs = FilterInputs(
        (s - origin) / NODE_SPACING,
        model_inputs.v / NODE_SPACING,
        model_inputs.commands,
        measurements.y,
        measurements.sample_count,
        measurements.censored_blocks,
        (ends - origin) / NODE_SPACING,
    )
    road = fit_ar_model(prior, NODE_SPACING)
    model = _build_model(car, instruments, model_inputs, steps_per_block, noise_variance, road, K)
    level = level_ends and record.s[0] <= 0.0
    newest_node = int(inputs.front_node[0]) + 2
    state = _initial_state(car, model_inputs, model, road, inputs, newest_node, level)
    columns = max_columns(model.force_to_state.shape[0], in_block)
    return FilterRun(model, inputs, state, origin, columns)


def _build_model(
    car: VehicleParameters,
    instruments: Instruments,
    model_inputs: ModelInputs,
    steps_per_block: int,
    noise_variance: float,
    road: ARModel,
    n_nodes: int,
) -> FilterModel:
    one, locations = build_plant(car), instruments.locations(car)
    line, bending = linearise(one, "ride", locations), sensed_bending(car, locations)
    # a constant force over so short a time as a block moves the vehicle like free masses
    accel = (line.strut_rows / line.M).T
    time = steps_per_block * model_inputs.h
    force_to_state = [0.5 * time**2 * accel, time * accel]
    force_to_sensor = line.sensor_rows @ accel
    section = np.zeros((0, 6))
    if bending is not None:
        section = body_bending.section(bending.mode, model_inputs.h * model_inputs.decimation)
        samples = steps_per_block // model_inputs.decimation
        push = np.repeat((bending.force @ accel[[Z_B, THETA]])[:, None], samples, axis=1)
        bent, end = sosfilt(section, push, zi=np.zeros((1, 4, 2)))
        force_to_state.append(end[0].T)
        force_to_sensor = force_to_sensor + np.outer(bending.shape, bent.mean(axis=1))
    tables, force_variance = smoothed_tables(one.velocity)
    increment_span = round(INCREMENT_LENGTH / NODE_SPACING)
    return FilterModel(
        constants=one.constants.copy(),
        velocity=tables,
        displacement=one.displacement,
        first_table=one.constants["velocity_table"][0].copy(),
        rate_stds=RATE_STDS / STD_INFLATION,
        force_variance=force_variance * FORCE_CORRELATION_TIME / (steps_per_block * model_inputs.h),
        strut_rows=line.strut_rows,
        sensor_rows=line.sensor_rows,
        force_to_state=np.concatenate(force_to_state),
        force_to_sensor=force_to_sensor,
        n_nodes=n_nodes,
        ar_weights=road.weights,
        prediction_variance=road.prediction_variance,
        increment_variance=road.increment_variance(increment_span),
        increment_span=increment_span,
        roughness_memory=ROUGHNESS_LENGTH / NODE_SPACING,
        jump_reach=round(REAR_REACH / NODE_SPACING),
        h=model_inputs.h,
        steps_per_block=steps_per_block,
        decimation=model_inputs.decimation,
        valve_lag=car.valve.lag,
        bending_force=np.zeros(2) if bending is None else bending.force,
        bending_shape=np.zeros(3) if bending is None else bending.shape,
        bending_section=section.ravel(),
        flexible=True if one.flexible else None,
        wheelbase_nodes=car.wheelbase / NODE_SPACING,
        decay=decay_per_node(NODE_SPACING),
        noise_variance=noise_variance,
        noise_time=NOISE_TIME / (steps_per_block * model_inputs.h),
    )


def _initial_state(
    car: VehicleParameters,
    model_inputs: ModelInputs,
    model: FilterModel,
    road: ARModel,
    inputs: FilterInputs,
    newest_node: int,
    level: bool,
) -> FilterState:
    K, (n_vehicle, _) = model.n_nodes, model.force_to_state.shape
    n, blocks = NODES + 2 * K + n_vehicle, inputs.y.shape[1]
    x, P, motion = np.zeros(n), np.zeros((n, n)), rest_state(car, model_inputs)
    # exactly at rest the friction law has a kink and no tangent
    x[n - n_vehicle :][: motion.size] = motion + 1e-7
    typical = (REST_STD if level else MOVING_STD)[[0, -1]]
    std = np.concatenate(
        [np.repeat(typical, motion.size // 2), np.full(n_vehicle - motion.size, typical[1])]
    )
    P[n - n_vehicle :, n - n_vehicle :] = np.diag(std**2)
    P[BIAS:RETIRED, BIAS:RETIRED] = np.diag(np.full(3, BIAS_STD**2))
    if not level:
        nodes = slice(NODES, NODES + 2 * K)
        P[nodes, nodes] = prior_covariance(road, K, newest_node + 1 - K)
    strut_state = settled_strut_state(int(model_inputs.commands[0]))
    weight = ROUGHNESS_LENGTH / NODE_SPACING  # that of a stationary average
    adaptive = np.array([1.0, weight, weight, 1.0, 0.0])
    pending, newest = np.zeros((MAX_PENDING, n)), np.array([newest_node])
    n_pending = np.zeros(1, dtype=np.int64)
    last = max(newest_node, int(np.max(inputs.front_node)) + 3)
    jumps = empty_jumps(n, round(JUMP_LENGTH / NODE_SPACING), last + 1)
    return FilterState(
        x, P, pending, n_pending, strut_state, newest, adaptive, np.ones(blocks), jumps
    )


def setup_output(
    run: FilterRun, record: Record, lag: float, sensor_latency: float, detrended: bool
) -> ProfileOutput:
    """Return the stations of a record, with the block before which each is emitted: once the front
    axle is `lag` [m] past the station and another `sensor_latency` [s] has been recorded.
    """
    s = profile_stations(record.length)
    node = (s - run.origin) / NODE_SPACING
    v = np.interp(s, record.s, record.v)
    if lag > HALF_WINDOW:
        high = np.array([scored_band(x)[1] for x in np.clip(v, 0.1, MAX_SPEED)])
        fine = np.minimum(N_MAX_OUTPUT, F_C / np.maximum(v, 0.1))
        cutoff = NODE_SPACING * np.stack([fine, high], axis=1)
    else:  # the kernel would need road ahead that no wheel has passed: no low-pass
        cutoff = np.full((s.size, 2), 0.5)
    none = np.zeros((0, 2, run.n_states))
    return ProfileOutput(
        node=node,
        emit_block=np.searchsorted(run.known_front(sensor_latency), s + lag),
        cutoff=cutoff,
        half_window=HALF_WINDOW / NODE_SPACING,
        detrended=detrended,
        both_axles=lag >= NODE_SPACING * run.model.wheelbase_nodes - 1e-9,
        z=np.zeros((s.size, 2)),
        variance=np.zeros((s.size, 2)),
        share=np.ones(s.size),
        next_station=np.zeros(1, dtype=np.int64),
        height_covariance=none,
        band_covariance=none,
    )


def run_filter(run: FilterRun, output: ProfileOutput) -> None:
    """Filter a drive to its end and emit all stations."""
    one = run.empty_blocks(1)
    filter_forward(run.model, run.inputs, run.state, 0, run.n_blocks, output, one)
    emit(run.model, run.state, output, END)


def run_smoother(run: FilterRun, output: ProfileOutput, chunk_blocks: int = CHUNK_BLOCKS) -> None:
    """Filter and smooth a drive chunk by chunk, each with the measurements of the next one."""
    edges = [*range(0, run.n_blocks, chunk_blocks), run.n_blocks]
    if len(edges) > 2 and edges[-1] - edges[-2] < chunk_blocks // 2:
        del edges[-2]  # a short last chunk joins the one before it
    before: Chunk | None = None
    for first, last in pairwise(edges):
        chunk = _filter_chunk(run, output, first, last)
        if before is not None:
            _smooth_chunks(run, [before, chunk], last == run.n_blocks)
            _store_chunk(output, before)
        before = chunk
    if before is not None:
        if len(edges) == 2:
            _smooth_chunks(run, [before], True)
        _store_chunk(output, before)


@dataclass(frozen=True, eq=False)
class Chunk:
    """Blocks `first` to `last` (excluded), the stations emitted in them, from `first_station` on,
    and the number of the newest node after them.
    """

    first: int
    last: int
    first_station: int
    newest_node: int
    output: ProfileOutput
    blocks: LinearizedBlock


def _filter_chunk(run: FilterRun, output: ProfileOutput, first: int, last: int) -> Chunk:
    """Filter one chunk and store what the smoother needs."""
    n, first_station = run.n_states, int(output.next_station[0])
    end = int(np.searchsorted(output.emit_block, last)) if last < run.n_blocks else output.node.size
    here, count = slice(first_station, end), end - first_station
    own = ProfileOutput(
        node=output.node[here],
        emit_block=np.minimum(output.emit_block[here], last),
        cutoff=output.cutoff[here],
        half_window=output.half_window,
        detrended=output.detrended,
        both_axles=output.both_axles,
        z=np.zeros((count, 2)),
        variance=np.zeros((count, 2)),
        share=np.ones(count),
        next_station=np.zeros(1, dtype=np.int64),
        height_covariance=np.zeros((count, 2, n)),
        band_covariance=np.zeros((count // VARIANCE_STRIDE + 1, 2, n)),
    )
    blocks = run.empty_blocks(last - first)
    filter_forward(run.model, run.inputs, run.state, first, last, own, blocks)
    if last == run.n_blocks:
        emit(run.model, run.state, own, END)
    output.next_station[0] = end
    return Chunk(first, last, first_station, int(run.state.newest_node[0]), own, blocks)


def _smooth_chunks(run: FilterRun, chunks: list[Chunk], at_end: bool) -> None:
    """Run the smoother back over `chunks` and correct the stations of the first one; those of the
    last one too where the drive is `at_end`.
    """
    n, last = run.n_states, chunks[-1]
    adjoint = BackwardState(
        np.zeros(n), np.zeros((n, n)), np.array([last.newest_node]), np.zeros(1, dtype=np.int64)
    )
    for chunk in reversed(chunks):
        output, (first, end) = chunk.output, (chunk.first, chunk.last)
        correct = at_end or chunk is not last
        adjoint.next_station[0] = int(np.searchsorted(output.emit_block, end)) if correct else 0
        smooth_backward(run.model, run.inputs, adjoint, first, end, output, chunk.blocks)


def _store_chunk(output: ProfileOutput, chunk: Chunk) -> None:
    here = slice(chunk.first_station, chunk.first_station + chunk.output.node.size)
    output.z[here], output.variance[here] = chunk.output.z, chunk.output.variance
    output.share[here] = chunk.output.share
