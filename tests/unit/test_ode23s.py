"""Orders and stability of the pair that the compiled integrators are compared with."""

import numpy as np
import oracles
import pytest
from scipy.integrate import solve_ivp

START = np.array([1.0, 0.5])


def f(t, y):
    """Return the rates of two nonlinear equations with explicit time dependence."""
    return np.array([-2.0 * t * y[0] ** 2, -3.0 * (y[1] - np.sin(2.0 * t)) + y[0] * y[1]])


def jacobian(t, y):
    return np.array([[-4.0 * t * y[0], 0.0], [y[1], -3.0 + y[0]]])


def f_t(t, y):
    return np.array([-2.0 * y[0] ** 2, 6.0 * np.cos(2.0 * t)])


def slope(x, y):
    """Return the slope of log y over log x."""
    return np.polyfit(np.log(x), np.log(y), 1)[0]


def truth(span, y_0, t):
    result = solve_ivp(f, span, y_0, method="DOP853", t_eval=t, rtol=1e-13, atol=1e-14)
    assert result.success
    return result.y.T


def test_at_a_constant_step_the_method_has_order_two_on_a_time_dependent_rate():
    steps, (expected,), error = 10 * 2 ** np.arange(1, 6), truth((0.0, 2.0), START, [2.0]), []
    for n in steps:
        y = START
        for k in range(n):
            y, _, _ = oracles.ode23s_step(f, jacobian, f_t, 2.0 * k / n, y, 2.0 / n)
        error.append(np.abs(y - expected).max())
    assert slope(2.0 / steps, error) == pytest.approx(2.0, abs=0.05)


def test_a_step_plus_its_error_estimate_has_order_three():
    h, second, third, between = 0.2 / 2.0 ** np.arange(6), [], [], []
    for each in h:
        y, error, dense = oracles.ode23s_step(f, jacobian, f_t, 0.3, START, each)
        exact = truth((0.3, 0.3 + each), START, 0.3 + each * np.array([0.2, 0.5, 0.8, 1.0]))
        second.append(np.abs(y - exact[-1]).max())
        third.append(np.abs(y + error - exact[-1]).max())
        inside = zip((0.2, 0.5, 0.8), exact[:-1], strict=True)
        between.append(max(np.abs(dense(x) - z).max() for x, z in inside))
    assert slope(h, second) == pytest.approx(3.0, abs=0.1)
    assert slope(h, third) == pytest.approx(4.0, abs=0.1)
    assert slope(h, between) == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize("stiffness", [1e3, 1e6, 1e12])
def test_one_long_step_damps_a_stiff_mode_almost_completely(stiffness):
    """L-stability: the amplification tends to 0, not to -1 as with the trapezoidal rule."""
    J = np.array([[-stiffness]])
    y, _, _ = oracles.ode23s_step(
        lambda t, y: J @ y, lambda t, y: J, lambda t, y: 0.0, 0.0, np.array([1.0]), 1.0
    )
    # (1 + (1 - 2 d) z) / (1 - d z)² with z = -stiffness
    assert abs(y[0]) < 6.0 / stiffness
