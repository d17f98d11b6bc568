"""Estimation of drives of any length, window by window.

A window begins in the vehicle states and on the road that the previous window found an `overlap`
before its own end, where later measurements hardly change them any more; both are kept fixed. The
roads of the windows therefore join in height and slope, the vehicles' motions are continuous, and
memory is that of one window. The windows of several passes begin and end at the same stations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import next_fast_len, rfftfreq

from estimators.common.block_means import block_means
from estimators.common.model_inputs import ModelInputs
from estimators.common.road_prior import increment_amplitude
from estimators.common.spline import evaluate_spline
from estimators.map_smoother.objective import Objective, shift_inputs
from estimators.map_smoother.one_pass import MeasurementModel, Pass
from estimators.map_smoother.posterior_sampling import RoadPosterior
from estimators.map_smoother.road_prior import RoadNodes, RoadTransform
from estimators.map_smoother.tuning import TUNING
from road_envs.analysis.information_bound import RoadPrior
from road_envs.vehicle.parameters import VehicleParameters

Window = tuple[int, int, int]
"""Begin, begin of the next one, and end of a window, in blocks."""


@dataclass(frozen=True, eq=False)
class PreparedDrive:
    """A drive of the vehicle `car`, prepared for estimation: `model` of vehicle and instruments,
    and its `inputs`; samples `a` (S, T) [m/s²], of which `valid` (S, T) are used, and `censored` as
    in `block_means`, in blocks of `block_size`. Where the next window begins, `vehicle_state` (14,)
    with the prior standard deviation `initial_std` (14,) about it, `strut_state` (4, 3), and
    `filter_state` (n, S, 2) of the anti-alias filter, empty if it only delays. `nodes` of the road,
    and the stations `free_span` [m] between which it may rise or fall.
    """

    car: VehicleParameters
    model: MeasurementModel
    inputs: ModelInputs
    a: np.ndarray
    valid: np.ndarray
    censored: np.ndarray
    block_size: int
    vehicle_state: np.ndarray
    initial_std: np.ndarray
    strut_state: np.ndarray
    filter_state: np.ndarray
    nodes: RoadNodes
    free_span: tuple[float, float]

    @property
    def free(self) -> np.ndarray:
        """Which nodes (K,) may rise or fall against the one before: 1, others 0."""
        middle = self.nodes.origin + self.nodes.ds * (np.arange(self.nodes.size) - 0.5)
        return ((middle > self.free_span[0]) & (middle < self.free_span[1])).astype(float)

    @property
    def steps_per_block(self) -> int:
        return self.block_size * self.inputs.decimation

    @property
    def blocks(self) -> int:
        """Number of block means of each sensor."""
        return self.a.shape[1] // self.block_size

    @property
    def block_stations(self) -> np.ndarray:
        """Stations [m] at which the blocks begin."""
        return self.inputs.s[:: 2 * self.steps_per_block][: self.blocks]

    def node_at(self, s: float) -> int:
        """The node at the station `s` [m] or just before it."""
        return int((s - self.nodes.origin) / self.nodes.ds)

    def nodes_under(self, begin: int, end: int) -> tuple[int, int]:
        """Return the first and the last node that carries a wheel in blocks `begin` to `end`."""
        s = self.inputs.s
        first, last = (2 * self.steps_per_block * block for block in (begin, end))
        return self.node_at(s[first] - self.model.wheelbase), self.node_at(s[last - 1])


@dataclass(frozen=True, eq=False)
class RoadSoFar:
    """Road of the windows so far, at K nodes: coefficients `c` (2, K) [m], final before the node
    `first_free_node` and level from there on; standard deviation `std` (2, K) [m] of their error in
    the band; samples `deviations` (D, 2, K) [m] of the error in all waves; `density` of the road
    over that of the prior at the frequencies `n` [cycles/m].
    """

    c: np.ndarray
    std: np.ndarray
    deviations: np.ndarray
    first_free_node: int
    n: np.ndarray
    density: np.ndarray

    @classmethod
    def level(cls, size: int) -> "RoadSoFar":
        """A level road of `size` nodes, without samples: the road before the first window."""
        nothing = np.zeros((2, size))
        return cls(nothing, nothing, np.zeros((0, 2, size)), 0, np.array([0.0, 1.0]), np.ones(2))

    def at_stations(
        self, nodes: RoadNodes, s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return heights and standard deviations (2, M) [m] at the stations `s` (M,) [m], and
        samples (D, 2, M) [m] of the road.
        """
        x = np.clip((s - nodes.origin) / nodes.ds, 1.0, nodes.size - 3.0)
        std = np.array([np.interp(x, np.arange(nodes.size), path) for path in self.std])
        draws = np.empty((len(self.deviations), 2, s.size), dtype=np.float32)
        for k, deviation in enumerate(self.deviations):
            draws[k] = evaluate_spline(self.c + deviation, x)
        return evaluate_spline(self.c, x), std, draws


