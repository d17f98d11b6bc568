"""Estimation of a drive of any length, window by window.

A window begins in the vehicle state and on the road that the previous window found an `overlap`
before its own end, where later measurements hardly change them any more; both are kept fixed. The
roads of the windows therefore join in height and slope, the vehicle's motion is continuous, and
memory is that of one window.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimators.common.block_means import block_means
from estimators.common.model_inputs import ModelInputs
from estimators.common.spline import evaluate_spline
from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.objective import MeasurementModel, Objective
from estimators.map_smoother.road_prior import RoadTransform, padded_size, prior_amplitude
from road_envs.analysis.information_bound import RoadPrior
from road_envs.vehicle.suspension import settled_strut_state

MARGIN = 4
"""Nodes before the first and behind the last that carries a wheel."""


@dataclass(frozen=True, eq=False)
class PreparedDrive:
    """A drive prepared for estimation. Samples `a` (S, T) [m/s²], of which `valid` (S, T) are used,
    and `censored` (S, T) as in `block_means`, in blocks of `block_size`; model `inputs`; vehicle at
    rest `rest_state` (14,) and the prior standard deviation `initial_std` (14,) about it; nodes of
    the road from the station `origin` [m] on, `ds` [m] apart, and which of them may rise or fall,
    `free` (K,) 0 or 1.
    """

    a: np.ndarray
    valid: np.ndarray
    censored: np.ndarray
    block_size: int
    inputs: ModelInputs
    rest_state: np.ndarray
    initial_std: np.ndarray
    origin: float
    ds: float
    free: np.ndarray

    @property
    def steps_per_block(self) -> int:
        """Steps in a block."""
        return self.block_size * self.inputs.decimation

    @property
    def blocks(self) -> int:
        """Number of block means of each sensor."""
        return self.a.shape[1] // self.block_size

    def split(self, window: float, overlap: float) -> list[tuple[int, int, int]]:
        """Split the drive into windows of `window` and `overlap` [s]: begin, begin of the next one,
        and end of each, in blocks.
        """
        rate = 1.0 / (self.steps_per_block * self.inputs.h)
        return split_windows(self.blocks, round(window * rate), round(overlap * rate))

    def node_at(self, s: float) -> int:
        """Return the node at the station `s` [m] or just before it."""
        return int((s - self.origin) / self.ds)


@dataclass(frozen=True, eq=False)
class WindowState:
    """Result of the windows so far. Coefficients `c` (2, K) [m] of the road, final before the node
    `first_free_node` and level from there on, and the `std` (2, K) [m] of their error;
    `vehicle_state` (14,), its standard deviation `initial_std` (14,) and `strut_state` (4, 3) where
    the next window begins; `density_scale` of the road's prior at the frequencies `n` [cycles/m];
    `filter_state` of the anti-alias filter there, None at rest or if it only delays.
    """

    c: np.ndarray
    std: np.ndarray
    first_free_node: int
    vehicle_state: np.ndarray
    initial_std: np.ndarray
    strut_state: np.ndarray
    n: np.ndarray
    density_scale: np.ndarray
    filter_state: np.ndarray | None = None

    def at_stations(self, drive: PreparedDrive, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return heights and standard deviations (2, M) [m] at the stations `s` (M,) [m]."""
        x = np.clip((s - drive.origin) / drive.ds, 1.0, drive.free.size - 3.0)
        node = np.arange(drive.free.size)
        return evaluate_spline(self.c, x), np.array([np.interp(x, node, std) for std in self.std])


def initial_window_state(drive: PreparedDrive) -> WindowState:
    """Return the state before the first window."""
    size = drive.free.size
    # exactly at rest the friction law has a kink and no tangent
    vehicle = drive.rest_state + 1e-7, drive.initial_std
    strut_state = settled_strut_state(int(drive.inputs.commands[0]))
    prior = np.array([0.0, 1.0]), np.ones(2)
    return WindowState(np.zeros((2, size)), np.zeros((2, size)), 0, *vehicle, strut_state, *prior)


def split_windows(blocks: int, window: int, overlap: int) -> list[tuple[int, int, int]]:
    """Split `blocks` into windows: begin, begin of the next one, and end of each."""
    windows, begin = [], 0
    while blocks - begin > window + overlap:
        windows.append((begin, begin + window - overlap, begin + window))
        begin += window - overlap
    return [*windows, (begin, blocks, blocks)]


