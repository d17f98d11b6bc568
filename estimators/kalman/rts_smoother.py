"""What was heard later, brought back: the smoother of de Jong and of Bryson and Frazier.

With r (n,) and N (n, n) gathered from the news of all blocks that follow, the road as the whole
drive tells it is, at any moment,

    x + P r,     P - P N P

so that no covariance but those of what is told with what is held must be kept, and nothing is
inverted. Through a step x' = F x both go back as r = F' r', N = F' N' F; through a correction

    r = r' + H' (news - V r'),     N = N' + H' H - H' (V N') - (N' V') H + H' (V N' V') H

with V and H in units of the readings' deviation (de Jong 1989, J. Am. Stat. Assoc. 84, 1085;
Durbin & Koopman, "Time Series Analysis by State Space Methods", 2012, section 4.4).
"""

from typing import NamedTuple

import numpy as np

from estimators.kalman.profile_output import EVERY, Tells
from estimators.kalman.state import CAR, FADING, FORCE, ZERO, Block, Model, Way, at_block, slot
from road_envs._numba import separate


class Later(NamedTuple):
    """What later blocks tell: `r` (n,) and `N` (n, n), at a moment when the last node was the
    `newest` (1,) and the `next` (1,) station was to be told.
    """

    r: np.ndarray
    N: np.ndarray
    newest: np.ndarray
    next: np.ndarray


@separate
def backward(model: Model, way: Way, later: Later, first, last, tells: Tells, blocks: Block):
    """Bring `later` from the block `last` back to `first`, to which `blocks` belong in order.

    What of the stations was told in between is told again. Heights and variances are changed in
    place; without `tells.rows` (0, 2, n) they stay.
    """
    r, N = later.r, later.N
    for j in range(last - 1, first - 1, -1):
        block = at_block(blocks, j - first)
        leave(r, N, block)
        unhear(r, N, block)
        for w in range(FORCE, ZERO):
            r[w] = 0.0
            N[w] = 0.0
            N[:, w] = 0.0
        for _ in range(block.added[0]):
            later.newest[0] -= 1
            middle = later.newest[0] + 0.5
            take_node(model, r, N, later.newest[0], way.free[0] < middle < way.free[1])
            make_even(N)
        while later.next[0] > 0 and (tells.due[later.next[0] - 1] >= j or j == 0):
            later.next[0] -= 1
            retell(r, N, tells, later.next[0])


@separate
def make_even(N):
    """Take off what rounding has made unsymmetrical, which else grows from block to block."""
    for i in range(N.shape[0]):
        for k in range(i):
            z = 0.5 * (N[i, k] + N[k, i])
            N[i, k] = z
            N[k, i] = z


@separate
def retell(r, N, tells: Tells, m):
    """Tell the station `m` again, now with what came later."""
    if tells.rows.shape[0] == 0:
        return
    n = r.size
    for side in range(2):
        row = tells.rows[m, side]
        for k in range(n):
            tells.z[m, side] += row[k] * r[k]
        if m % EVERY == 0:
            band, taken = tells.band[m // EVERY, side], 0.0
            for i in range(n):
                z = 0.0
                for k in range(n):
                    z += N[i, k] * band[k]
                taken += band[i] * z
            tells.variance[m, side] -= taken
    if m % EVERY == 0:
        for k in range(m + 1, min(m + EVERY, tells.at.size)):
            tells.variance[k] = tells.variance[m]


@separate
def leave(r, N, block: Block):
    """The transpose of `filter.go_on`."""
    n, size, A, at = r.size, block.size[0], block.A, block.at
    car, rows = r[:CAR].copy(), N[:CAR].copy()
    r[:CAR] = 0.0
    N[:CAR] = 0.0
    for d in range(size):
        for i in range(CAR):
            r[at[d]] += A[i, d] * car[i]
            for k in range(n):
                N[at[d], k] += A[i, d] * rows[i, k]
    for d in range(size):
        row = N[at[d]]
        cars = row[:CAR].copy()
        row[:CAR] = 0.0
        for e in range(size):
            for i in range(CAR):
                row[at[e]] += cars[i] * A[i, e]
    mirror(N, at, size)


@separate
def mirror(N, at, size):
    """Make the columns `at` (size,) of `N` what its rows are."""
    for d in range(size):
        i = at[d]
        for k in range(N.shape[0]):
            N[k, i] = N[i, k]


@separate
def unhear(r, N, block: Block):
    """Bring a correction back."""
    n, size, H, V, at, news = r.size, block.size[0], block.H, block.V, block.at, block.news
    wanted, VN, VNV = np.empty(3), np.zeros((3, n)), np.zeros((3, 3))
    for s in range(3):
        wanted[s] = news[s]
        for k in range(n):
            wanted[s] -= V[s, k] * r[k]
        for i in range(n):
            for k in range(n):
                VN[s, k] += V[s, i] * N[i, k]
    for s in range(3):
        for t in range(3):
            for k in range(n):
                VNV[s, t] += VN[s, k] * V[t, k]
        VNV[s, s] += 1.0
    for d in range(size):
        row = N[at[d]]
        for s in range(3):
            r[at[d]] += H[s, d] * wanted[s]
            for k in range(n):
                row[k] -= H[s, d] * VN[s, k]
        for e in range(size):
            for s in range(3):
                row[at[e]] -= VN[s, at[d]] * H[s, e]
                for t in range(3):
                    row[at[e]] += H[s, d] * VNV[s, t] * H[t, e]
    mirror(N, at, size)


@separate
def take_node(model: Model, r, N, newest, free):
    """The transpose of `road.add_node`, which made a node ahead of the `newest`."""
    n = r.size
    c, s = np.exp(-model.fade) * np.cos(model.fade), np.exp(-model.fade) * np.sin(model.fade)
    order = model.ahead.shape[1] if free else 1
    for part in (1, 0):
        new, M = slot(newest + 1, n) + part, FADING + 2 * part
        for k in range(order):
            weight, old = model.ahead[part, k] if free else 1.0, slot(newest - k, n) + part
            r[old] += weight * r[new]
            for i in range(n):
                N[old, i] += weight * N[new, i]
        for k in range(order):
            weight, old = model.ahead[part, k] if free else 1.0, slot(newest - k, n) + part
            for i in range(n):
                N[i, old] += weight * N[i, new]
        r[M], r[M + 1] = c * r[M] + s * r[M + 1], c * r[M + 1] - s * r[M]
        r[new] = r[M]
        for i in range(n):
            N[M, i], N[M + 1, i] = c * N[M, i] + s * N[M + 1, i], c * N[M + 1, i] - s * N[M, i]
            N[new, i] = N[M, i]
        for i in range(n):
            N[i, M], N[i, M + 1] = c * N[i, M] + s * N[i, M + 1], c * N[i, M + 1] - s * N[i, M]
            N[i, new] = N[i, M]
