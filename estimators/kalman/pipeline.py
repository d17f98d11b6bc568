"""Course of an estimate: setup of the run from a record, then the filter (`forward.py`) over all
windows or, in chunks of bounded memory, filter and smoother (`smoother.py`).
"""

from dataclasses import replace

import numpy as np
from scipy.signal import sosfilt

from estimators.common.bending import sensed_bending
from estimators.common.block_means import BlockMeans
from estimators.common.model_inputs import MOVING_STD, REST_STD, ModelInputs, rest_state
from estimators.kalman.filtered import FilteredWindow, FilterRun, FilterState, UnknownState
from estimators.kalman.forward import WindowFilter
from estimators.kalman.friction_linearization import smoothed_tables
from estimators.kalman.jumps import RoadJumps
from estimators.kalman.profile_output import ProfileOutput, fill_weights
from estimators.kalman.road_process import ARModel, RoadProcess
from estimators.kalman.smoother import smooth_backward
from estimators.kalman.state import N_BIAS, ROUGHNESS_SCALE, FilterInputs, FilterModel
from estimators.kalman.tuning import TUNING
from estimators.kalman.windows import WindowSchedule
from estimators.preprocessing import SPEED_MIN
from road_envs.analysis.information_bound import RoadPrior
from road_envs.records.record import F_C, Record, profile_stations, scored_band
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle import body_bending
from road_envs.vehicle.equations import THETA, Z_B, build_plant
from road_envs.vehicle.linear_model import linearise
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import settled_strut_state


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
    """Return the run of a record before its first block, for stations that are emitted when the
    front axle is `lag` [m] past them. `noise_variance` [(m/s²)²] of a sample; with `level_ends`
    the road is level before station 0 and after its end. Raises ValueError if the odometer jumps.
    """
    steps_per_block = measurements.sample_weight.shape[2] * model_inputs.decimation
    s, half_steps = model_inputs.s, 2 * steps_per_block
    moved = float(np.max(s[half_steps:] - s[:-half_steps]))
    if moved > (most := TUNING.max_wheelbases_per_block * car.wheelbase):
        raise ValueError(
            f"the odometer jumps by {moved:.2f} m within {steps_per_block * model_inputs.h:.3g} s; "
            f"at most {most:.2f} m are allowed: cut the record at the jump or correct s"
        )
    behind = car.wheelbase + TUNING.initial_length
    ds = TUNING.node_spacing
    origin = float(s[0]) - ds * np.ceil(behind / ds)  # a node at the start
    ends = np.array([0.0, record.length]) if level_ends else np.array([-np.inf, np.inf])
    means = measurements.y, measurements.sample_count, measurements.censored_blocks
    inputs = FilterInputs((s - origin) / ds, model_inputs.v / ds, model_inputs.commands, *means)
    model = _build_model(car, instruments, model_inputs, steps_per_block, noise_variance)
    ar_model = ARModel.fit(prior)
    increment_span = round(TUNING.increment_length / ds)
    windows = WindowSchedule.divide(
        inputs.front_node,
        steps_per_block,
        model.wheelbase_nodes,
        TUNING.window_length / ds,
        max(increment_span, ar_model.weights.shape[1] - int(model.wheelbase_nodes)),
        int((lag + TUNING.half_window) / ds) + 3,
    )
    road = RoadProcess(
        n_vehicle=model.force_effect.shape[1] - 3,
        n_nodes=windows.n_nodes,
        weights=ar_model.weights,
        prediction_variance=ar_model.prediction_variance,
        free_range=(ends - origin) / ds,
        increment_span=increment_span,
        increment_variance=ar_model.increment_variance(increment_span),
        roughness_memory=TUNING.roughness_length / ds,
    )
    jumps = RoadJumps.none(TUNING.window_length, int(windows.newest[-1]) + 1, ds)
    motion, blocks = rest_state(car, model_inputs), measurements.y.shape[1]
    entries = [motion.size // 2, road.n_vehicle - motion.size // 2]
    biases = np.full(N_BIAS, TUNING.bias_std)
    moving, at_rest = (
        np.append(np.repeat(std[[0, -1]], entries), biases) for std in (MOVING_STD, REST_STD)
    )
    vehicle = np.pad(motion, (0, road.n_vehicle - motion.size))
    unknown = UnknownState(vehicle, moving, ar_model.node_covariance(road.n_nodes))
    level_start = replace(unknown, std=at_rest, nodes=np.zeros_like(unknown.nodes))
    weight = TUNING.roughness_length / ds  # that of a stationary average
    start = level_start if level_ends and record.s[0] <= 0.0 else unknown
    P = start.covariance(road, windows.initial, 1.0)
    state = FilterState(
        x=np.pad(vehicle, (0, road.n_states - vehicle.size)),
        P=np.pad(P, ((0, 0), (0, jumps.score.size))),
        strut_state=settled_strut_state(int(model_inputs.commands[0])),
        adaptive=np.array([1.0, weight, weight, 1.0, 0.0]),
        jumps=jumps,
        unknown=unknown,
        nis=np.ones(blocks),
        noise_scale=np.ones(blocks),
        signal_power=np.zeros(blocks),
    )
    return FilterRun(model, inputs, road, windows, state, origin, lag)


def _build_model(
    car: VehicleParameters,
    instruments: Instruments,
    model_inputs: ModelInputs,
    steps_per_block: int,
    noise_variance: float,
) -> FilterModel:
    """Return a run's constants; `noise_variance` [(m/s²)²] of a sample."""
    one, locations = build_plant(car), instruments.locations(car)
    line, bending = linearise(one, "ride", locations), sensed_bending(car, locations)
    # a constant force over so short a time as a block moves the vehicle like free masses
    inverse = line.inverse_inertia
    accel = (line.strut_rows / line.M).T if inverse is None else inverse @ line.strut_rows.T
    time = steps_per_block * model_inputs.h
    force_effect = [line.sensor_rows @ accel, 0.5 * time**2 * accel, time * accel]
    section = np.zeros((0, 6))
    if bending is not None:
        section = body_bending.section(bending.mode, model_inputs.h * model_inputs.decimation)
        samples = steps_per_block // model_inputs.decimation
        push = np.repeat((bending.force @ accel[[Z_B, THETA]])[:, None], samples, axis=1)
        bent, end = sosfilt(section, push, zi=np.zeros((1, 4, 2)))
        force_effect.append(end[0].T)
        force_effect[0] = force_effect[0] + np.outer(bending.shape, bent.mean(axis=1))
    tables, force_variance = smoothed_tables(one.velocity)
    return FilterModel(
        constants=one.constants.copy(),
        velocity=tables,
        displacement=one.displacement,
        first_table=one.constants["velocity_table"][0].copy(),
        force_variance=force_variance * TUNING.force_correlation_time / time,
        strut_rows=line.strut_rows,
        sensor_rows=line.sensor_rows,
        force_effect=np.concatenate(force_effect).T.copy(),
        h=model_inputs.h,
        steps_per_block=steps_per_block,
        decimation=model_inputs.decimation,
        valve_lag=car.valve.lag,
        bending_force=np.zeros(2) if bending is None else bending.force,
        bending_shape=np.zeros(3) if bending is None else bending.shape,
        bending_section=section.ravel(),
        flexible=True if one.flexible else None,
        side=True if one.sideways else None,
        wheelbase_nodes=car.wheelbase / TUNING.node_spacing,
        noise_variance=noise_variance,
        noise_time=TUNING.noise_time / time,
    )


def setup_output(
    run: FilterRun, record: Record, sensor_latency: float, detrended: bool
) -> ProfileOutput:
    """Return the stations of a record, with the block before which each is emitted: once the front
    axle is the run's lag past the station and another `sensor_latency` [s] has been recorded. Where
    the rear axle has passed it then, it is emitted at the last edge of a window before that.
    """
    s, lag = profile_stations(record.length), run.lag
    node = (s - run.origin) / TUNING.node_spacing
    v = np.interp(s, record.s, record.v)
    if lag > TUNING.half_window:
        high = np.array([scored_band(x)[1] for x in np.clip(v, 0.1, TUNING.max_speed)])
        fine = np.minimum(TUNING.n_max_output, F_C / np.maximum(v, 0.1))
        cutoff = TUNING.node_spacing * np.stack([fine, high])
    else:  # the kernel would need road ahead that no wheel has passed: no low-pass
        cutoff = np.full((2, s.size), 0.5)
    both_axles = lag >= TUNING.node_spacing * run.model.wheelbase_nodes - 1e-9
    block = np.searchsorted(run.known_front(sensor_latency), s + lag)
    return ProfileOutput(
        node=node,
        emit_block=run.windows.last_edge(block) if both_axles else block,
        cutoff=cutoff,
        detrended=detrended,
        both_axles=both_axles,
        z=np.zeros((s.size, 2)),
        variance=np.zeros((s.size, 2)),
    )


def output_std(
    run: FilterRun, output: ProfileOutput, record: Record, prior: RoadPrior
) -> np.ndarray:
    """Return in-band standard deviations (2, M) [m]; the prior's where no wheel has been."""
    n = np.linspace(*scored_band(float(np.clip(record.v.mean(), SPEED_MIN, 100.0))), 400)
    s, variance = profile_stations(record.length), np.maximum(output.variance.T, 0.0)
    # before the record nothing was known of the roughness but the prior
    scale = np.where(s < record.s[0], 1.0, run.state.adaptive[ROUGHNESS_SCALE])
    prior_variance = scale * np.trapezoid(prior.density(n), n)
    unseen = (s < record.s[0]) | (s > record.s[-1])
    return np.sqrt(np.where(unseen, np.maximum(variance, prior_variance), variance))


def run_filter(run: FilterRun, output: ProfileOutput) -> None:
    """Filter a drive and emit each station with what was measured until then."""
    one = WindowFilter(run, output)
    for i in range(run.windows.newest.size):
        one.filter_window(i)
    one.finish()


def run_smoother(run: FilterRun, output: ProfileOutput, chunk: int = TUNING.chunk_windows) -> None:
    """Filter and smooth a drive, `chunk` windows with the measurements of the next ones at once."""
    windows, kept = run.windows, list[FilteredWindow]()
    count, oldest, newest = windows.newest.size, windows.oldest, int(windows.newest[-1])
    one, c = WindowFilter(run, output, smoothing=True), np.zeros((newest - oldest[0] + 1, 2))
    for i in range(count):
        kept += one.filter_window(i)
        if len(kept) >= 2 * chunk or i == count - 1:
            corrected = count if i == count - 1 else kept[chunk].index
            smooth_backward(run.road, kept, oldest, c, output.variance, corrected)
            kept = [window for window in kept if window.index >= corrected]
    one.finish()
    held = np.arange(oldest[-1], newest + 1)
    c[held - oldest[0]] = run.state.x[run.road.node_entries(held)].reshape(-1, 2)
    # of a station, the nodes in the low-pass
    reach = int(TUNING.half_window / TUNING.node_spacing) + 3
    size = min(2 * reach, len(c))
    base = np.clip(output.node.astype(int) - oldest[0] - reach, 0, len(c) - size)
    at = np.clip(output.node - oldest[0] - base, 0.0, size - 1.0)
    weights = np.empty((at.size, 2 + size))
    fill_weights(at, 0.0, output.cutoff[0], weights)
    near = c[base[:, None] + np.arange(size)]
    mean, difference = np.einsum("mk,mkc->cm", weights[:, 2:], near)
    output.z[:] = np.stack([mean + difference, mean - difference], axis=1)