def reconstruct(
    model: MeasurementModel,
    drive: PreparedDrive,
    prior: RoadPrior,
    windows: list[tuple[int, int, int]],
    solve: Callable[[Objective], tuple[MapSolution, np.ndarray]],
) -> tuple[WindowState, list[float]]:
    """Estimate all windows; return the final state and the noise scale of each window.

    `solve` returns the solution of one window and its standard deviation (2, K).
    """
    window_state, noise_scale = initial_window_state(drive), []
    for begin, after, end in windows:
        objective = window_objective(model, drive, prior, window_state, begin, end)
        solution, window_std = solve(objective)
        noise_scale.append(solution.noise_scale)
        steps = (after - begin) * drive.steps_per_block if after < end else None
        window_state = advance(drive, prior, window_state, solution, window_std, steps)
    return window_state, noise_scale


def window_objective(
    model: MeasurementModel,
    drive: PreparedDrive,
    prior: RoadPrior,
    window_state: WindowState,
    begin: int,
    end: int,
    nodes: tuple[int, int] | None = None,
) -> Objective:
    """Return the objective of blocks `begin` to `end` (excluded), started from `window_state`.

    `nodes` are the first and last that carry a wheel, if not those of these blocks.
    """
    inputs = drive.inputs.slice_steps(begin * drive.steps_per_block, end * drive.steps_per_block)
    samples = slice(begin * drive.block_size, end * drive.block_size)
    a, valid, censored = (x[:, samples] for x in (drive.a, drive.valid, drive.censored))
    if inputs.offset is not None:  # samples beyond the first or last step are not predicted
        at = inputs.sample_steps(a.shape[1])
        valid = valid & (at > -1.0) & (at < inputs.n_steps)
    bridged = np.isfinite(model.bandwidth)
    measurements = block_means(a, valid, drive.block_size, censored, bridged)
    first, last = nodes or nodes_under(drive, model.wheelbase, begin, end)
    low = first - MARGIN
    size = padded_size(last + MARGIN + 1 - low)
    c, free = window_state.c[:, low : low + size], drive.free[low : low + size].copy()
    free[: max(window_state.first_free_node - low, 0)] = 0.0
    missing = size - free.size
    c, free = np.pad(c, ((0, 0), (0, missing)), mode="edge"), np.pad(free, (0, missing))
    origin = drive.origin + drive.ds * low
    amplitude = prior_amplitude(prior, size, drive.ds)
    road = RoadTransform(origin, drive.ds, c, free, amplitude, np.ones_like(c))
    road = road.scale_density(np.interp(road.n, window_state.n, window_state.density_scale))
    vehicle = window_state.vehicle_state, window_state.initial_std
    filter_state = window_state.filter_state
    return Objective(
        model, window_state.strut_state, *vehicle, road, inputs, measurements, filter_state
    )


def whole_objective(model: MeasurementModel, drive: PreparedDrive, prior: RoadPrior) -> Objective:
    """Return the objective of a drive as one window."""
    return window_objective(model, drive, prior, initial_window_state(drive), 0, drive.blocks)


def nodes_under(drive: PreparedDrive, wheelbase: float, begin: int, end: int) -> tuple[int, int]:
    """Return the first and the last node that carries a wheel in blocks `begin` to `end`."""
    s = drive.inputs.s
    first, last = (2 * drive.steps_per_block * block for block in (begin, end))
    return drive.node_at(s[first] - wheelbase), drive.node_at(s[last - 1])


def advance(
    drive: PreparedDrive,
    prior: RoadPrior,
    window_state: WindowState,
    solution: MapSolution,
    window_std: np.ndarray,
    steps: int | None,
) -> WindowState:
    """Return the state after another window, of which the first `steps` are final; None: all."""
    objective, x = solution.linearization.objective, solution.linearization.x
    road, size = objective.road, drive.free.size
    low = round((road.origin - drive.origin) / drive.ds)
    first, last = max(window_state.first_free_node, low), min(low + road.size, size)
    state, strut_state = window_state.vehicle_state, window_state.strut_state
    filter_state = None
    if steps is not None:
        state, strut_state, filter_state = objective.state_after(x, steps)
        # up to the nodes that carry the front axle now
        last = drive.node_at(objective.inputs.s[2 * steps]) + 3
    c, std, here = window_state.c.copy(), window_state.std.copy(), slice(first - low, last - low)
    c[:, first:last] = road.coefficients(objective.split(x)[0])[:, here]
    std[:, first:last] = window_std[:, here]
    c[:, last:], std[:, last:] = c[:, last - 1 : last], std[:, last - 1 : last]
    scale = (road.amplitude[0] / prior_amplitude(prior, road.size, road.ds)[0]) ** 2
    scale *= np.mean(road.local[:, road.free > 0] ** 2)
    known = state, np.zeros_like(state), strut_state
    return WindowState(c, std, last, *known, road.n, scale, filter_state)
