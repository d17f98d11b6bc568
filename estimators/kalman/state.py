"""What the filter holds for true, and where in its vector each part of it stands.

    x = [car (14), forces (4), zeros (3), fading sums (4), nodes (2 K)]

The car is its coordinates and rates. Forces [N] are what the struts hold beside their linearised
laws in the block of readings at hand. Zeros [m/s²] are the sensors' offsets. The road is K nodes of
a spline, fixed in space: mean and half difference of the wheel paths side by side, node k at
NODES + 2 (k mod K), so that a new node takes the place of the oldest and nothing is moved. What
leaves goes on in fading sums, real and imaginary part for the mean, then for the half difference,

    sum over k < oldest of c_k exp(-(1 + i) fade (oldest - k))

which is all that long waves need to know of the road behind (`telling.py`).
"""

from typing import NamedTuple

import numpy as np

from road_envs._numba import kernel
from road_envs.vehicle.equations import N_DOF

CAR = 2 * N_DOF
FORCE, ZERO, FADING, NODES = CAR, CAR + 4, CAR + 7, CAR + 11
LEVEL, SUM, WEIGHT, EXCESS = 0, 1, 2, 3
"""What is learnt on the way: roughness over the prior's, the sums it comes from, and how many times
the noise that the model expects the readings seem to hold."""


class Model(NamedTuple):
    """What does not change on the way. Lengths along the road are in nodes.

    A plant's `numbers`, `velocity` (one set of tables after the other for each of the `widths`
    (W,) [m/s]), `displacement`; `first` (4,) the number of each strut's table; `left` (W, K, V)
    [N²] what is not linear in the force over a rate that is `widths` uncertain. Levers over the
    coordinates: `struts` (4, 7), `sensors` (3, 7). `push` (4, 7): accelerations by a strut's force;
    `felt` (3, 4): the sensors' share of it. `ahead` (2, order), `surprise` (2,) [m²]: the next node
    from the last ones; `rise` (2,) [m²]: variance of the rise over `reach` nodes; `memory`: nodes
    over which roughness is taken together. `h` [s], `per` steps a block, a sample `every` so many;
    `lag` [s] of the valves; `behind`: wheelbase; `fade`, per node; `noise` [(m/s²)²] of a sample,
    found greater over `patience` blocks.
    """

    numbers: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray
    first: np.ndarray
    widths: np.ndarray
    left: np.ndarray
    struts: np.ndarray
    sensors: np.ndarray
    push: np.ndarray
    felt: np.ndarray
    ahead: np.ndarray
    surprise: np.ndarray
    rise: np.ndarray
    reach: int
    memory: float
    h: float
    per: int
    every: int
    lag: float
    behind: float
    fade: float
    noise: float
    patience: float


class Way(NamedTuple):
    """The drive: at every half step `x` (2 N,), the node number of the front axle, and `rate`
    (2 N,) nodes passed in a second; `commands` (N,); block means `y` (3, J) [m/s²] of so many
    `samples` (3, J); between the node numbers `free` (2,) the road may rise or fall.
    """

    x: np.ndarray
    rate: np.ndarray
    commands: np.ndarray
    y: np.ndarray
    samples: np.ndarray
    free: np.ndarray


class State(NamedTuple):
    """Mean `x` (n,) and covariance `P` (n, n); `struts` (4, 3), the struts' memory; `newest` (1,),
    the number of the last node; `learnt` (4,).
    """

    x: np.ndarray
    P: np.ndarray
    struts: np.ndarray
    newest: np.ndarray
    learnt: np.ndarray


class Block(NamedTuple):
    """One block of readings, linearised, and what was learnt from it.

    On the `size` (1,) entries `at` (D,) of the vector: `A` (14, D), what the car will be; `H`
    (3, D), what the sensors hear, in units of the readings' own deviation once `heard` has seen
    them; `V` (3, n) and `news` (3,): x' = x + V' news, P' = P - V' V. `end` (14,): the car by the
    full equations; `mean` (3,): the readings they foretell. `added` (1,): nodes new in the block.
    """

    size: np.ndarray
    at: np.ndarray
    A: np.ndarray
    H: np.ndarray
    V: np.ndarray
    news: np.ndarray
    end: np.ndarray
    mean: np.ndarray
    added: np.ndarray


def empty(n: int, columns: int, blocks: int) -> Block:
    """Blocks, one behind the other along the first axis."""
    return Block(
        size=np.zeros((blocks, 1), dtype=np.int64),
        at=np.zeros((blocks, columns), dtype=np.int64),
        A=np.zeros((blocks, CAR, columns)),
        H=np.zeros((blocks, 3, columns)),
        V=np.zeros((blocks, 3, n)),
        news=np.zeros((blocks, 3)),
        end=np.zeros((blocks, CAR)),
        mean=np.zeros((blocks, 3)),
        added=np.zeros((blocks, 1), dtype=np.int64),
    )


@kernel
def slot(k, n):
    """Where in a vector of `n` the mean of node `k` stands; the half difference stands behind."""
    return NODES + 2 * (k % ((n - NODES) // 2))


@kernel
def at_block(blocks, j):
    """The block `j` of many, as views."""
    return Block(
        blocks.size[j],
        blocks.at[j],
        blocks.A[j],
        blocks.H[j],
        blocks.V[j],
        blocks.news[j],
        blocks.end[j],
        blocks.mean[j],
        blocks.added[j],
    )
