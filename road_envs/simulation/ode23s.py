"""Adaptive integration of y' = f(t, y) by a Rosenbrock pair: the method `ode23s`.

Shampine & Reichelt (1997), "The MATLAB ODE suite", SIAM J. Sci. Comput. 18, section 3.1, doi
10.1137/S1064827594276424, the method of the paper. A step of h with J = df/dy, T = df/dt,

    d = 1 / (2 + sqrt 2),   e_32 = 6 + sqrt 2,   W = I - h d J
    F_0 = f(t, y)                            W k_1         = F_0 + h d T
    F_1 = f(t + h/2, y + h k_1 / 2)          W (k_2 - k_1) = F_1 - k_1
    y_1 = y + h k_2,   F_2 = f(t + h, y_1)   W k_3 = F_2 - e_32 (k_2 - F_1) - 2 (k_1 - F_0) + h d T

goes on with y_1, which is of order 2 and L-stable, and takes h (k_1 - 2 k_2 + k_3) / 6, what leads
from y_1 to a formula of order 3, for its error. F_2 is F_0 of the next step. Between the ends the
solution is the quadratic of the same source (its section on free interpolants),

    y(t + x h) = y + h (x (1 - x) k_1 + x (x - 2 d) k_2) / (1 - 2 d),   0 <= x <= 1

`integrator` is the same formula at a constant step, and `adaptive` this pair, compiled for the
vehicle.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import lu_factor, lu_solve

from road_envs._numba import kernel
from road_envs.simulation.rosenbrock import D

E_32 = 6.0 + np.sqrt(2.0)

Rate = Callable[[float, np.ndarray], np.ndarray]
"""A function of time and the state (n,): f and df/dt give (n,), df/dy gives (n, n)."""


class StepSizeError(ArithmeticError):
    """No step that time can resolve meets the tolerance; the sentence says where."""


@kernel
def step_size_factor(error):
    """Factor of the next step after an error of `error` tolerances: its cube root, with care.

    The error is of order h³. 0.8 is for safety, and no step is less than a fifth of the one before
    or more than five times as long. An error that is not a number asks for the shortest step.
    """
    if error > 0.0:
        return min(max(0.8 * error ** (-1.0 / 3.0), 0.2), 5.0)
    return 5.0 if error == 0.0 else 0.2


@kernel
def dense_output_weights(x):
    """Weights of h k_1 and h k_2 in the solution at the share `x` of a step."""
    return x * (1.0 - x) / (1.0 - 2.0 * D), x * (x - 2.0 * D) / (1.0 - 2.0 * D)


@dataclass(frozen=True, eq=False)
class Solution:
    """A solution that can be asked at any time within its span: `solution(t)`.

    `t` (N + 1,), `y` (N + 1, n) at the ends of the N steps; `k` (N, 2, n) the first two stages of
    each. `rejections` counts steps that were tried in vain, `evaluations` the calls of f,
    `jacobians` those of df/dy; every step, taken or rejected, factors one matrix.
    """

    t: np.ndarray
    y: np.ndarray
    k: np.ndarray
    rejections: int
    evaluations: int
    jacobians: int

    @property
    def steps(self) -> int:
        """Steps taken."""
        return self.t.size - 1

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """States (..., n) at times `t` (...). Raises ValueError outside the span."""
        t = np.asarray(t, dtype=float)
        if not ((t >= self.t[0]) & (t <= self.t[-1])).all():
            raise ValueError(f"the solution is known from {self.t[0]:g} to {self.t[-1]:g} only")
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, self.steps - 1)
        h = (self.t[i + 1] - self.t[i])[..., None]
        b_1, b_2 = dense_output_weights((t - self.t[i])[..., None] / h)
        return self.y[i] + h * (b_1 * self.k[i, 0] + b_2 * self.k[i, 1])


class Step(NamedTuple):
    """One step: its stages (n,), the state (n,) and rate (n,) at its end, its error (n,)."""

    k_1: np.ndarray
    k_2: np.ndarray
    y: np.ndarray
    F: np.ndarray
    error: np.ndarray


def step(
    rate: Rate, t: float, y: np.ndarray, F_0: np.ndarray, J: np.ndarray, T: np.ndarray, h: float
) -> Step:
    """One step of `h` from the state `y`, whose rate is `F_0`, with J = df/dy and T = df/dt."""
    factors = lu_factor(np.eye(y.size) - h * D * J, check_finite=False)

    def solve(right: np.ndarray) -> np.ndarray:
        return lu_solve(factors, right, check_finite=False)

    k_1 = solve(F_0 + h * D * T)
    F_1 = rate(t + 0.5 * h, y + 0.5 * h * k_1)
    k_2 = solve(F_1 - k_1) + k_1
    y_1 = y + h * k_2
    F_2 = rate(t + h, y_1)
    k_3 = solve(F_2 - E_32 * (k_2 - F_1) - 2.0 * (k_1 - F_0) + h * D * T)
    return Step(k_1, k_2, y_1, F_2, h / 6.0 * (k_1 - 2.0 * k_2 + k_3))


class _System:
    """A rate and its derivatives; counts the calls of the rate, whose answers it copies."""

    def __init__(self, rate: Rate, jacobian: Rate, dfdt: Rate | None):
        self.rate, self.jacobian, self.dfdt, self.calls = rate, jacobian, dfdt, 0

    def f(self, t: float, y: np.ndarray) -> np.ndarray:
        self.calls += 1
        return np.array(self.rate(t, y), dtype=float)

    def derivatives(self, t: float, y: np.ndarray, F: np.ndarray, h: float):
        """df/dy (n, n) and df/dt (n,), the latter by a difference within `h` if it is not given."""
        J = np.asarray(self.jacobian(t, y), dtype=float)
        if self.dfdt is not None:
            return J, np.asarray(self.dfdt(t, y), dtype=float)
        t_ahead = t + min(np.sqrt(np.finfo(float).eps) * max(abs(t), abs(t + h)), h)
        return J, (self.f(t_ahead, y) - F) / (t_ahead - t)


def ode23s(
    rate: Rate,
    jacobian: Rate,
    span: tuple[float, float],
    y_0: np.ndarray,
    rtol: float = 1e-3,
    atol: float = 1e-6,
    dfdt: Rate | None = None,
    max_step: float = np.inf,
) -> Solution:
    """Solve y' = rate(t, y) over `span` from `y_0` (n,), with the Jacobian (n, n) of `rate`.

    Every component of a step's error is kept below `atol` + `rtol` |y|. `dfdt` is the rate's
    derivative by time, taken by differences if it is left out. `max_step` is for a rate that may
    change unseen between two steps. Raises ValueError on bad input, StepSizeError if no step meets
    the tolerance.
    """
    t, end = float(span[0]), float(span[1])
    if not end > t:
        raise ValueError(f"the span must run forwards in time, got {span}")
    if not (rtol > 0 and atol > 0 and max_step > 0):
        raise ValueError("tolerances and the longest step must be positive")
    system, y = _System(rate, jacobian, dfdt), np.array(y_0, dtype=float)
    F, h = system.f(t, y), min(max_step, end - t)
    J, T = system.derivatives(t, y, F, h)
    h = min(h, _initial_step(rtol, atol, y, J @ F + T))
    times, states, stages, n_tried = [t], [y], [], 0
    while True:
        last = t + h * (1.0 + 1e-9) >= end
        h = end - t if last else h
        if not h > 4.0 * np.spacing(abs(t)):
            raise StepSizeError(f"no step meets the tolerance at t = {t:.9g}")
        new, n_tried = step(system.f, t, y, F, J, T, h), n_tried + 1
        scale = atol + rtol * np.maximum(np.abs(y), np.abs(new.y))
        error = float(np.max(np.abs(new.error) / scale))
        if not error <= 1.0:
            h *= step_size_factor(error)
            continue
        t, y, F = end if last else t + h, new.y, new.F
        times.append(t)
        states.append(y)
        stages.append((new.k_1, new.k_2))
        if last:
            break
        h = min(h * step_size_factor(error), max_step)
        J, T = system.derivatives(t, y, F, h)
    n_accepted, ks = len(stages), np.array(stages)
    return Solution(
        np.array(times), np.array(states), ks, n_tried - n_accepted, system.calls, n_accepted
    )


def _initial_step(rtol: float, atol: float, y: np.ndarray, curvature: np.ndarray) -> float:
    """A first step whose bend y'' h² / 2 is within the tolerance."""
    with np.errstate(divide="ignore"):
        return float(np.min(np.sqrt(2.0 * (atol + rtol * np.abs(y)) / np.abs(curvature))))
