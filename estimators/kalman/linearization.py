"""One block of readings as the full equations foretell it, and its slope by all that it hangs on.

The car is driven through the block by the simulator's own step, over the nodes as they are
believed to be, and every column of the slope is the exact tangent of these steps
(`road_envs.simulation.sensitivity`). A force beside a strut's law pushes all through the block.
"""

import numpy as np

from estimators.common.spline import height_weights, slope_weights
from estimators.kalman.state import CAR, FORCE, ZERO, Block, Model, State, Way, slot
from road_envs._numba import separate
from road_envs.simulation.rosenbrock import ACCELERATION, SIGNALS, follow, workspace
from road_envs.simulation.sensitivity import ROW, tangent_step, taped_step
from road_envs.vehicle.equations import N_DOF

OWN = ZERO + 3
"""Columns that every block has: car, forces, zeros."""


def columns(nodes_in_block: float) -> int:
    """Columns at most, of blocks in which a wheel passes so many nodes."""
    return OWN + 4 * (int(np.ceil(nodes_in_block)) + 5)


@separate
def under_axles(way: Way, behind, first, per, node, heights, slopes):
    """For both half steps of `per` steps from `first` and both axles: the first `node` (per, 2, 2)
    of the four that carry the wheels, and their shares (per, 2, 2, 4) in height and its rate.
    """
    for k in range(per):
        for half in range(2):
            for axle in range(2):
                now = 2 * (first + k) + half
                x = way.x[now] - axle * behind
                i = int(np.floor(x))
                node[k, half, axle] = i - 1
                a, b = height_weights(x - i), slope_weights(x - i)
                for m in range(4):
                    heights[k, half, axle, m] = a[m]
                    slopes[k, half, axle, m] = b[m] * way.rate[now]


@separate
def linearise(model: Model, way: Way, state: State, j, block: Block):
    """Fill the block `j`: its columns, its slopes and what it foretells. The struts' memory goes on
    to its end, the car in `state` does not.
    """
    per = model.per
    first = j * per
    node = np.empty((per, 2, 2), dtype=np.int64)
    shares, slopes = np.empty((per, 2, 2, 4)), np.empty((per, 2, 2, 4))
    under_axles(way, model.behind, first, per, node, shares, slopes)
    rows = np.empty((per, ROW))
    drive(model, way, state, first, node, shares, slopes, rows, block)
    n, size = state.x.size, OWN
    block.A[:] = 0.0
    block.H[:] = 0.0
    for i in range(OWN):
        block.at[i] = i
    for i in range(CAR):
        column(model, first, rows, node, shares, slopes, i, 0, 0, 0, block)
    time = per * model.h
    for w in range(4):
        for i in range(N_DOF):
            block.A[i, FORCE + w] = 0.5 * time * time * model.push[w, i]
            block.A[N_DOF + i, FORCE + w] = time * model.push[w, i]
        for s in range(3):
            block.H[s, FORCE + w] = model.felt[s, w]
    for s in range(3):
        block.H[s, ZERO + s] = 1.0
    for axle in range(2):
        for k in range(node[0, 0, axle], node[per - 1, 1, axle] + 4):
            for part in range(2):
                block.at[size] = slot(k, n) + part
                column(model, first, rows, node, shares, slopes, size, axle, k, part, block)
                size += 1
    block.size[0] = size


@separate
def drive(model: Model, way: Way, state: State, first, node, shares, slopes, rows, block: Block):
    """Drive through the block on tape: its `rows`, where it ends and what the sensors hear."""
    p, work, out = model.numbers[0], workspace(), np.empty(SIGNALS)
    q, v = state.x[:N_DOF].copy(), state.x[N_DOF:CAR].copy()
    road, still = np.empty(16), np.zeros(4)
    alpha = 1.0 - np.exp(-model.h / model.lag)
    n, samples = state.x.size, 0
    block.mean[:] = 0.0
    for k in range(rows.shape[0]):
        for half in range(2):
            for axle in range(2):
                for side in range(2):
                    z, rate = 0.0, 0.0
                    for m in range(4):
                        i = slot(node[k, half, axle] + m, n)
                        c = state.x[i] + (1.0 - 2.0 * side) * state.x[i + 1]
                        z += shares[k, half, axle, m] * c
                        rate += slopes[k, half, axle, m] * c
                    road[8 * half + 2 * axle + side] = z
                    road[8 * half + 4 + 2 * axle + side] = rate
        follow(p, state.struts, q, way.commands[first + k], alpha, model.h)
        laws = (p, model.velocity, model.displacement, state.struts)
        taped_step(*laws, q, v, road, still, model.h, work, out, rows[k])
        if (first + k) % model.every == 0:
            samples += 1
            for s in range(3):
                for i in range(N_DOF):
                    block.mean[s] += model.sensors[s, i] * out[ACCELERATION + i]
    for s in range(3):
        block.mean[s] = block.mean[s] / samples + state.x[ZERO + s]
    block.end[:N_DOF] = q
    block.end[N_DOF:] = v


@separate
def column(model: Model, first, rows, node, shares, slopes, to, axle, k, part, block: Block):
    """Write the tangent along one direction to the columns `to` of A and H: the car's own, or with
    `to` behind them that of the node `k` under an `axle`, its mean or its half difference.
    """
    p, work, a = model.numbers[0], workspace(), np.empty(N_DOF)
    q, v, road = np.zeros(N_DOF), np.zeros(N_DOF), np.zeros(16)
    if to < N_DOF:
        q[to] = 1.0
    elif to < CAR:
        v[to - N_DOF] = 1.0
    samples = 0
    for i in range(rows.shape[0]):
        if to >= CAR:
            for half in range(2):
                m = k - node[i, half, axle]
                inside = 0 <= m < 4
                for side in range(2):
                    sign = -1.0 if part == 1 and side == 1 else 1.0
                    wheel = 8 * half + 2 * axle + side
                    road[wheel] = sign * shares[i, half, axle, m] if inside else 0.0
                    road[4 + wheel] = sign * slopes[i, half, axle, m] if inside else 0.0
        tangent_step(p, rows[i], q, v, road, model.h, work, a)
        if (first + i) % model.every == 0:
            samples += 1
            for s in range(3):
                for d in range(N_DOF):
                    block.H[s, to] += model.sensors[s, d] * a[d]
    for s in range(3):
        block.H[s, to] /= samples
    block.A[:N_DOF, to] = q
    block.A[N_DOF:, to] = v
