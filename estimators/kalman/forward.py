"""Filter over a drive, window by window: the covariance of all nodes and of the emitted heights.

A window begins as new nodes enter from the prior and the oldest ones leave. Its blocks are filtered
in the local state (`filter.py`), of error e. They have whitened innovations of derivative U by e,
and move the vehicle's error by Phi e. The rest of the state is then updated at once: with
W = U P[local], the rows of the local state's covariance,

    P' = P - W' W,     P'[vehicle] = Phi P[local],     x' = x + W' innovation

A node that leaves is smoothed further by the covariance of its error with the state, in `smoother`.
The variance of a height that is emitted later than some of its nodes leave needs the covariance of
its error with the state at every moment. Heights are therefore further rows below P, to which the
nodes are added as they leave. Beside both are a column for the direction of each candidate step of
the road (`jumps.py`), which moves as the error does, and is tested at the window's end.

A filter that is lost is begun anew (`_restart`), as if the record began there: its linearization is
one about a motion that the vehicle does not have, and no later measurement leads back to it.

Operations of a window of 24 blocks at 14.5 km/h, in millions, with 173 states, 55 of them local, 34
heights and 24 candidates: 7.1 in the local filter, beside the linearization of the blocks, 5.9 in
P - W' W, 1.9 in W, 0.3 in Phi P, 0.4 for new nodes and heights, and 0.8 for the smoother.
"""

import numpy as np
from scipy.linalg.blas import dgemm

from estimators.kalman.filter import filter_window
from estimators.kalman.filtered import (
    NODE_SPACING,
    BandVariance,
    FilteredWindow,
    FilterRun,
    NodesAtEmission,
)
from estimators.kalman.joint_state import advance_nodes
from estimators.kalman.jumps import MIN_LOG_RATIO
from estimators.kalman.profile_output import lost_noise_scale
from estimators.kalman.road_process import update_roughness
from estimators.kalman.state import (
    NOISE_SCALE,
    ROUGHNESS_SCALE,
    SIGNAL_POWER,
    JointState,
    LocalState,
    StepTest,
    WindowPart,
)

LOST_NIS, LOST_BLOCKS = 5.0, 60
"""Median of the normalized innovation squared over so many blocks above which the filter is lost.
On obstacles it is as high for fewer blocks, on vehicles of grade S1 below 2 before they are lost.
On a road that became rough at once it was above 3 on the described vehicle itself.
"""

OBSTACLE_LENGTH = 6.5
"""Distance [m] behind the newest node within which an accepted step explains the innovations."""

RESTART_NOISE, MAX_RESTARTS, RESTART_BLOCKS = 4.0, 2, 400
"""Factor by which each restart raises the least noise scale, as the vehicle is not the one that is
described; restarts at most; and blocks since the beginning or the last restart below which a filter
that is lost is not begun anew any more, as it would be lost again and again."""


