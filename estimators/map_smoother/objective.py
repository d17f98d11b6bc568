"""The cost of a road: how badly the car would have shaken, and how unlikely the road is.

    cost(x) = 1/2 sum_j (y_j - a_j(x))² / R_j + 1/2 |x|²

x holds the white noise u of the road (2 K), the start's deviation from rest (14) and the sensors'
offsets (S), each in units of its prior standard deviation; a_j are block means of the accelerations
of the nonlinear car; R_j is their noise. The gradient is that of the computed steps
(`road_envs.simulation.sensitivity`), and the Hessian that of Gauss and Newton, I + J' R^-1 J.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.fft import irfft, rfft

from estimators.common.block_means import Readings
from estimators.common.model_inputs import Course
from estimators.common.spline import under_wheels
from estimators.map_smoother.block_tangent import Parts, parts_of
from estimators.map_smoother.road_prior import Road
from road_envs.simulation.sensitivity import Tape, drive_on_tape
from road_envs.vehicle.equations import N_DOF, Plant


@dataclass(frozen=True, eq=False)
class Belief:
    """What is held of car and instruments: the `plant`, the time constant `lag` [s] of its valves,
    its `wheelbase` [m], the sensors' `places` (x, y) [m] and their `levers` (S, 7) over the car's
    coordinates, the variance `noise` [(m/s²)²] of a sample, and the deviation `offset` [m/s²] that
    the sensors' zeros may have.
    """

    plant: Plant
    lag: float
    wheelbase: float
    places: Mapping[str, tuple[float, float]]
    levers: np.ndarray
    noise: float
    offset: float = 0.05


@dataclass(frozen=True, eq=False)
class Problem:
    """One stretch of a drive, which begins in the state `start` (14,), with the prior deviations
    `reach` (14,), and with the struts' `memory` (4, 3).
    """

    belief: Belief
    memory: np.ndarray
    start: np.ndarray
    reach: np.ndarray
    road: Road
    course: Course
    readings: Readings

    @property
    def size(self) -> int:
        """Unknowns."""
        return 2 * self.road.size + 2 * N_DOF + self.belief.levers.shape[0]

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`u` (2, K), the start's deviation (14,) and the offsets (S,), all in their units."""
        u, start, offset = np.split(x, [2 * self.road.size, 2 * self.road.size + 2 * N_DOF])
        return u.reshape(2, -1), self.reach * start, self.belief.offset * offset

    def under_wheels(self, c: np.ndarray) -> np.ndarray:
        """Heights and rates (2 N, 2, 4) under the wheels on the coefficients `c` (2, K)."""
        out = np.empty((self.course.s.size, 2, 4))
        under_wheels(c, *self._along, out)
        return out

    @property
    def _along(self) -> tuple[np.ndarray, np.ndarray, float]:
        ds = self.road.ds
        x = (self.course.s - self.road.start) / ds
        return x, self.course.v / ds, self.belief.wheelbase / ds

    def drive(self, x: np.ndarray, plant: Plant | None = None) -> Tape:
        """The car's motion on the road of `x`. Raises ArithmeticError if it is not finite."""
        u, start, _ = self.split(x)
        return drive_on_tape(
            plant or self.belief.plant,
            self.memory,
            self.start + start,
            self.under_wheels(self.road.coefficients(u)),
            self.course.h,
            commands=self.course.commands,
            lag=self.belief.lag,
        )

    def until(self, x: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """State (14,) of the car and memory (4, 3) of its struts after `steps` on this road."""
        part = replace(self, course=self.course.part(0, steps))
        tape = part.drive(x)
        return tape.end, tape.memory

    @property
    def information(self) -> np.ndarray:
        """The inverse (S, J) of the variance of each block mean, as far as the instruments go."""
        return self.readings.count / self.belief.noise

    def sensed(self, acceleration: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Block means (S, J) of the sensors for accelerations (N, 7) of the coordinates."""
        samples = acceleration[:: self.course.every][: self.readings.samples]
        return self.readings.means(self.belief.levers @ samples.T) + offset[:, None]


@dataclass(frozen=True, eq=False)
class Point:
    """A problem at `x`: the `tape` of the motion, what is left `over` (S, J) [m/s²] of the
    readings, and the `inverse` (S, J) of the noise variance that they are thought to have; `gain`
    (J // 2 + 1,), if given, by which what is heard at each frequency counts.
    """

    problem: Problem
    x: np.ndarray
    tape: Tape
    over: np.ndarray
    inverse: np.ndarray
    gain: np.ndarray | None = None

    def weighed(self, means: np.ndarray) -> np.ndarray:
        """R^-1 times block means (S, J)."""
        if self.gain is None:
            return self.inverse * means
        root = np.sqrt(self.inverse)
        return root * coloured(self.gain, root * means)

    @property
    def misfit(self) -> float:
        """The readings' share of the cost."""
        return 0.5 * float(np.sum(self.over * self.weighed(self.over)))

    @property
    def cost(self) -> float:
        """What is to be made small."""
        return self.misfit + 0.5 * float(self.x @ self.x)

    def gradient(self) -> np.ndarray:
        """Of the cost by `x`."""
        return self.x - self.transposed(self.weighed(self.over))

    def hessian(self, dx: np.ndarray) -> np.ndarray:
        """Gauss and Newton's, times `dx`."""
        return dx + self.transposed(self.weighed(self.tangent(dx)))

    @cached_property
    def parts(self) -> Parts:
        """The tangent at this point."""
        one = self.problem
        return parts_of(
            *(self.tape, one.road, one.course, one.readings),
            *(one.belief.levers, one.belief.wheelbase),
        )

    def tangent(self, dx: np.ndarray) -> np.ndarray:
        """Change (S, J) of the model's block means by a small `dx`."""
        u, start, offset = self.problem.split(dx)
        return self.parts.tangent(start, self.problem.road.change(u)) + offset[:, None]

    def transposed(self, means: np.ndarray) -> np.ndarray:
        """The transpose of `tangent`: from block means (S, J) to `x`."""
        one = self.problem
        start, c = self.parts.transposed(means)
        parts = [one.road.back(c).ravel(), one.reach * start, one.belief.offset * means.sum(axis=1)]
        return np.concatenate(parts)

    def weighing(self, inverse: np.ndarray) -> "Point":
        """The same point under another inverse (S, J) of the noise."""
        return replace(self, inverse=inverse)

    def at(self, x: np.ndarray, plant: Plant | None = None) -> "Point":
        """The same problem under the same noise at another `x`. Raises ArithmeticError."""
        return point(self.problem, x, self.inverse, plant, self.gain)


def coloured(gain: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Block means (S, J) with each frequency taken times `gain` (J // 2 + 1,)."""
    return irfft(gain * rfft(means, axis=1), means.shape[1], axis=1)


def point(
    problem: Problem,
    x: np.ndarray,
    inverse: np.ndarray,
    plant: Plant | None = None,
    gain: np.ndarray | None = None,
) -> Point:
    """The problem at `x`, for its own plant or another. Raises ArithmeticError."""
    tape = problem.drive(x, plant)
    _, _, offset = problem.split(x)
    over = problem.readings.y - problem.sensed(tape.acceleration, offset)
    return Point(problem, x, tape, over, inverse, gain)
