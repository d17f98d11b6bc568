"""Smoother of a whole drive, in the backward form of de Jong and of Bryson and Frazier.

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
"""

import numpy as np

from estimators.kalman.filtered import FilteredWindow
from estimators.kalman.jumps import AcceptedStep
from estimators.kalman.road_process import RoadProcess, transpose_nodes


def smooth_backward(
    road: RoadProcess,
    windows: list[FilteredWindow],
    oldest: np.ndarray,
    c: np.ndarray,
    variance: np.ndarray,
    corrected: int,
) -> None:
    """Write the nodes that leave in `windows`, before each of which the oldest node was `oldest`
    (W,), to `c` (K, 2), mean and half difference from the node `oldest[0]` on, and smooth the
    `variance` (M, 2) of the stations emitted in the windows before the number `corrected`.
    """
    n = road.n_states
    r, N, sizes = np.zeros((n, 1)), np.zeros((n, n)), dict[AcceptedStep, float]()
    for window in reversed(windows):
        i, local, U, vehicle = window.index, window.local, window.U, len(window.transition)
        for step in window.accepted:
            sizes[step] = step.size + step.added * float(step.direction @ r[:, 0])
        moved = window.transition.T @ r[:vehicle]
        r[:vehicle] = 0.0
        r[local] += moved + U.T @ (window.innovation[:, None] - window.W @ r)
        for step, change, _ in window.corrections:
            r[local, 0] -= change * sizes[step]
        D = window.W.T @ -U
        D[local, np.arange(local.size)] += 1.0
        D[:vehicle] = window.transition
        moved = N @ D
        inner = D.T @ moved + U.T @ U
        N[:, local], N[local] = moved, moved.T
        N[np.ix_(local, local)] = inner
        for station, covariance in window.emitted if i < corrected else ():
            variance[station] -= np.sum(covariance @ N * covariance, axis=1)
        if window.leaving.size == 0:
            continue
        first, last = int(oldest[i]), int(oldest[i + 1])
        transpose_nodes(road, first, last, r)
        transpose_nodes(road, first, last, N)
        N = N.T.copy()
        transpose_nodes(road, first, last, N)
        # the asymmetry of rounding would grow from window to window
        N = np.zeros_like(N) if window.restarted else 0.5 * (N + N.T)
        left = window.leaving + window.covariance @ r[:, 0]
        for step, _, direction in window.corrections:
            left += direction * sizes[step]
        c[first - oldest[0] : last - oldest[0]] = left.reshape(-1, 2)
        if window.restarted:  # what is measured later tells nothing of what was before
            r[:] = 0.0