def on_common_nodes(drives: Sequence[PreparedDrive]) -> list[PreparedDrive]:
    """Return the drives on the finest nodes that any of them needs; the road is level where it is
    so for all of them, if they begin at the same place.
    """
    if len(drives) == 1:
        return list(drives)
    grids = [drive.nodes for drive in drives]
    ds, origin = min(grid.ds for grid in grids), min(grid.origin for grid in grids)
    last = max(grid.origin + grid.ds * grid.size for grid in grids)
    nodes = RoadNodes(origin, ds, int((last - origin) / ds) + 1)
    together = np.ptp([drive.inputs.s[0] for drive in drives]) <= TUNING.max_late_start
    begins, ends = zip(*(drive.free_span for drive in drives), strict=True)
    span = (min(begins) if together else -np.inf), max(ends)
    return [replace(drive, nodes=nodes, free_span=span) for drive in drives]


def common_windows(
    drives: Sequence[PreparedDrive], window: float, overlap: float
) -> list[tuple[Window, ...]]:
    """Return the windows of each drive: of the one that takes longest even ones, of `window` and
    `overlap` [s], and of the others those that begin and end at the same stations.
    """
    longest = max(drives, key=lambda one: one.blocks * one.block_size)
    starts, blocks = longest.block_stations, longest.blocks
    rate = 1.0 / (longest.steps_per_block * longest.inputs.h)
    length, common = round(window * rate), round(overlap * rate)
    begins = [0]
    while blocks - begins[-1] > length + common:
        begins.append(begins[-1] + length - common)
    ends = [*(begin + length for begin in begins[:-1]), blocks]

    def at(one: PreparedDrive, block: int) -> int:
        if one is longest or block == 0:
            return block
        if block >= starts.size:
            return one.blocks
        return int(np.searchsorted(one.block_stations, starts[block]))

    return [
        tuple((at(one, begin), at(one, after), at(one, end)) for one in drives)
        for begin, after, end in zip(begins, [*begins[1:], blocks], ends, strict=True)
    ]


def reconstruct(
    drives: Sequence[PreparedDrive],
    prior: RoadPrior,
    windows: Sequence[tuple[Window, ...]],
    solve: Callable[[Objective, list[int]], RoadPosterior],
) -> RoadSoFar:
    """Return the road of all windows; `solve` gets each objective and the numbers of its passes."""
    drives = list(drives)
    road = RoadSoFar.level(drives[0].nodes.size)
    for spans in windows:
        members = [k for k, (begin, _, end) in enumerate(spans) if end - begin >= TUNING.min_blocks]
        members = members or list(range(len(drives)))
        parts = [(drives[k], spans[k][0], spans[k][2]) for k in members]
        objective = _window_objective(parts, prior, road)
        posterior = solve(objective, members)
        lin = posterior.solution.linearization
        _, own, shifts = lin.objective.split(lin.x)
        c, ends = lin.objective.coefficients(lin.x), list[int]()
        for k, one, values, shift in zip(members, lin.passes, own, shifts, strict=True):
            drive, (begin, after, end) = drives[k], spans[k]
            moved = shift_inputs(drive.inputs, objective.knots, shift)
            drives[k] = drive = replace(drive, inputs=moved)
            if after < end:
                steps = (after - begin) * drive.steps_per_block
                state, strut_state, filter_state = one.source.state_after(c, values, steps)
                drives[k] = replace(
                    drive,
                    vehicle_state=state,
                    initial_std=np.zeros_like(state),
                    strut_state=strut_state,
                    filter_state=filter_state,
                )
                # up to the nodes that carry the front axle now
                ends.append(drive.node_at(one.source.inputs.s[2 * steps]) + 3)
        last = max(ends, default=drives[0].nodes.size)
        road = _extended(road, posterior, drives[0].nodes, last)
    return road


