"""The tangent of a drive as matrices, one for each short part of it.

Conjugate gradients apply tangent and adjoint dozens of times about one motion. Most of that work is
the same each time, so it is done once: in a part of some hundredths of a second the change of the
state y and the sensed block means m are

    (y after, m) = P (y before, c)        c: the spline's coefficients under its four wheels

The columns of P are unit changes, carried through the part by `tangent_step`, LANES at a time. Then
a tangent is one product with each P from the first part to the last, and its transpose one with
each P' backwards. Both are ten times and more as quick as the steps themselves.
"""

from dataclasses import dataclass

import numpy as np

from estimators.common.block_means import Readings
from estimators.common.model_inputs import Course
from estimators.common.spline import height_weights, place, slope_weights
from estimators.map_smoother.road_prior import Road
from road_envs._numba import kernel
from road_envs.simulation.rosenbrock import Work
from road_envs.simulation.sensitivity import Tape, tangent_step
from road_envs.simulation.simd import LANES, get, lane, put, splat
from road_envs.vehicle.equations import N_DOF

STATE = 2 * N_DOF
ROWS = 32
"""Numbers that a part gives at most: state and block means."""

_SIZES = dict(zip(Work._fields, [N_DOF] * 6 + [4] * 8 + [12, 6], strict=True))
_WORK = np.dtype([(name, "f8", (size, LANES)) for name, size in _SIZES.items()])


@kernel
def see_nodes(s, rate, first, width, size, behind, road):
    """Rows 0 ... 7 of `road` (G, 16, LANES), or 8 ... 15: what a unit of each coefficient does.

    `s`, `rate` (2,): node number of the front axle and nodes passed in a second at both half steps;
    `first` (2,): the first of `width` nodes that the axles see in this part.
    """
    road[:] = 0.0
    for half in range(2):
        for axle in range(2):
            i, t = place(s[half] - axle * behind, size)
            z, w = height_weights(t), slope_weights(t)
            for side in range(2):
                wheel = 2 * axle + side
                column = 2 * N_DOF + wheel * width + i - 1 - first[axle]
                for k in range(4):
                    group, at = (column + k) // LANES, (column + k) % LANES
                    road[group, 8 * half + wheel, at] = z[k]
                    road[group, 8 * half + 4 + wheel, at] = w[k] * rate[half]


