"""Filter over a drive, window by window: the covariance of all nodes and of the emitted heights.

A window begins as new nodes enter from the prior and the oldest ones leave. Its blocks are filtered
in the local state (`filter.py`), of error e, whose closed-loop transition is Phi, and whose
whitened innovations have the derivative U. The rest of the state is then updated at once: with
W = U P[local], the rows of the local state's covariance,

    P' = P - W' W,     P'[local] = Phi P[local],     x' = x + W' innovation

Beside P are a column for the direction of each candidate step of the road (`jumps.py`), which moves
as the error does, and is tested at the window's end.

A node that leaves is smoothed further by the covariance of its error with the state, in `smoother`.
The variance of a height that is emitted later than some of its nodes leave needs the covariance of
its error with the state at every moment. These are further columns for each wheel path, to which
the nodes are added as they leave.

Operations of a window of 24 blocks at 14.5 km/h, in millions, with 175 states, 59 of them local, 36
columns for heights and 24 for steps: 7.7 in the local filter, 5.9 in P - W' W, 2.0 in W, 1.6 in
Phi P, 1.5 in new nodes and 2.2 for the smoother; 0.9 for a block, beside its linearization.
"""

import numpy as np

from estimators.kalman.filter import filter_window
from estimators.kalman.filtered import (
    BandVariance,
    FilteredWindow,
    FilterState,
    NodesAtEmission,
)
from estimators.kalman.jumps import MIN_LOG_RATIO
from estimators.kalman.profile_output import lost_noise_scale
from estimators.kalman.road_process import NodeTransition, RoadProcess
from estimators.kalman.state import (
    N_SUMS,
    NOISE_SCALE,
    ROUGHNESS_SCALE,
    SIGNAL_POWER,
    FilterInputs,
    FilterModel,
    LocalState,
    StepTest,
)
from estimators.kalman.windows import WindowSchedule