def _extended(so_far: RoadSoFar, posterior: RoadPosterior, grid: RoadNodes, last: int) -> RoadSoFar:
    lin = posterior.solution.linearization
    road, c = lin.objective.road, lin.objective.coefficients(lin.x)
    low = round((road.origin - grid.origin) / grid.ds)
    first, last = max(so_far.first_free_node, low), min(last, low + road.size, grid.size)
    here = slice(first - low, last - low)

    def joined(before: np.ndarray, now: np.ndarray) -> np.ndarray:
        whole = before.copy()
        whole[..., first:last] = now[..., here]
        whole[..., last:] = whole[..., last - 1 : last]
        return whole

    # a sample goes on at the height at which it ended
    count = len(posterior.deviations)
    before = so_far.deviations if len(so_far.deviations) else np.zeros((count, 2, grid.size))
    end = before[..., max(first - 1, 0), None]
    deviations = joined(before, end + posterior.deviations)
    density = road.density * np.mean(road.local[:, road.free > 0] ** 2)
    so_far_std = joined(so_far.std, posterior.std)
    return RoadSoFar(joined(so_far.c, c), so_far_std, deviations, last, road.n, density)


def _window_objective(
    parts: Sequence[tuple[PreparedDrive, int, int]], prior: RoadPrior, so_far: RoadSoFar
) -> Objective:
    reach = [drive.nodes_under(begin, end) for drive, begin, end in parts]
    low = min(first for first, _ in reach) - TUNING.node_margin
    last = max(last for _, last in reach) + TUNING.node_margin
    # spare nodes, as the spectrum of the increments is periodic
    size = int(next_fast_len(last + 1 - low + 64, real=True))
    drive = parts[0][0]
    c, free = so_far.c[:, low : low + size], drive.free[low : low + size].copy()
    free[: max(so_far.first_free_node - low, 0)] = 0.0
    missing = size - free.size
    c, free = np.pad(c, ((0, 0), (0, missing)), mode="edge"), np.pad(free, (0, missing))
    origin, ds = drive.nodes.origin + drive.nodes.ds * low, drive.nodes.ds
    amplitude = increment_amplitude(prior, size, ds, flat_below=TUNING.n_flat)
    density = np.interp(rfftfreq(size, ds), so_far.n, so_far.density)
    road = RoadTransform(origin, ds, c, free, amplitude, density, np.ones_like(c))
    nodes = RoadNodes(origin, ds, size)
    passes = tuple(_window_pass(*part, nodes) for part in parts)
    if len(parts) == 1:
        return Objective(road, passes)
    count = 1 + max(1, round(ds * size / TUNING.knot_spacing))
    return Objective(road, passes, origin + np.linspace(0.0, ds * size, count))


def _window_pass(drive: PreparedDrive, begin: int, end: int, nodes: RoadNodes) -> Pass:
    inputs = drive.inputs.slice_steps(begin * drive.steps_per_block, end * drive.steps_per_block)
    samples = slice(begin * drive.block_size, end * drive.block_size)
    a, valid, censored = (x[:, samples] for x in (drive.a, drive.valid, drive.censored))
    if inputs.offset is not None:  # samples beyond the first or last step are not predicted
        at = inputs.sample_steps(a.shape[1])
        valid = valid & (at > -1.0) & (at < inputs.n_steps)
    bridged = np.isfinite(drive.model.bandwidth)
    measurements = block_means(a, valid, drive.block_size, censored, bridged)
    return Pass(
        drive.model, drive.strut_state, drive.vehicle_state, drive.initial_std, nodes, inputs,
        measurements, drive.filter_state,
    )  # fmt: skip


def whole_objective(drive: PreparedDrive, prior: RoadPrior, blocks: int | None = None) -> Objective:
    """Return the objective of a drive, or of its first `blocks`, as one window."""
    part = drive, 0, blocks or drive.blocks
    return _window_objective([part], prior, RoadSoFar.level(drive.nodes.size))
