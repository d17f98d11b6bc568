"""Fixed-lag and whole-drive smoother, in the backward form of de Jong and of Bryson and Frazier.

With r (n,) and N (n, n) accumulated from the innovations of later windows, the smoothed mean and
covariance at any moment are

    x + P r,     P - P N P

Only the covariances of the nodes that leave with the state must be stored, and no matrix is
inverted. A window moves the vehicle's error by Phi, updates the rest by its innovations, of
covariance W with the state, and has the derivative D of the error by the local error. Through it

    r[local] = D' r' + U' innovation,     N[local, local] = D' N' D + U' U,     N[:, local] = N' D
    D' r' = r'[local] + U' (innovation - W r') of the rest + Phi' r'[vehicle]

and through a step x' = F x of the nodes r = F' r', N = F' N' F (de Jong 1989, J. Am. Stat. Assoc.
84, 1085; Durbin & Koopman, "Time Series Analysis by State Space Methods", 2012, section 4.4).

For the whole drive there is one r. With a fixed lag there is one for each moment at which heights
are emitted, which begins there, and ends as the last of its nodes leaves.
"""

import numpy as np

from estimators.kalman.filtered import BandVariance, FilteredWindow, NodesAtEmission
from estimators.kalman.road_process import RoadProcess, transpose_nodes
from estimators.kalman.state import N_SUMS


def smooth_backward(
    road: RoadProcess,
    windows: list[FilteredWindow],
    oldest: np.ndarray,
    nodes: NodesAtEmission,
    *,
    entering: slice | None = None,
    bands: BandVariance | None = None,
    corrected: int = 0,
) -> None:
    """Smooth the nodes that leave in `windows`, before each of which the oldest node was `oldest`
    (W,), at the moments `entering`, or, if None, at the only one, behind the last window. Then the
    variances of `bands` in the windows before the number `corrected` are smoothed, too.
    """
    times, n = nodes.times, road.n_states
    live = np.zeros(1 if entering is None else 0, dtype=int)
    r, N, steps = np.zeros((n, live.size)), np.zeros((n, n)), dict[int, np.ndarray]()
    for window in reversed(windows):
        i, local, U, vehicle = window.index, window.local, window.U, len(window.transition)
        for step in window.accepted:
            steps[id(step)] = step.size + step.added * (step.direction[:n] @ r)
        steps = {id(step): steps[id(step)] for step, *_ in window.corrections}
        moved, r[:vehicle] = window.transition.T @ r[:vehicle], 0.0
        r[local] += moved + U.T @ (window.innovation[:, None] - window.W @ r)
        for step, change, _ in window.corrections:
            r[local] -= np.outer(change, steps[id(step)])
        if entering is not None:
            emitted = times.within(window.blocks)
            new = np.arange(max(emitted.start, entering.start), min(emitted.stop, entering.stop))
            new = new[times.first[new] <= i]
            start = np.zeros((n, new.size))
            start[local] = nodes.adjoint[new, : local.size].T
            r, live = np.concatenate([start, r], axis=1), np.concatenate([new, live])
            # a step is not known before it is accepted
            steps = {k: np.append(np.zeros(new.size), size) for k, size in steps.items()}
        if bands is not None:
            D = window.error_derivative()
            moved = N @ D
            inner = D.T @ moved + U.T @ U
            N[:, local], N[local] = moved, moved.T
            N[np.ix_(local, local)] = inner
            if i < corrected and len(bands.covariance) > 0:
                here = bands.times.within(window.blocks)
                at_start = bands.times.block[here] == window.blocks[0]
                covariance = bands.covariance[here][at_start]
                reduction = np.einsum("fsi,ij,fsj->fs", covariance, N, covariance, optimize=True)
                bands.variance[here][at_start] -= reduction
        if window.leaving.size == 0:
            continue
        left_nodes = int(oldest[i]), int(oldest[i + 1])
        transpose_nodes(road, left_nodes, r)
        if bands is not None:
            transpose_nodes(road, left_nodes, N)
            N = N.T.copy()
            transpose_nodes(road, left_nodes, N)
            N = 0.5 * (N + N.T)  # the asymmetry of rounding would grow from window to window
        if live.size == 0:
            continue
        left = window.leaving[:, None] + window.covariance @ r
        for step, _, direction in window.corrections:
            left += np.outer(direction, steps[id(step)])
        at = 2 + oldest[i] - times.base[live]
        leave = left[N_SUMS:].reshape(-1, 2, live.size)
        nodes.c[live[:, None], at[:, None] + np.arange(leave.shape[0])] = leave.transpose(2, 0, 1)
        done = times.first[live] == i
        if done.any():
            nodes.c[live[done], :2] = left[:N_SUMS, done].T.reshape(-1, 2, 2)
            live, r = live[~done], r[:, ~done].copy()
            steps = {k: size[~done] for k, size in steps.items()}