class WindowFilter:
    """Filter of a drive: `state` after the windows so far, with the heights `nodes` and `bands`
    emitted in them.
    """

    def __init__(
        self,
        model: FilterModel,
        inputs: FilterInputs,
        road: RoadProcess,
        schedule: WindowSchedule,
        free_range: np.ndarray,
        state: FilterState,
        *,
        nodes: NodesAtEmission,
        bands: BandVariance,
    ):
        self.model, self.inputs, self.road, self.schedule = model, inputs, road, schedule
        self.free_range, self.state, self.nodes, self.bands = free_range, state, nodes, bands
        n, slots, candidates = road.n_states, bands.slots, state.jumps.score.size
        self._P = np.concatenate([state.P, np.zeros((n, 2 * slots + candidates))], axis=1)
        self._heights, self._candidates = slice(n, n + 2 * slots), n + 2 * slots
        self._variance = np.zeros(2 * slots)
        self._direction = np.zeros((2 * slots, candidates))  # of the heights
        self._recent: list[FilteredWindow] = []
        self._newest = schedule.initial
        self._spare = np.empty_like(self._P)
        self._entries = np.arange(n)

    def filter_window(self, i: int, keep: bool = True) -> list[FilteredWindow]:
        """Filter the window `i`, in parts where a step of the road is accepted. They are complete
        only with `keep`.
        """
        state, road, schedule = self.state, self.road, self.schedule
        if state.adaptive[NOISE_SCALE] <= lost_noise_scale(state.adaptive[SIGNAL_POWER]):
            self._update_roughness(i)
        count, sums = int(schedule.newest[i]) - self._newest, road.first_sum
        last = self._entries[road.n_states - 2 * count :].reshape(-1, 2)[::-1].ravel()
        leaving = np.concatenate([self._entries[sums : sums + N_SUMS], last])
        self._begin_candidates(count)
        rows = self._P[leaving]
        left = state.x[leaving], rows[:, : road.n_states], rows[:, self._candidates :]
        if count > 0:
            self._accumulate(i, leaving, rows)
        transitions = self._add_nodes(count)
        first, end = (int(edge) for edge in schedule.edges[i : i + 2])
        parts = [self._filter_part(i, first, end, transitions, left, keep)]
        nothing = left[0][:0], left[1][:0], left[2][:0]
        while (first := parts[-1].blocks[1]) < end:
            parts.append(self._filter_part(i, first, end, [], nothing, keep))
        return parts

    def _filter_part(
        self,
        i: int,
        first: int,
        end: int,
        transitions: list[NodeTransition],
        left: tuple[np.ndarray, np.ndarray, np.ndarray],
        keep: bool,
    ) -> FilteredWindow:
        """Filter blocks from `first` on, to `end` or until a step is accepted. `left`: `leaving`,
        `covariance` and `direction` of the part.
        """
        state, n, local = self.state, self.road.n_states, self._local_entries(i)
        own, last, likely = self._filter_local(i, local, first, end)
        U, innovation = own.U[: 3 * (last - first)], own.innovation[: 3 * (last - first)]
        state.nis[first:last] = own.nis[: last - first]
        state.noise_scale[first:last] = own.noise_scale[: last - first]
        state.signal_power[first:last] = own.signal_power[: last - first]
        P_local = self._P[local]
        self._read_nodes(i, (first, last), P_local, U, innovation)
        self._read_bands(i, (first, last), local, U)
        W, size = U @ P_local, local.size
        transition, D = own.rows[:, size:], np.zeros((0, size))
        if keep:
            D = W[:, :n].T @ -U
            D[local] = transition
        self._P -= np.dot(W[:, :n].T, W, out=self._spare)
        heights, response = W[:, self._heights], W[:, self._candidates :].copy()
        self._variance -= np.einsum("rk,rk->k", heights, heights)
        self._direction -= heights.T @ response
        moved = transition @ P_local
        moved[:, local] = own.rows[:, :size]
        self._P[local] = moved
        self._P[:, local] = moved[:, :n].T
        state.x += innovation @ W[:, :n]
        state.x[local] = own.x
        part = FilteredWindow(
            i, (first, last), local, D, U, innovation, transitions, *left, response
        )
        state.jumps.update(response, innovation)
        oldest = self._newest - state.jumps.score.size // 2
        self._recent = [one for one in self._recent if self.schedule.newest[one.index] > oldest]
        self._recent.append(part)
        if likely and last < self.schedule.edges[-1]:
            self._accept_jumps(last)
        return part

    def _accept_jumps(self, blocks: int) -> None:
        """Accept the steps that are likely after so many `blocks`, and correct the innovations
        since their nodes are in the state.
        """
        state, newest, reached = self.state, self.schedule.newest, self.schedule.reached[blocks]
        n, columns = state.x.size, self._candidates
        direction = np.concatenate([self._P[:, columns:], self._direction])
        least = MIN_LOG_RATIO * state.adaptive[NOISE_SCALE]
        for step in state.jumps.accept(
            state.x, self._P[:, :columns], direction, int(reached), least
        ):
            self._variance += step.added * step.direction[n:] ** 2
            self._recent[-1].accepted.append(step)
            for part in self._recent:
                if newest[part.index] >= step.node:
                    response = part.response[:, step.candidate].copy()
                    shift = part.direction[:, step.candidate].copy()
                    part.corrections.append((step, response @ part.U, shift))
                    part.response[:] -= np.outer(response, step.variance * step.cross)
                    part.direction[:] -= np.outer(shift, step.variance * step.cross)
        self._P[:, columns:], self._direction[:] = direction[:n], direction[n:]

    def _update_roughness(self, i: int) -> None:
        low, high = self.free_range
        rear, span = self.schedule.rear, self.road.increment_span
        passed = np.arange(rear[max(i - 1, 0)] + 1, rear[i] + 1)
        passed = passed[(passed - span > low) & (passed < high)]
        state = self.state
        # an increment with an accepted step is none of the stationary prior
        square = state.jumps.square
        passed = passed[[not square[k - span - 1 : k + 2].any() for k in passed]]
        self.road.update_roughness(state.adaptive, state.x, self._P, self._newest - passed)

    def _accumulate(self, i: int, leaving: np.ndarray, rows: np.ndarray) -> None:
        """Add the nodes that leave to the heights of which they are a part."""
        times, n = self.bands.times, self.road.n_states
        # heights of which some nodes have left or leave now, in order of their slots
        start, end = np.searchsorted(times.window, i), np.searchsorted(times.first, i, side="right")
        live = np.arange(start, end)
        live = live[times.first[live] <= i]
        if live.size == 0:
            return
        weights = np.zeros((2 * self.bands.slots, leaving.size))
        at = 2 + self.schedule.oldest[i] - times.base[live]
        slot = live % self.bands.slots
        nodes = self.bands.weights[live[:, None], at[:, None] + np.arange(leaving.size // 2 - 2)]
        weights[2 * slot, N_SUMS::2] = weights[2 * slot + 1, N_SUMS::2] = nodes
        weights[2 * slot, N_SUMS + 1 :: 2] = nodes
        weights[2 * slot + 1, N_SUMS + 1 :: 2] = -nodes
        new = times.first[live] == i
        begun, sums = slot[new], self.bands.weights[live[new], :2]
        columns = np.concatenate([2 * begun, 2 * begun + 1])
        self._P[:, n + columns], self._variance[columns], self._direction[columns] = 0.0, 0.0, 0.0
        weights[columns, :2] = np.concatenate([sums, sums])
        weights[columns, 2:4] = np.concatenate([sums, -sums])
        added, covariance = weights @ rows, self._P[leaving, self._heights]
        self._variance += np.einsum("kl,lk->k", weights, 2.0 * covariance + added[:, leaving].T)
        self._P[:, self._heights] += added[:, :n].T
        self._direction += added[:, self._candidates :]

    def _add_nodes(self, count: int) -> list[NodeTransition]:
        """Add so many nodes ahead; runs of free nodes and of level ones by a transition each."""
        middle = self._newest + 0.5 + np.arange(count)
        free = (self.free_range[0] < middle) & (middle < self.free_range[1])
        runs = np.split(free, np.flatnonzero(np.diff(free)) + 1) if count else []
        transitions = [self.road.transition(run.size, bool(run[0])) for run in runs]
        state, n, first = self.state, self.road.n_states, self.road.first_sum
        for count, rows, noise, response in transitions:
            P, moved = self._P, self._spare
            start, end = self.road.first_node, self.road.first_node + 2 * count
            old, new = slice(start, n - 2 * count), slice(end, n)
            front = rows @ P
            moved[:first, :first], moved[:first, new] = P[:first, :first], P[:first, old]
            moved[new, :first], moved[new, new] = P[old, :first], P[old, old]
            moved[:first, n:], moved[new, n:] = P[:first, n:], P[old, n:]
            corner = front[:, :n] @ rows.T + state.adaptive[ROUGHNESS_SCALE] * noise
            moved[first:end, :first], moved[first:end, new] = front[:, :first], front[:, old]
            moved[first:end, first:end], moved[first:end, n:] = corner, front[:, n:]
            moved[:, first:end] = moved[first:end, :n].T
            self._P, self._spare = moved, P
            x = rows @ state.x
            state.x[new] = state.x[old].copy()
            state.x[first:end] = x
            self._newest += count
            self._point_candidates(response)
        return transitions

    def _begin_candidates(self, count: int) -> None:
        """Replace the oldest candidates by those of so many new nodes."""
        jumps = self.state.jumps
        nodes = self._newest + count - np.arange(min(count, jumps.score.size // 2))
        begun = jumps.begin(nodes).ravel()
        self._P[:, self._candidates + begun] = 0.0
        self._direction[:, begun] = 0.0

    def _point_candidates(self, response: np.ndarray) -> None:
        """Give the newest nodes' candidates their direction: the coefficients of these nodes have
        the `response` (2, M, M) to a step at each.
        """
        m, count, start = self.state.jumps.score.size, response.shape[1], self.road.first_node
        nodes, end = self._newest - np.arange(min(count, m // 2)), start + 2 * count
        for side in range(2):
            columns = self._candidates + (2 * nodes + side) % m
            self._P[start:end:2, columns] = 0.5 * response[0, :, : nodes.size]
            self._P[start + 1 : end : 2, columns] = (0.5 - side) * response[1, :, : nodes.size]

    def _local_entries(self, i: int) -> np.ndarray:
        schedule, first = self.schedule, self.road.first_node
        rear = first + 2 * (schedule.newest[i] - schedule.rear_newest[i])
        entries = self._entries
        return np.concatenate(
            [
                entries[: self.road.first_sum],
                entries[first : first + 2 * schedule.n_front[i]],
                entries[rear : rear + 2 * schedule.n_rear[i]],
            ]
        )

    def _filter_local(
        self, i: int, local: np.ndarray, first: int, end: int
    ) -> tuple[LocalState, int, bool]:
        """Filter the window `i` from the block `first` on in its local state. Return it, the block
        behind the last one, and whether a step is likely then.
        """
        schedule, size, state, jumps = self.schedule, local.size, self.state, self.state.jumps
        blocks, front = end - first, self.road.first_sum
        nodes_at = [
            front + 2 * schedule.newest[i],
            front + 2 * (schedule.n_front[i] + schedule.rear_newest[i]),
        ]
        own = LocalState(
            x=state.x[local],
            rows=np.concatenate([self._P[np.ix_(local, local)], np.eye(size)], axis=1),
            nodes_at=np.array(nodes_at, dtype=np.int64),
            strut_state=state.strut_state,
            adaptive=state.adaptive,
            innovation=np.empty(3 * blocks),
            U=np.empty((3 * blocks, size)),
            nis=np.empty(blocks),
            noise_scale=np.empty(blocks),
            signal_power=np.empty(blocks),
        )
        reached = schedule.reached[first + 1 : end + 1]
        rear = np.maximum(reached - 2 - self.model.wheelbase_nodes, 0.0).astype(int)
        test = StepTest(
            direction=self._P[local, self._candidates :],
            score=jumps.score.copy(),
            information=np.diag(jumps.information).copy(),
            reached=reached,
            near_step=jumps.near[rear],
            n_nodes=jumps.length,
        )
        done, likely = filter_window(self.model, self.inputs, own, test, first, end)
        return own, first + done, likely

    def _read_nodes(
        self,
        i: int,
        part: tuple[int, int],
        P_local: np.ndarray,
        U: np.ndarray,
        innovation: np.ndarray,
    ) -> None:
        """Read the nodes held, at the moments within the `part` (first, last) of the window."""
        times, first, n = self.nodes.times, self.road.first_sum, self.road.n_states
        here = times.within(part)
        blocks = times.block[here] - part[0]
        if blocks.size == 0:
            return
        adjoint = np.zeros((blocks.size, U.shape[1]))
        if blocks.any():
            sums = np.cumsum(U * innovation[:, None], axis=0)
            adjoint[blocks > 0] = sums[3 * blocks[blocks > 0] - 1]
        self.nodes.adjoint[here, : U.shape[1]] = adjoint
        x = self.state.x[first:] + adjoint @ P_local[:, first:n]
        nodes = x[:, N_SUMS:].reshape(blocks.size, -1, 2)[:, ::-1]
        oldest = self.schedule.oldest[i + 1]
        base = times.base[here]
        at = 2 + oldest - base[:, None] + np.arange(nodes.shape[1])
        self.nodes.c[np.arange(here.start, here.stop)[:, None], at] = nodes
        held = np.flatnonzero(base == oldest)
        self.nodes.c[here.start + held, :2] = x[held, :N_SUMS].reshape(-1, 2, 2).swapaxes(1, 2)

    def _read_bands(self, i: int, part: tuple[int, int], local: np.ndarray, U: np.ndarray) -> None:
        """Read the variances at the moments within the `part` (first, last) of the window."""
        bands, n, P = self.bands, self.road.n_states, self._P
        times, oldest, newest = bands.times, self.schedule.oldest[i + 1], self.schedule.newest[i]
        here = times.within(part)
        for f in range(here.start, here.stop):
            held = 2 + oldest - times.base[f]
            nodes = bands.weights[f, held : held + newest - oldest + 1][::-1]
            weights = np.zeros((2, n))
            weights[:, self.road.first_node :: 2] = nodes
            weights[:, self.road.first_node + 1 :: 2] = nodes, -nodes
            xi, variance = weights @ P[:, :n], np.zeros(2)
            if times.first[f] <= i:  # some nodes have left
                at = 2 * (f % bands.slots)
                left = P[:, n + at : n + at + 2].T
                variance = self._variance[at : at + 2] + 2.0 * np.sum(weights * left, axis=1)
                variance += np.sum(weights * xi, axis=1)
                xi = xi + left
                P[:, n + at : n + at + 2] = 0.0  # what is no longer read would decay to denormals
            else:
                first = self.road.first_sum
                sums = bands.weights[f, :2]
                weights[:, first : first + 2] = sums
                weights[:, first + 2 : first + 4] = sums, -sums
                xi = weights @ P[:, :n]
                variance = np.sum(weights * xi, axis=1)
            corrections = U[: 3 * (times.block[f] - part[0])] @ xi[:, local].T
            bands.variance[f] = variance - np.sum(corrections**2, axis=0)
            if bands.covariance is not None:
                bands.covariance[f] = xi
