"""The extended Kalman filter, block after block: foretell, hear, go on.

The readings of a block hang on where the car was at its beginning, on the nodes that it passed
and on what forces its struts held; all are corrected by what was heard, and then the car goes on by
the same steps. As nothing but the car moves, the covariance changes in the car's rows alone, and
what a rear wheel tells of a node that the front wheel passed long ago is told of the same number.
(Kailath, Sayed & Hassibi, "Linear Estimation", 2000, chapter 9; Jazwinski, "Stochastic Processes
and Filtering Theory", 1970, section 8.3.)
"""

import numpy as np

from estimators.kalman.friction_linearization import blur
from estimators.kalman.linearization import linearise
from estimators.kalman.profile_output import tell
from estimators.kalman.road_process import add_node, learn_level
from estimators.kalman.state import CAR, EXCESS, Block, Model, State, Way, at_block
from road_envs._numba import kernel, separate

FAR = 16.0
"""Square of the news of a block, per reading, from which they count as only so much."""


@separate
def forward(model: Model, way: Way, state: State, first, last, tells, blocks: Block):
    """Filter the blocks from `first` to before `last`, telling each station when its time comes.

    `blocks` holds one, used again and again, or one for each. `tells`: as `tell` wants them.
    """
    keeps = blocks.size.shape[0] > 1
    for j in range(first, last):
        block = at_block(blocks, j - first if keeps else 0)
        ahead = way.x[2 * (j + 1) * model.per - 1]
        tell(model, state, tells, j)
        block.added[0] = 0
        while np.floor(ahead) + 2 > state.newest[0]:
            middle = state.newest[0] + 0.5
            add_node(model, state, way.free[0] < middle < way.free[1])
            rear = int(np.floor(way.x[2 * j * model.per] - model.behind)) - 1
            learn_level(model, state, rear, way.free)
            block.added[0] += 1
        blur(model, state)
        linearise(model, way, state, j, block)
        hear(model, state, way.y[:, j], way.samples[:, j], block)
        go_on(state, block)


@separate
def add_rows(weights, P, at, size, out):
    """Add the rows `at` (size,) of `P` (n, n), with their `weights`, to `out` (n,)."""
    for d in range(size):
        weight, row = weights[d], P[at[d]]
        if weight != 0.0:
            for k in range(out.size):
                out[k] += weight * row[k]


@kernel
def along(weights, row, at, size):
    """The sum over the entries `at` (size,) of a `row` (n,), with their `weights`."""
    z = 0.0
    for d in range(size):
        z += weights[d] * row[at[d]]
    return z


@separate
def hear(model: Model, state: State, y, count, block: Block):
    """Correct mean and covariance by the means `y` (3,) of `count` (3,) samples; 0 is no reading.

    One reading after the other, each in units of its deviation once the ones before it are known,
    which is what remains of the covariance's Cholesky factor.
    """
    x, P, n, size = state.x, state.P, state.x.size, block.size[0]
    V, H, news, at = block.V, block.H, block.news, block.at
    excess, seen = state.learnt[EXCESS], 0
    V[:] = 0.0
    both = np.empty(3)
    for s in range(3):
        news[s] = 0.0
        if count[s] == 0.0:
            H[s] = 0.0
            continue
        seen += 1
        add_rows(H[s], P, at, size, V[s])
        least = excess * model.noise / count[s]
        variance = least + along(H[s], V[s], at, size)
        for r in range(s):
            both[r] = along(H[s], V[r], at, size)
            variance -= both[r] ** 2
        news[s] = y[s] - block.mean[s]
        for r in range(s):
            V[s] -= both[r] * V[r]
            H[s] -= both[r] * H[r]
            news[s] -= both[r] * news[r]
        unit = 1.0 / np.sqrt(max(variance, least))
        V[s] *= unit
        H[s] *= unit
        news[s] *= unit
    square = news[0] ** 2 + news[1] ** 2 + news[2] ** 2
    if seen > 0:
        mean = min(square / seen, FAR)
        state.learnt[EXCESS] = max(1.0, excess * (1.0 + (mean - 1.0) / model.patience))
    if square > FAR * seen:
        news *= np.sqrt(FAR * seen / square)
    for s in range(3):
        x += news[s] * V[s]
    for i in range(n):
        a, b, c = V[0, i], V[1, i], V[2, i]
        for k in range(n):
            P[i, k] -= a * V[0, k] + b * V[1, k] + c * V[2, k]


@separate
def go_on(state: State, block: Block):
    """Bring the car to the block's end: by the full equations from where it was believed to be, by
    their slope for what was heard.
    """
    x, P, n, size = state.x, state.P, state.x.size, block.size[0]
    A, V, news, at = block.A, block.V, block.news, block.at
    rows = np.zeros((CAR, n))
    for i in range(CAR):
        z = block.end[i]
        for d in range(size):
            k = at[d]
            z += A[i, d] * (news[0] * V[0, k] + news[1] * V[1, k] + news[2] * V[2, k])
        add_rows(A[i], P, at, size, rows[i])
        x[i] = z
    for i in range(CAR):
        P[i, CAR:] = rows[i, CAR:]
        P[CAR:, i] = rows[i, CAR:]
        for k in range(i + 1):
            z = along(A[k], rows[i], at, size)
            P[i, k] = z
            P[k, i] = z
