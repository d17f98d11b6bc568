"""Run of the filter over a drive: constants, inputs, current state, and what the smoother needs."""

from dataclasses import dataclass, field

import numpy as np

from estimators.kalman.jumps import AcceptedStep, RoadJumps
from estimators.kalman.monitoring import recent_nis
from estimators.kalman.profile_output import ProfileOutput, lost_noise_scale
from estimators.kalman.road_process import RoadProcess
from estimators.kalman.state import FilterInputs, FilterModel
from estimators.kalman.tuning import TUNING
from estimators.kalman.windows import WindowSchedule


@dataclass(frozen=True, eq=False)
class UnknownState:
    """A state in the middle of a drive of which nothing is known yet: `vehicle` (N,) at rest on a
    level road, standard deviations `std` (N + 3,) of vehicle and biases, and the prior covariance
    `nodes` (2 K, 2 K) [m²] of the road's nodes, the newest first.
    """

    vehicle: np.ndarray
    std: np.ndarray
    nodes: np.ndarray

    def covariance(self, road: RoadProcess, newest: int, scale: float) -> np.ndarray:
        """Return P (n, n) for nodes up to the `newest` and a roughness `scale`."""
        P, held = np.zeros((road.n_states, road.n_states)), newest - np.arange(road.n_nodes)
        entries, known = road.node_entries(held), np.arange(self.std.size)
        P[known, known] = self.std**2
        P[np.ix_(entries, entries)] = scale * self.nodes
        return P


@dataclass(eq=False)
class FilterState:
    """Mean `x` (n,); `P` (n, n + m), the covariance and, beside it, the error per unit step of
    each of m candidates (`jumps.py`); valve states of the struts `strut_state` (4, 3); the
    parameters `adaptive` (5,); the steps of the road `jumps`; and the blocks before which the
    filter was begun anew, `restarts`, from the state `unknown`. Of each block (J,): normalized
    innovation squared per measurement `nis`, `noise_scale` and `signal_power` after it.
    """

    x: np.ndarray
    P: np.ndarray
    strut_state: np.ndarray
    adaptive: np.ndarray
    jumps: RoadJumps
    unknown: UnknownState
    nis: np.ndarray
    noise_scale: np.ndarray
    signal_power: np.ndarray
    restarts: list[int] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class FilterRun:
    """A drive prepared for the filter: `model`, `inputs`, the `road` and the `windows`, and the
    current `state`. A station s has the node number (s - `origin`) / node_spacing, and is emitted
    when the front axle is `lag` [m] past it.
    """

    model: FilterModel
    inputs: FilterInputs
    road: RoadProcess
    windows: WindowSchedule
    state: FilterState
    origin: float
    lag: float

    @property
    def n_blocks(self) -> int:
        """Blocks of measurements."""
        return int(self.inputs.y.shape[1])

    def known_front(self, sensor_latency: float) -> np.ndarray:
        """Return the front axle's station (J,) [m] `sensor_latency` [s] after each block."""
        h, node = self.model.h, self.inputs.front_node
        t = sensor_latency + h * self.model.steps_per_block * np.arange(1, self.n_blocks + 1)
        known = np.interp(t, 0.5 * h * np.arange(node.size), node)
        return self.origin + TUNING.node_spacing * known

    def emitted_share(self, output: ProfileOutput) -> np.ndarray:
        """Return the share (M,), 0 to 1, by which each height is to be trusted when emitted."""
        state, last = self.state, np.clip(output.emit_block - 1, 0, None)
        if output.both_axles:
            ratio = lost_noise_scale(state.signal_power) / state.noise_scale
        else:
            nis = recent_nis(state.nis, self.known_front(0.0), TUNING.early_length)
            ratio = np.minimum(1.0, TUNING.early_noise_scale / state.noise_scale)
            ratio *= np.minimum(1.0, TUNING.early_nis / np.maximum(nis, 1e-300))
        return np.minimum(1.0, ratio[last]) ** 2

    def lost_before_restarts(self, output: ProfileOutput) -> np.ndarray:
        """Return the stations (M,) that the front axle passed within `lost_reach` before a restart
        and that were emitted after it.
        """
        lost, front = np.zeros(output.node.size, dtype=bool), self.known_front(0.0)
        s = self.origin + TUNING.node_spacing * output.node
        for block in self.state.restarts:
            passed = (s > front[block] - TUNING.lost_reach) & (s <= front[block])
            lost |= passed & (output.emit_block >= block)
        return lost


@dataclass(eq=False)
class FilteredWindow:
    """A filtered window, or a part of one, for the smoother.

    Its number `index`; the entries `local` (L,) of the state vector; `transition` (N, L), the
    derivative of the vehicle's error at the end by the local error at the start; the whitened
    `innovation` (R,), its derivative `U` (R, L) by that error, and its covariance `W` (R, n) with
    the rest of the state at the start, 0 with the vehicle.

    Before it, M nodes have entered, and before these the M nodes that leave, the oldest first, had
    the mean `leaving` (2 M,) and the `covariance` (2 M, n) with the state; none in a later part.
    `emitted`: numbers of the stations emitted at the start, and the covariance (2, n) of their
    heights with the state.

    Per unit step of each candidate of the road's: the mean of the innovation `response` (R, m), the
    error of the mean `direction` (2 M, m). After it, the steps `accepted`. Of steps that are
    accepted then or later, `corrections` has the U' response (L,) and direction (2 M,).
    If `restarted`, the state before the window is forgotten.
    """

    index: int
    local: np.ndarray
    transition: np.ndarray
    innovation: np.ndarray
    U: np.ndarray
    W: np.ndarray
    leaving: np.ndarray
    covariance: np.ndarray
    direction: np.ndarray
    response: np.ndarray
    emitted: list[tuple[int, np.ndarray]]
    restarted: bool = False
    accepted: list[AcceptedStep] = field(default_factory=list)
    corrections: list[tuple[AcceptedStep, np.ndarray, np.ndarray]] = field(default_factory=list)