@kernel
def fill_parts(
    numbers, rows, h, s, rate, behind, size, first, width, every, share, levers, work, P
):
    """Write the matrices of all parts to `P` (M, C, ROWS), a column of the matrix in each row.

    `rows` (N, ROW) of the tape, `s`, `rate` (2 N,) as `see_nodes` has them, `first` (M, 2);
    `share` (S, J, b) of the samples, one in `every` steps, in their block means; `levers` (S, 7).
    """
    p, groups = numbers[0], P.shape[1] // LANES
    sensors, blocks, block = share.shape
    each = (ROWS - 2 * N_DOF) // sensors
    y, a = np.empty((groups, 2 * N_DOF, LANES)), np.empty((N_DOF, LANES))
    means, road = np.empty((groups, sensors * each, LANES)), np.empty((groups, 16, LANES))
    for m in range(P.shape[0]):
        y[:], means[:] = 0.0, 0.0
        for j in range(2 * N_DOF):
            y[j // LANES, j, j % LANES] = 1.0
        last = min((m + 1) * each, blocks)
        for n in range(m * each * block * every, last * block * every):
            two = slice(2 * n, 2 * n + 2)
            see_nodes(s[two], rate[two], first[m], width, size, behind, road)
            sample = n // every
            at = sample // block
            for group in range(groups):
                q, v = y[group, :N_DOF], y[group, N_DOF:]
                tangent_step(p, rows[n], q, v, road[group], h, work, a)
                if n % every == 0:
                    for i in range(sensors):
                        sensed = splat(0.0)
                        for j in range(N_DOF):
                            sensed = sensed + levers[i, j] * get(a, j)
                        k = i * each + at - m * each
                        part = share[i, at, sample % block]
                        put(means[group], k, get(means, group, k) + part * sensed)
        for column in range(P.shape[1]):
            group, at = column // LANES, column % LANES
            for j in range(2 * N_DOF):
                P[m, column, j] = y[group, j, at]
            for k in range(sensors * each):
                P[m, column, 2 * N_DOF + k] = means[group, k, at]
            for k in range(2 * N_DOF + sensors * each, ROWS):
                P[m, column, k] = 0.0


@kernel
def carry(P, first, width, c, y, means):
    """From a change `y` (14,) of the first state and of coefficients `c` (2, K) to `means` (S, J).

    `P` (M, C, ROWS // LANES, LANES); `y` ends as that of the last state.
    """
    x, out = np.zeros(P.shape[1]), np.empty((P.shape[2], LANES))
    flat, each = out.ravel(), (ROWS - 2 * N_DOF) // means.shape[0]
    used = 2 * N_DOF + 4 * width
    for m in range(P.shape[0]):
        x[: 2 * N_DOF] = y
        for wheel in range(4):
            for k in range(width):
                x[2 * N_DOF + wheel * width + k] = c[wheel % 2, first[m, wheel // 2] + k]
        for group in range(P.shape[2]):
            total = splat(0.0)
            for column in range(used):
                total = total + x[column] * get(P, m, column, group)
            put(out, group, total)
        y[:] = flat[: 2 * N_DOF]
        for i in range(means.shape[0]):
            for j in range(m * each, min((m + 1) * each, means.shape[1])):
                means[i, j] = flat[2 * N_DOF + i * each + j - m * each]


@kernel
def carry_back(P, first, width, means, y, c):
    """The transpose of `carry`: from `means` (S, J) to `y` (14,), which begins as the end's
    adjoint, and the coefficients `c` (2, K).
    """
    inside, out = np.zeros((P.shape[2], LANES)), np.empty(P.shape[1])
    flat, each = inside.ravel(), (ROWS - 2 * N_DOF) // means.shape[0]
    used = 2 * N_DOF + 4 * width
    c[:] = 0.0
    for m in range(P.shape[0] - 1, -1, -1):
        flat[:] = 0.0
        flat[: 2 * N_DOF] = y
        for i in range(means.shape[0]):
            for j in range(m * each, min((m + 1) * each, means.shape[1])):
                flat[2 * N_DOF + i * each + j - m * each] = means[i, j]
        for column in range(used):
            total = splat(0.0)
            for group in range(P.shape[2]):
                total = total + get(inside, group) * get(P, m, column, group)
            x = lane(total, 0)
            for k in range(1, LANES):
                x += lane(total, k)
            out[column] = x
        y[:] = out[: 2 * N_DOF]
        for wheel in range(4):
            for k in range(width):
                c[wheel % 2, first[m, wheel // 2] + k] += out[2 * N_DOF + wheel * width + k]


@dataclass(frozen=True, eq=False)
class Parts:
    """The tangent of one motion: matrices `P` (M, C, ROWS // LANES, LANES), each seeing `width`
    nodes from `first` (M, 2) on under front and rear axle, of `nodes` in all; `shape` (S, J) of the
    block means.
    """

    P: np.ndarray
    first: np.ndarray
    width: int
    nodes: int
    shape: tuple[int, int]

    def tangent(self, start: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Change (S, J) of the block means by one of the first state (14,) and of `c` (2, K)."""
        means, y = np.empty(self.shape), start.copy()
        carry(self.P, self.first, self.width, c, y, means)
        return means

    def transposed(self, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The transpose: from block means (S, J) to the first state (14,) and `c` (2, K)."""
        y, c = np.zeros(STATE), np.empty((2, self.nodes))
        carry_back(self.P, self.first, self.width, means, y, c)
        return y, c


def parts_of(
    tape: Tape, road: Road, course: Course, readings: Readings, levers: np.ndarray, wheelbase: float
) -> Parts:
    """The tangent of the motion on a `tape`, heard by sensors of `levers` (S, 7)."""
    sensors, blocks, block = readings.share.shape
    each = (ROWS - STATE) // sensors
    unit = block * course.every
    x, rate, behind = (course.s - road.start) / road.ds, course.v / road.ds, wheelbase / road.ds
    begin = 2 * unit * each * np.arange(-(-blocks // each))
    end = np.minimum(begin + 2 * unit * each, 2 * unit * blocks) - 1
    low, high = (
        np.clip(np.stack([x[at], x[at] - behind], axis=1), 1.0, road.size - 2.001).astype(int)
        for at in (begin, end)
    )
    width = int((high - low).max()) + 4
    first = np.minimum(low - 1, road.size - width)
    columns = -(-(STATE + 4 * width) // LANES) * LANES
    P = np.empty((begin.size, columns, ROWS))
    fill_parts(
        *(tape.plant.numbers, tape.rows, tape.h, x, rate, behind, road.size, first, width),
        *(course.every, readings.share, levers, np.zeros(1, dtype=_WORK)[0], P),
    )
    return Parts(P.reshape(begin.size, columns, ROWS // LANES, LANES), first, width, road.size,
                 (sensors, blocks))  # fmt: skip
