"""Filter over a drive, window by window.

A window begins as new nodes enter from the prior and the oldest ones leave. Its blocks are filtered
in the local state (`filter.py`), of error e. They have whitened innovations of derivative U by e,
and move the vehicle's error by Phi e. The rest of the state is then updated at once: with
W = U P[local], the rows of the local state's covariance,

    P' = P - W' W,     P'[vehicle] = Phi P[local],     x' = x + W' innovation

A window is filtered in parts: one ends where stations are emitted, and where a step of the road is
accepted. Beside P is a column for the direction of each candidate step (`jumps.py`), which moves as
the error does. All nodes are held until the stations above them are emitted, so a height and its
variance are read from x and P.

A filter that is lost is begun anew (`_restart`), as if the record began there: its linearization is
one about a motion that the vehicle does not have, and no later measurement leads back to it.
"""

import numpy as np
from scipy.linalg.blas import dgemm

from estimators.kalman.filter import filter_blocks
from estimators.kalman.filtered import FilteredWindow, FilterRun
from estimators.kalman.profile_output import ProfileOutput, fill_weights, lost_noise_scale
from estimators.kalman.road_process import add_node
from estimators.kalman.state import NOISE_SCALE, ROUGHNESS_SCALE, SIGNAL_POWER, LocalState, StepTest
from estimators.kalman.tuning import TUNING

_MIN_LOG_RATIO = TUNING.min_log_ratio