class WindowFilter:
    """Filter of a drive: `state` after the windows so far, with the heights `nodes` and `bands`
    emitted in them.
    """

    def __init__(self, run: FilterRun, nodes: NodesAtEmission, bands: BandVariance):
        self.model, self.inputs, self.road = run.model, run.inputs, run.road
        self.schedule = run.windows
        self.state, self.nodes, self.bands = run.state, nodes, bands
        road, schedule, state = run.road, run.windows, run.state
        n, heights = road.n_states, 2 * bands.most_live
        self._joint = JointState(
            state.x, np.zeros((n + heights, n + state.jumps.score.size)), np.zeros(heights)
        )
        self._joint.P[:n, :n] = state.P
        self._moments = np.zeros(2, dtype=np.int64)  # at which nodes and heights have been read
        self._recent: list[FilteredWindow] = []
        self._least_noise, self._restarts_left = 1.0, MAX_RESTARTS
        window, times = np.arange(schedule.newest.size), bands.times
        # in each window, from the first to the last (excluded): heights of which nodes leave in it
        # or have left, and nodes whose increment is known when it begins
        start = np.searchsorted(times.window, window)
        self._heights = start, np.searchsorted(times.first, window, side="right")
        low, high = road.free_range
        passed = np.append(schedule.rear[0], schedule.rear) + 1
        first = np.maximum(passed[:-1], np.floor(low + road.increment_span) + 1.0)
        self._passed = first.astype(int), np.minimum(passed[1:], np.ceil(high)).astype(int)
        rear = np.maximum(schedule.reached[1:] - 2 - run.model.wheelbase_nodes, 0.0)
        self._rear = rear.astype(int)  # the node under the rear axle after each block

    def filter_window(self, i: int) -> list[FilteredWindow]:
        """Filter the window `i`, in parts where a step of the road is accepted."""
        state, road, schedule, joint = self.state, self.road, self.schedule, self._joint
        adaptive, n = state.adaptive, road.n_states
        if adaptive[NOISE_SCALE] <= lost_noise_scale(adaptive[SIGNAL_POWER]):
            passed = self._passed[0][i], self._passed[1][i]
            update_roughness(road, joint, adaptive, state.jumps.square, passed)
        oldest, end = schedule.oldest[i], schedule.oldest[i + 1]
        adaptive[NOISE_SCALE] = max(adaptive[NOISE_SCALE], self._least_noise)
        restarted = bool(end > oldest) and self._is_lost(i)
        if restarted:
            self._restart(i)
        state.jumps.begin(np.arange(oldest, end) + road.n_nodes)
        heights, scale = (self._heights[0][i], self._heights[1][i]), adaptive[ROUGHNESS_SCALE]
        mean, rows = advance_nodes(road, joint, self.bands, heights, i, (oldest, end), scale)
        left = mean, rows[:, :n], rows[:, n:]
        first, last = (int(edge) for edge in schedule.edges[i : i + 2])
        parts = [self._filter_part(i, first, last, left, restarted)]
        nothing = left[0][:0], left[1][:0], left[2][:0]
        while (first := parts[-1].blocks[1]) < last:
            parts.append(self._filter_part(i, first, last, nothing))
        return parts

    def _is_lost(self, i: int) -> bool:
        """Return whether the filter has lost the vehicle before the window `i`."""
        state, first = self.state, int(self.schedule.edges[i])
        since = first - (state.restarts[-1] if state.restarts else 0)
        newest, (low, high) = int(self.schedule.reached[first]), self.road.free_range
        if since < LOST_BLOCKS or not low < newest < high:  # innovations of a known level road
            return False
        near = max(newest - round(OBSTACLE_LENGTH / NODE_SPACING), 0)
        if state.jumps.square[near : newest + 1].any():
            return False
        lost = bool(np.median(state.nis[first - LOST_BLOCKS : first]) > LOST_NIS)
        if lost and since < RESTART_BLOCKS:
            self._restarts_left = 0
        return lost and self._restarts_left > 0

    def _restart(self, i: int) -> None:
        """Forget the state before the window `i` but for the sensor biases and the roughness."""
        state, road, P = self.state, self.road, self._joint.P
        n, N = road.n_states, road.n_vehicle
        newest = int(self.schedule.oldest[i]) + road.n_nodes - 1
        state.restarts.append(int(self.schedule.edges[i]))
        state.x[:N], state.x[road.first_sum :] = state.unknown.vehicle, 0.0
        P[:] = 0.0
        P[:n, :n] = state.unknown.covariance(road, newest, state.adaptive[ROUGHNESS_SCALE])
        state.jumps.score[:], state.jumps.information[:] = 0.0, 0.0
        self._recent = []
        self._least_noise *= RESTART_NOISE
        self._restarts_left -= 1
        state.adaptive[NOISE_SCALE] = self._least_noise

    def _filter_part(
        self,
        i: int,
        first: int,
        end: int,
        left: tuple[np.ndarray, np.ndarray, np.ndarray],
        restarted: bool = False,
    ) -> FilteredWindow:
        """Filter blocks from `first` on, to `end` or until a step is accepted. `left`: `leaving`,
        `covariance` and `direction` of the part.
        """
        state, schedule, road, P = self.state, self.schedule, self.road, self._joint.P
        n, local, jumps = road.n_states, self._local_entries(i), state.jumps
        size, front = local.size, road.first_sum
        nodes_at = [
            front + 2 * schedule.newest[i],
            front + 2 * (schedule.n_front[i] + schedule.rear_newest[i]),
        ]
        own = LocalState(
            x=np.empty(size),
            rows=np.empty((size, 2 * size)),
            nodes_at=np.array(nodes_at, dtype=np.int64),
            strut_state=state.strut_state,
            adaptive=state.adaptive,
            innovation=np.empty(3 * (end - first)),
            U=np.empty((3 * (end - first), size)),
            nis=state.nis[first:end],
            noise_scale=state.noise_scale[first:end],
            signal_power=state.signal_power[first:end],
        )
        test = StepTest(
            direction=np.empty((size, jumps.score.size)),
            score=jumps.score,
            information=jumps.information,
            reached=schedule.reached[first + 1 : end + 1],
            near_step=jumps.near[self._rear[first:end]],
            n_nodes=jumps.length,
        )
        part = WindowPart(i, first, end, int(schedule.oldest[i + 1]), local, self._moments)
        last, likely, V, W = filter_window(
            self.model, self.inputs, road, self._joint, part, own, test, self.nodes, self.bands
        )
        # P -= V' W in place: for BLAS, arrays by columns
        dgemm(-1.0, W.T, V.T, 1.0, P.T, trans_b=True, overwrite_c=True)
        transition, rows = own.rows[: road.n_vehicle, size:], slice(3 * (last - first))
        window = FilteredWindow(
            i, (first, last), local, transition, own.innovation[rows], own.U[rows], W[:, :n], *left,
            response=W[:, n:], restarted=restarted,
        )  # fmt: skip
        oldest = schedule.newest[i] - jumps.score.size // 2
        self._recent = [one for one in self._recent if schedule.newest[one.index] > oldest]
        self._recent.append(window)
        if likely and last < schedule.edges[-1]:
            self._accept_jumps(last)
        return window

    def _accept_jumps(self, blocks: int) -> None:
        """Accept the steps that are likely after so many `blocks`, and correct the innovations
        since their nodes are in the state.
        """
        state, newest, reached = self.state, self.schedule.newest, self.schedule.reached[blocks]
        n, least = state.x.size, MIN_LOG_RATIO * state.adaptive[NOISE_SCALE]
        covariance, direction = self._joint.P[:, :n].T, self._joint.P[:, n:]
        for step in state.jumps.accept(state.x, covariance, direction, int(reached), least):
            self._joint.variance[:] += step.added * step.direction[n:] ** 2
            self._recent[-1].accepted.append(step)
            for part in self._recent:
                if newest[part.index] >= step.node:
                    response = part.response[:, step.candidate].copy()
                    shift = part.direction[:, step.candidate].copy()
                    part.corrections.append((step, response @ part.U, shift))
                    part.response[:] -= np.outer(response, step.variance * step.cross)
                    part.direction[:] -= np.outer(shift, step.variance * step.cross)

    def _local_entries(self, i: int) -> np.ndarray:
        schedule, road = self.schedule, self.road
        front = schedule.newest[i] - np.arange(schedule.n_front[i])
        rear = schedule.rear_newest[i] - np.arange(schedule.n_rear[i])
        nodes = road.node_entries(np.concatenate([front, rear]))
        return np.concatenate([np.arange(road.first_sum), nodes])
