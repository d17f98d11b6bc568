"""Steps of the road that its stationary prior does not expect: edges of obstacles.

The increments of the road are Gaussian but for a few, whose variance is larger by jump_std². Which
ones is decided by the log likelihood ratio of the innovations (generalized likelihood ratio test:
Willsky & Jones, IEEE Trans. Automatic Control 21, 1976, doi:10.1109/TAC.1976.1101146). Each recent
node of each wheel path is a candidate. Had it a step b, the state would err by the `direction` f
times b and the whitened innovation e would have the mean g b with g = H f, so

    score l = sum g' e     information C = sum g' g     b ~ N(v l, v), v = 1 / (C + 1 / jump_std²)

is exact for the linearized vehicle (Friedland, IEEE Trans. Automatic Control 14, 1969,
doi:10.1109/TAC.1969.1099223), and the log likelihood ratio of a step to none is

    (v l² - log(jump_std² / v)) / 2

The most likely candidate enters the state, as if its increment had had that variance from the
beginning, and the others are conditioned on it, until none exceeds `min_log_ratio`.
"""

from dataclasses import dataclass

import numpy as np

from estimators.kalman.state import NOISE_SCALE, LocalState, StepTest
from estimators.kalman.tuning import TUNING
from road_envs.kernels._numba import kernel

_JUMP_STD, _MIN_LOG_RATIO = TUNING.jump_std, TUNING.min_log_ratio
_MIN_INFORMATION = TUNING.min_information


@kernel(inline=False)
def _most_likely(score, information, reached, n_nodes):
    """Return the most likely candidate of the `n_nodes` nodes up to the number `reached`, from
    `score` (m,) and `information` (m, m), and its log likelihood ratio.
    """
    best, most, m, prior = -1, 0.0, score.size, _JUMP_STD**2
    for c in range(m):
        ratio = prior * information[c, c]
        if ratio < _MIN_INFORMATION or (reached - c // 2) % (m // 2) >= n_nodes:
            continue
        gain = 0.5 * (prior * score[c] ** 2 / (1.0 + ratio) - np.log1p(ratio))
        if gain > most:
            best, most = c, gain
    return best, most


@kernel(inline=False)
def step_is_likely(test: StepTest, local: LocalState, i):
    """Update the scores by a window's `i`-th block; return if a candidate is to be accepted."""
    block = slice(3 * i, 3 * i + 3)
    response = np.dot(local.U[block], test.direction)
    _add_information(test.score, test.information, response, local.innovation[block])
    if test.near_step[i]:
        return False
    _, most = _most_likely(test.score, test.information, test.reached[i], test.n_nodes)
    return most > _MIN_LOG_RATIO * local.adaptive[NOISE_SCALE]


@kernel
def _add_information(score, information, response, innovation):
    """Update `score` (m,) and `information` (m, m) of the candidates by a whitened `innovation`
    (R,), whose mean is `response` (R, m) per unit step.
    """
    for s in range(innovation.size):
        for c in range(score.size):
            share = response[s, c]
            score[c] += innovation[s] * share
            for d in range(score.size):
                information[c, d] += share * response[s, d]


@dataclass(frozen=True, eq=False)
class AcceptedStep:
    """A step of `size` [m] of the `candidate` at a `node`, in the `direction` (n,), its `variance`
    [m²] by the innovations and the one `added` [m²] to the state, and the information (m,) [1/m²]
    that the innovations have on it and each other candidate, `cross`.
    """

    candidate: int
    node: int
    size: float
    direction: np.ndarray
    variance: float
    added: float
    cross: np.ndarray


@dataclass(frozen=True, eq=False)
class RoadJumps:
    """Candidates and accepted steps; candidate 2 k + side, modulo their number m, is that of node
    k in the left (0) or right (1) wheel path. `score` (m,) [1/m]; `information` (m, m) [1/m²];
    `square` (N, 2) [m²]: squares of the accepted steps of each node of the drive; `near` (N,):
    whether one is near it. In nodes: `length` and `rear_reach`, as in the tuning.
    """

    score: np.ndarray
    information: np.ndarray
    square: np.ndarray
    near: np.ndarray
    length: int
    rear_reach: int

    @classmethod
    def none(cls, ahead: float, nodes: int, ds: float) -> "RoadJumps":
        """Return no steps, in a drive of so many `nodes`, which are `ds` [m] apart and enter the
        state up to `ahead` [m] before the front axle has reached them.
        """
        m, length = 2 * round((TUNING.jump_length + ahead) / ds), round(TUNING.jump_length / ds)
        score, information, reach = np.zeros(m), np.zeros((m, m)), round(TUNING.rear_reach / ds)
        near = np.zeros(nodes, dtype=bool)
        return cls(score, information, np.zeros((nodes, 2)), near, length, reach)

    def begin(self, nodes: np.ndarray) -> np.ndarray:
        """Replace the oldest candidates by those of new `nodes` (M,); return them (2 M,)."""
        candidates = (2 * nodes[:, None] + np.arange(2)).ravel() % self.score.size
        self.score[candidates] = 0.0
        self.information[candidates] = 0.0
        self.information[:, candidates] = 0.0
        return candidates

    def add(self, node: int, side: int, step: float) -> None:
        """Add a `step` [m] at a `node` in a wheel path."""
        self.square[node, side] += step**2
        self.near[max(node - self.rear_reach + 1, 0) : node + self.rear_reach + 1] = True

    def accept(
        self, x: np.ndarray, P: np.ndarray, direction: np.ndarray, reached: int, least: float
    ) -> list[AcceptedStep]:
        """Add the steps of a log likelihood ratio of more than `least`, of nodes up to the number
        `reached`, to the state, of mean `x` (n,) and covariance `P` (n, n), with the `direction`
        (n, m) of each candidate.
        """
        score, information, accepted = self.score, self.information, list[AcceptedStep]()
        m, prior = score.size, _JUMP_STD**2
        for _ in range(TUNING.max_jumps):
            best, most = _most_likely(score, information, reached, self.length)
            if most <= least:
                break
            variance = prior / (1.0 + prior * information[best, best])
            step = variance * score[best]
            f, cross = direction[:, best].copy(), information[best].copy()
            added = variance + (TUNING.relative_error * step) ** 2
            x += step * f
            P += np.outer(added * f, f)
            score -= step * cross
            direction -= np.outer(f, variance * cross)
            information -= np.outer(variance * cross, cross)
            node = reached - (reached - best // 2) % (m // 2)
            self.add(node, best % 2, step)
            accepted.append(AcceptedStep(best, node, step, f, variance, added, cross))
        return accepted