class WindowFilter:
    """Filter of a drive that emits the stations of an `output`. With `smoothing` the latest parts
    of windows are kept, so that a step accepted later corrects what the smoother reads of them.
    """

    def __init__(self, run: FilterRun, output: ProfileOutput, *, smoothing: bool = False):
        self.run, self.output, self.smoothing = run, output, smoothing
        self._emitted = 0  # stations so far
        self._recent: list[FilteredWindow] = []
        self._least_noise, self._restarts_left = 1.0, TUNING.max_restarts
        road, schedule = run.road, run.windows
        # nodes whose increment is known when a window begins
        low, high = road.free_range
        passed = np.append(schedule.rear[0], schedule.rear) + 1
        first = np.maximum(passed[:-1], np.floor(low + road.increment_span) + 1.0)
        self._passed = first.astype(int), np.minimum(passed[1:], np.ceil(high)).astype(int)
        rear = np.maximum(schedule.reached[1:] - 2 - run.model.wheelbase_nodes, 0.0)
        self._rear = rear.astype(int)  # the node under the rear axle after each block

    def filter_window(self, i: int) -> list[FilteredWindow]:
        """Filter the window `i`; return its parts, which the smoother needs."""
        state, road, schedule = self.run.state, self.run.road, self.run.windows
        adaptive, n, x, P = state.adaptive, road.n_states, state.x, state.P
        if adaptive[NOISE_SCALE] <= lost_noise_scale(adaptive[SIGNAL_POWER]):
            passed = range(self._passed[0][i], self._passed[1][i])
            road.update_roughness(x, P, adaptive, state.jumps.square, passed)
        oldest, end = schedule.oldest[i], schedule.oldest[i + 1]
        adaptive[NOISE_SCALE] = max(adaptive[NOISE_SCALE], self._least_noise)
        restarted = bool(end > oldest) and self._is_lost(i)
        if restarted:
            self._restart(i)
        # node k takes the entries of k - n_nodes: these are read before add_node overwrites them,
        # and the columns of the candidates, beside the n of the covariance, begin at zero
        P[:, n + state.jumps.begin(np.arange(oldest, end) + road.n_nodes)] = 0.0
        leaving = road.node_entries(np.arange(oldest, end))
        left = x[leaving], P[leaving, :n], P[leaving, n:]
        for node in range(oldest, end):
            add_node(road, x, P, node + road.n_nodes - 1, adaptive[ROUGHNESS_SCALE])
        first, last = (int(edge) for edge in schedule.edges[i : i + 2])
        parts, nothing = list[FilteredWindow](), (x[:0], P[:0, :n], P[:0, n:])
        while first < last:
            part, first = self._filter_part(i, first, last, nothing if parts else left)
            parts.append(part)
        if parts:
            parts[0].restarted = restarted
        return parts

    def finish(self) -> None:
        """Emit the stations that are left after the last window."""
        self._emit(self.run.windows.newest.size - 1, self.run.n_blocks)
        variance = self.output.variance
        each = variance[:: TUNING.variance_stride]
        variance[:] = np.repeat(each, TUNING.variance_stride, axis=0)[: len(variance)]

    def _is_lost(self, i: int) -> bool:
        """Return whether the filter has lost the vehicle before the window `i`."""
        state, schedule = self.run.state, self.run.windows
        first = int(schedule.edges[i])
        since = first - (state.restarts[-1] if state.restarts else 0)
        newest, (low, high) = int(schedule.reached[first]), self.run.road.free_range
        if since < TUNING.lost_blocks or not low < newest < high:  # on a known level road
            return False
        near = max(newest - round(TUNING.obstacle_length / TUNING.node_spacing), 0)
        if state.jumps.square[near : newest + 1].any():
            return False
        lost = bool(np.median(state.nis[first - TUNING.lost_blocks : first]) > TUNING.lost_nis)
        if lost and since < TUNING.restart_blocks:
            self._restarts_left = 0
        return lost and self._restarts_left > 0

    def _restart(self, i: int) -> None:
        """Forget the state before the window `i` but for the sensor biases and the roughness."""
        state, road, schedule = self.run.state, self.run.road, self.run.windows
        n, N = road.n_states, road.n_vehicle
        newest = int(schedule.oldest[i]) + road.n_nodes - 1
        self._emit(i - 1, int(schedule.edges[i]))  # what is due is emitted before it is forgotten
        state.restarts.append(int(schedule.edges[i]))
        state.x[:N], state.x[road.first_sum :] = state.unknown.vehicle, 0.0
        state.P[:] = 0.0
        state.P[:, :n] = state.unknown.covariance(road, newest, state.adaptive[ROUGHNESS_SCALE])
        state.jumps.score[:], state.jumps.information[:] = 0.0, 0.0
        self._recent = []
        self._least_noise *= TUNING.restart_noise
        self._restarts_left -= 1
        state.adaptive[NOISE_SCALE] = self._least_noise

    def _filter_part(
        self, i: int, first: int, end: int, left: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> tuple[FilteredWindow, int]:
        """Emit what is due before the block `first` of the window `i`, and filter from there to
        `end`, to the next station that is due, or until a step is accepted. Return the part, with
        `leaving`, `covariance` and `direction` of the nodes that `left`, and the block behind it.
        """
        emitted = self._emit(i, first)
        if self._emitted < len(self.output.node):
            end = min(end, int(self.output.emit_block[self._emitted]))
        state, schedule, road = self.run.state, self.run.windows, self.run.road
        n, N, jumps, x, P = road.n_states, road.n_vehicle, state.jumps, state.x, state.P
        front = schedule.newest[i] - np.arange(schedule.n_front[i])
        rear = schedule.rear_newest[i] - np.arange(schedule.n_rear[i])
        nodes = road.node_entries(np.concatenate([front, rear]))
        local = np.concatenate([np.arange(road.first_sum), nodes])
        size, P_local, blocks = local.size, P[local], end - first
        nodes_at = (schedule.newest[i], schedule.n_front[i] + schedule.rear_newest[i])
        own = LocalState(
            x=x[local],
            rows=np.hstack([P_local[:, local], np.eye(size)]),
            nodes_at=road.first_sum + 2 * np.array(nodes_at, dtype=np.int64),
            strut_state=state.strut_state,
            adaptive=state.adaptive,
            innovation=np.empty(3 * blocks),
            U=np.empty((3 * blocks, size)),
            nis=state.nis[first:end],
            noise_scale=state.noise_scale[first:end],
            signal_power=state.signal_power[first:end],
        )
        test = StepTest(
            direction=P_local[:, n:].copy(),
            score=jumps.score,
            information=jumps.information,
            reached=schedule.reached[first + 1 : end + 1],
            near_step=jumps.near[self._rear[first:end]],
            n_nodes=jumps.length,
        )
        last, likely = filter_blocks(self.run.model, self.run.inputs, own, test, first, end)
        rows = 3 * (last - first)
        innovation, U, transition = own.innovation[:rows], own.U[:rows], own.rows[:N, size:]
        W, moved = U @ P_local, transition @ P_local
        x += innovation @ W[:, :n]
        x[local] = own.x
        W[:, :N] = 0.0
        # P -= W' W in place: for BLAS, arrays by columns
        dgemm(-1.0, W.T, W[:, :n].T, 1.0, P.T, trans_b=True, overwrite_c=True)
        moved[:, :N] = own.rows[:N, :N]
        P[:N], P[:, :N] = moved, moved[:, :n].T
        part = FilteredWindow(
            i, local, transition, innovation, U, W[:, :n], *left, response=W[:, n:], emitted=emitted
        )
        if self.smoothing:
            oldest = schedule.newest[i] - jumps.score.size // 2
            self._recent = [one for one in self._recent if schedule.newest[one.index] > oldest]
            self._recent.append(part)
        if likely and last < schedule.edges[-1]:
            self._accept_jumps(last, part)
        return part, last

    def _accept_jumps(self, blocks: int, part: FilteredWindow) -> None:
        """Accept the steps that are likely after so many `blocks`, and correct the innovations
        since their nodes are in the state.
        """
        state, newest, reached = self.run.state, self.run.windows.newest, self.run.windows.reached
        n, least = state.x.size, _MIN_LOG_RATIO * state.adaptive[NOISE_SCALE]
        P, direction = state.P[:, :n], state.P[:, n:]
        for step in state.jumps.accept(state.x, P, direction, int(reached[blocks]), least):
            part.accepted.append(step)
            for one in self._recent:
                if newest[one.index] >= step.node:
                    response = one.response[:, step.candidate].copy()
                    shift = one.direction[:, step.candidate].copy()
                    one.corrections.append((step, response @ one.U, shift))
                    one.response[:] -= np.outer(response, step.variance * step.cross)
                    one.direction[:] -= np.outer(shift, step.variance * step.cross)

    def _emit(self, i: int, block: int) -> list[tuple[int, np.ndarray]]:
        """Emit the stations that are due before the `block` of the window `i`. Return the numbers
        of those whose variance is computed, with the covariance (2, n) of their heights with the
        state, for the smoother.
        """
        output, state, road, schedule = self.output, self.run.state, self.run.road, self.run.windows
        first = self._emitted
        self._emitted = last = int(np.searchsorted(output.emit_block, block, side="right"))
        if first == last:
            return []
        n, oldest = road.n_states, int(schedule.oldest[i + 1])
        held = np.arange(oldest, schedule.reached[block] + 1)
        sums = np.arange(road.first_sum, road.first_node)
        entries = np.append(sums, road.node_entries(held)).reshape(-1, 2)
        at = np.clip(output.node[first:last] - oldest, 0.0, held.size - 1.0)
        weights = np.empty((last - first, len(entries)))
        decay = TUNING.decay if output.detrended else 0.0
        fill_weights(at, decay, output.cutoff[0, first:last], weights)
        mean, difference = (weights @ state.x[entries]).T
        output.z[first:last] = np.stack([mean + difference, mean - difference], axis=1)
        chosen = np.arange(-first % TUNING.variance_stride, last - first, TUNING.variance_stride)
        cutoff = output.cutoff[1, first + chosen]
        fill_weights(at[chosen], TUNING.decay, cutoff, weights)
        emitted = []
        for k, u in zip(first + chosen, weights, strict=False):
            of_height = np.zeros((2, n))
            of_height[:, entries[:, 0]], of_height[:, entries[:, 1]] = u, np.outer((1.0, -1.0), u)
            covariance = of_height @ state.P[:, :n]
            output.variance[k] = np.sum(covariance * of_height, axis=1)
            emitted.append((int(k), covariance))
        return emitted
