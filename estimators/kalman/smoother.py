"""Fixed-lag and whole-drive smoother, in the backward form of de Jong and of Bryson and Frazier.

With r (n,) and N (n, n) accumulated from the innovations of later windows, the smoothed mean and
covariance at any moment are

    x + P r,     P - P N P

Only the covariances of the nodes that leave with the state must be stored, and no matrix is
inverted. The innovations of a window have the derivative U by the local error e, and the covariance
W with the state; the vehicle's error then is Phi e. The error of the state has the derivative D by
e: Phi in the rows of the vehicle, 1 - W' U in the others, with 1 for the local entries. Hence

    r[local] = D' r' + U' innovation,     N[local, local] = D' N' D + U' U,     N[:, local] = N' D

and through a step x' = F x of the nodes r = F' r', N = F' N' F (de Jong 1989, J. Am. Stat. Assoc.
84, 1085; Durbin & Koopman, "Time Series Analysis by State Space Methods", 2012, section 4.4).

For the whole drive there is one r. With a fixed lag there is one for each moment at which heights
are emitted, which begins there, and ends as the last of its nodes leaves.
"""

import numpy as np

from estimators.kalman.filtered import BandVariance, FilteredWindow, NodesAtEmission
from estimators.kalman.jumps import AcceptedStep
from estimators.kalman.road_process import RoadProcess, transpose_nodes


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
    # a column for each moment from the first to the last (excluded), of which low to high are live
    first, last = (0, 1) if entering is None else (entering.start, entering.stop)
    r, N, steps = np.zeros((n, last - first)), np.zeros((n, n)), dict[AcceptedStep, np.ndarray]()
    low = 0 if entering is None else last - first
    for window in reversed(windows):
        i, local, U, vehicle = window.index, window.local, window.U, len(window.transition)
        high = min(int(np.searchsorted(times.first, i, side="right")), last) - first
        live = r[:, low:high]
        for step in window.accepted:
            # 0 at moments before, when the step is not yet known
            steps[step] = np.zeros(last - first)
            steps[step][low:high] = step.size + step.added * (step.direction[:n] @ live)
        steps = {step: steps[step] for step, *_ in window.corrections}
        moved = window.transition.T @ live[:vehicle]
        live[:vehicle] = 0.0
        live[local] += moved + U.T @ (window.innovation[:, None] - window.W @ live)
        for step, change, _ in window.corrections:
            live[local] -= np.outer(change, steps[step][low:high])
        if entering is not None:
            emitted = times.within(window.blocks)
            start, stop = max(emitted.start, first), min(emitted.stop, last)
            low = start - first
            r[local, low : max(stop - first, low)] = nodes.adjoint[start:stop, : local.size].T
            live = r[:, low:high]
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
        transpose_nodes(road, left_nodes, r, (low, high))
        if bands is not None:
            transpose_nodes(road, left_nodes, N, (0, n))
            N = N.T.copy()
            transpose_nodes(road, left_nodes, N, (0, n))
            # the asymmetry of rounding would grow from window to window
            N = np.zeros_like(N) if window.restarted else 0.5 * (N + N.T)
        if low >= high:
            continue
        left = window.leaving[:, None] + window.covariance @ live
        for step, _, direction in window.corrections:
            left += np.outer(direction, steps[step][low:high])
        left, moments = left.T.reshape(high - low, -1, 2), np.arange(first + low, first + high)
        at = 2 + oldest[i] - times.base[moments, None] + np.arange(left.shape[1] - 2)
        nodes.c[moments[:, None], at] = left[:, 2:]
        done = times.first[moments] == i
        nodes.c[moments[done], :2] = left[done, :2]
        if window.restarted:  # what is measured later tells nothing of what was before
            live[:] = 0.0
