"""Adaptive integrator `ode23s` of y' = f(t, y): a Rosenbrock pair of orders 2 and 3.

The method of the paper, after Shampine & Reichelt (1997), "The MATLAB ODE suite", SIAM J. Sci.
Comput. 18, section 3.1, doi 10.1137/S1064827594276424. With J = df/dy and T = df/dt, a step h is

    d = 1 / (2 + sqrt 2),   e_32 = 6 + sqrt 2,   W = I - h d J
    F_0 = f(t, y)                            W k_1         = F_0 + h d T
    F_1 = f(t + h/2, y + h k_1 / 2)          W (k_2 - k_1) = F_1 - k_1
    y_1 = y + h k_2,   F_2 = f(t + h, y_1)   W k_3 = F_2 - e_32 (k_2 - F_1) - 2 (k_1 - F_0) + h d T

The step continues from y_1, which is of order 2 and L-stable. The error estimate is the difference
to a formula of order 3, h (k_1 - 2 k_2 + k_3) / 6. F_2 is F_0 of the next step. Within a step the
solution is the quadratic of the same source (its section on free interpolants),

    y(t + x h) = y + h (x (1 - x) k_1 + x (x - 2 d) k_2) / (1 - 2 d),   0 <= x <= 1

`rosenbrock` is the same formula at a constant step; `adaptive_drive` is this pair, compiled for the
vehicle.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from road_envs._numba import kernel
from road_envs.simulation.rosenbrock import D

E_32 = 6.0 + np.sqrt(2.0)

Rate = Callable[[float, np.ndarray], np.ndarray]
"""A function of time and state (n,): f and df/dt return (n,), df/dy returns (n, n)."""


class StepSizeError(ArithmeticError):
    """No step within floating-point resolution meets the tolerance."""


@kernel
def step_size_factor(error):
    """Return the factor from this step to the next, for an `error` in units of the tolerance.

    The error is of order h³, hence the cube root. 0.8 is a safety factor, and the result is limited
    to 0.2 ... 5. A NaN gives the smallest factor.
    """
    if error > 0.0:
        return min(max(0.8 * error ** (-1.0 / 3.0), 0.2), 5.0)
    return 5.0 if error == 0.0 else 0.2


@kernel
def dense_output_weights(x):
    """Return the weights of h k_1 and h k_2 in the solution at the fraction `x` of a step."""
    return x * (1.0 - x) / (1.0 - 2.0 * D), x * (x - 2.0 * D) / (1.0 - 2.0 * D)


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution with dense output: `solution(t)` evaluates it at any time within its span.

    `t` (N + 1,), `y` (N + 1, n) at the ends of the N steps; `k` (N, 2, n), the first two stages of
    each step. `rejections` counts rejected steps, `evaluations` the calls of f, `jacobians` those
    of df/dy; every step, accepted or rejected, factorizes one matrix.
    """

    t: np.ndarray
    y: np.ndarray
    k: np.ndarray
    rejections: int
    evaluations: int
    jacobians: int

    @property
    def steps(self) -> int:
        """Number of accepted steps."""
        return self.t.size - 1

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Return the states (..., n) at times `t` (...). Raises ValueError outside the span."""
        t = np.asarray(t, dtype=float)
        if not ((t >= self.t[0]) & (t <= self.t[-1])).all():
            raise ValueError(
                f"t must lie within the span of the solution, {self.t[0]:g} to {self.t[-1]:g}, "
                f"got {t.min():g} to {t.max():g}"
            )
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, self.steps - 1)
        h = (self.t[i + 1] - self.t[i])[..., None]
        b_1, b_2 = dense_output_weights((t - self.t[i])[..., None] / h)
        return self.y[i] + h * (b_1 * self.k[i, 0] + b_2 * self.k[i, 1])


class Step(NamedTuple):
    """One step: stages 1 and 2, state and rate at its end, and error estimate, each (n,)."""

    k_1: np.ndarray
    k_2: np.ndarray
    y: np.ndarray
    F: np.ndarray
    error: np.ndarray


def step(
    rate: Rate, t: float, y: np.ndarray, F_0: np.ndarray, J: np.ndarray, T: np.ndarray, h: float
) -> Step:
    """Take one step `h` from the state `y` with rate `F_0`; J = df/dy, T = df/dt."""
    factors = scipy.linalg.lu_factor(np.eye(y.size) - h * D * J, check_finite=False)

    def solve(right: np.ndarray) -> np.ndarray:
        return scipy.linalg.lu_solve(factors, right, check_finite=False)

    k_1 = solve(F_0 + h * D * T)
    F_1 = rate(t + 0.5 * h, y + 0.5 * h * k_1)
    k_2 = solve(F_1 - k_1) + k_1
    y_1 = y + h * k_2
    F_2 = rate(t + h, y_1)
    k_3 = solve(F_2 - E_32 * (k_2 - F_1) - 2.0 * (k_1 - F_0) + h * D * T)
    return Step(k_1, k_2, y_1, F_2, h / 6.0 * (k_1 - 2.0 * k_2 + k_3))


class _System:
    """A rate function and its derivatives; copies the returned rates and counts the calls."""

    def __init__(self, rate: Rate, jacobian: Rate, dfdt: Rate | None):
        self.rate, self.jacobian, self.dfdt, self.calls = rate, jacobian, dfdt, 0

    def f(self, t: float, y: np.ndarray) -> np.ndarray:
        self.calls += 1
        return np.array(self.rate(t, y), dtype=float)

    def derivatives(self, t: float, y: np.ndarray, F: np.ndarray, h: float):
        """Return df/dy (n, n) and df/dt (n,), the latter by a finite difference by default."""
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
    *,
    dfdt: Rate | None = None,
    max_step: float = np.inf,
) -> Solution:
    """Solve y' = rate(t, y) over `span` from `y_0` (n,), with the Jacobian (n, n) of `rate`.

    Every component of a step's error is kept below `atol` + `rtol` |y|. `dfdt` is the derivative of
    the rate with respect to time, by default a finite difference. Set `max_step` if the rate has
    short pulses, which a longer step could miss. Raises ValueError on bad input, StepSizeError if
    no step meets the tolerance.
    """
    t, end = float(span[0]), float(span[1])
    if not end > t:
        raise ValueError(f"span must end after it begins, got {span}")
    if not (rtol > 0 and atol > 0 and max_step > 0):
        raise ValueError(
            f"rtol, atol and max_step must be positive, got {rtol}, {atol} and {max_step}"
        )
    system, y = _System(rate, jacobian, dfdt), np.array(y_0, dtype=float)
    F, h = system.f(t, y), min(max_step, end - t)
    J, T = system.derivatives(t, y, F, h)
    h = min(h, _initial_step(rtol, atol, y, J @ F + T))
    times, states, stages, n_tried = [t], [y], [], 0
    while True:
        last = t + h * (1.0 + 1e-9) >= end  # rounding must not leave a tiny last step
        h = end - t if last else h
        if not h > 4.0 * np.spacing(abs(t)):
            raise StepSizeError(
                f"no step meets rtol = {rtol:g}, atol = {atol:g} at t = {t:.9g}; loosen the "
                "tolerances or check the rate"
            )
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
    """Return a first step h whose second-order term y'' h² / 2 is within the tolerance."""
    with np.errstate(divide="ignore"):
        return float(np.min(np.sqrt(2.0 * (atol + rtol * np.abs(y)) / np.abs(curvature))))
