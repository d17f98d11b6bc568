"""Tests of the adaptive pair on generic equations: orders, error, dense output, step control."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from road_envs.simulation.ode23s import StepSizeError, ode23s, step, step_size_factor


def slope(x, y):
    """Return the slope of log y over log x."""
    return np.polyfit(np.log(x), np.log(y), 1)[0]


def van_der_pol(mu):
    """Return f, df/dy, df/dt of y'' = mu (1 - y²) y' - y."""

    def f(t, y):
        return np.array([y[1], mu * (1.0 - y[0] ** 2) * y[1] - y[0]])

    def J(t, y):
        return np.array([[0.0, 1.0], [-2.0 * mu * y[0] * y[1] - 1.0, mu * (1.0 - y[0] ** 2)]])

    return f, J, lambda t, y: np.zeros(2)


def time_dependent_problem():
    """Return f, df/dy, df/dt of two nonlinear equations with explicit time dependence."""

    def f(t, y):
        return np.array([-2.0 * t * y[0] ** 2, -3.0 * (y[1] - np.sin(2.0 * t)) + y[0] * y[1]])

    def J(t, y):
        return np.array([[-4.0 * t * y[0], 0.0], [y[1], -3.0 + y[0]]])

    def T(t, y):
        return np.array([-2.0 * y[0] ** 2, 6.0 * np.cos(2.0 * t)])

    return f, J, T


START = np.array([1.0, 0.5])


def truth(f, span, y_0, t):
    result = solve_ivp(f, span, y_0, method="DOP853", t_eval=t, rtol=1e-13, atol=1e-14)
    assert result.success
    return result.y.T


def test_the_stiff_van_der_pol_oscillator_matches_octave_and_scipy():
    """Reference: end states of Octave's ode23s (rtol 1e-6) and SciPy's Radau (1e-10)."""
    f, J, T = van_der_pol(1000.0)
    for rtol, steps in ((1e-3, 40), (1e-6, 250)):
        result = ode23s(f, J, (0.0, 1.0), [2.0, 0.0], rtol, 1e-3 * rtol, dfdt=T)
        np.testing.assert_allclose(result.y[-1], (1.9993333705, -6.6703712e-4), rtol=2e-6)
        assert result.steps < steps  # an explicit method needs hundreds


def test_the_fast_transitions_of_the_stiff_oscillator_match_scipy():
    f, J, T = van_der_pol(100.0)
    result = ode23s(f, J, (0.0, 200.0), [2.0, 0.0], 1e-6, 1e-9, dfdt=T)
    t = np.linspace(0.0, 200.0, 41)
    expected = solve_ivp(
        f, (0, 200), [2, 0], method="Radau", jac=J, t_eval=t, rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(result(t)[:, 0], expected.y[0], atol=2e-3)
    assert np.ptp(result.y[:, 0]) > 4.0


@pytest.mark.parametrize("given", [True, False], ids=["df/dt given", "df/dt by differences"])
def test_at_a_constant_step_the_method_has_order_two_on_a_time_dependent_rate(given):
    f, J, T = time_dependent_problem()
    h, t = 0.1 / 2.0 ** np.arange(6), np.linspace(0.0, 2.0, 21)
    expected, error = truth(f, (0.0, 2.0), START, t), []
    for max_step in h:
        result = ode23s(
            f, J, (0.0, 2.0), START, 1e6, 1e6, dfdt=T if given else None, max_step=max_step
        )
        assert result.steps == round(2.0 / max_step)
        error.append(np.abs(result(t) - expected).max())
    assert slope(h, error) == pytest.approx(2.0, abs=0.05)


def one_step(h, t=0.3):
    f, J, T = time_dependent_problem()
    F, (exact,) = f(t, START), truth(f, (t, t + h), START, [t + h])
    return step(f, t, START, F, J(t, START), T(t, START), h), exact


def test_a_step_plus_its_error_estimate_has_order_three():
    h, second, third = 0.2 / 2.0 ** np.arange(6), [], []
    for each in h:
        result, exact = one_step(each)
        second.append(np.abs(result.y - exact).max())
        third.append(np.abs(result.y + result.error - exact).max())
    assert slope(h, second) == pytest.approx(3.0, abs=0.1)
    assert slope(h, third) == pytest.approx(4.0, abs=0.1)


def test_dense_output_is_as_accurate_as_the_steps():
    f, J, T = time_dependent_problem()
    h, error = 0.2 / 2.0 ** np.arange(6), []
    for each in h:
        result = ode23s(f, J, (0.3, 0.3 + each), START, 1e6, 1e6, dfdt=T)
        assert result.steps == 1
        t = 0.3 + each * np.array([0.2, 0.5, 0.8])
        error.append(np.abs(result(t) - truth(f, (0.3, 0.3 + each), START, t)).max())
    assert slope(h, error) == pytest.approx(3.0, abs=0.1)


def test_dense_output_passes_through_the_steps_and_takes_times_of_any_shape():
    f, J, T = time_dependent_problem()
    result = ode23s(f, J, (0.0, 2.0), START, dfdt=T)
    np.testing.assert_allclose(result(result.t), result.y, rtol=1e-14)
    assert result(1.0).shape == (2,) and result(np.ones((3, 4))).shape == (3, 4, 2)
    assert result.t[0] == 0.0 and result.t[-1] == 2.0
    for outside in (-0.1, 2.1, np.nan):
        with pytest.raises(ValueError, match="within the span of the solution, 0 to 2"):
            result(outside)


@pytest.mark.parametrize("problem", ["time dependent", "van der Pol"])
def test_the_global_error_scales_with_the_tolerance_to_the_power_two_thirds(problem):
    """The local error is of order h³, the global error of order h²."""
    f, J, T = time_dependent_problem() if problem == "time dependent" else van_der_pol(3.0)
    rtol, t = 10.0 ** -np.arange(4.0, 9.0), np.linspace(0.0, 4.0, 33)
    expected, error = truth(f, (0.0, 4.0), START, t), []
    for each in rtol:
        result = ode23s(f, J, (0.0, 4.0), START, each, each, dfdt=T)
        error.append(np.abs(result(t) - expected).max())
    assert slope(rtol, error) == pytest.approx(2.0 / 3.0, abs=0.06)


def test_the_last_stage_of_a_step_is_reused_as_the_first_of_the_next():
    f, J, T = van_der_pol(100.0)
    result = ode23s(f, J, (0.0, 200.0), [2.0, 0.0], dfdt=T)
    assert result.rejections > 0
    assert result.evaluations == 1 + 2 * (result.steps + result.rejections)
    assert result.jacobians == result.steps


@pytest.mark.parametrize("stiffness", [1e3, 1e6, 1e12])
def test_one_long_step_damps_a_stiff_mode_almost_completely(stiffness):
    """L-stability: the amplification tends to 0, not to -1 as with the trapezoidal rule."""
    J, y = np.array([[-stiffness]]), np.array([1.0])
    result = step(lambda t, y: J @ y, 0.0, y, J @ y, J, np.zeros(1), 1.0)
    # (1 + (1 - 2 d) z) / (1 - d z)² with z = -stiffness
    assert abs(result.y[0]) < 6.0 / stiffness


def test_a_stiff_equation_with_a_slow_solution_takes_few_steps():
    """Prothero-Robinson problem: y = sin t for any stiffness."""

    def f(t, y):
        return -1e8 * (y - np.sin(t)) + np.cos(t)

    result = ode23s(f, lambda t, y: [[-1e8]], (0.0, 10.0), [0.0], 1e-4, 1e-4)
    t = np.linspace(0.0, 10.0, 200)
    assert np.abs(result(t)[:, 0] - np.sin(t)).max() < 1e-3
    assert result.steps < 600  # a stable explicit method needs 500 million


def test_a_discontinuity_in_the_rate_shortens_the_steps():
    result = ode23s(
        lambda t, y: [-y[0] + (100.0 if t > 0.5 else 0.0)], lambda t, y: [[-1.0]], (0.0, 2.0), [1.0]
    )
    exact = np.exp(-2.0) + 100.0 * (1.0 - np.exp(-1.5))
    assert result.y[-1, 0] == pytest.approx(exact, rel=2e-3)
    assert result.rejections > 3
    assert np.diff(result.t).min() < 1e-3 * np.diff(result.t).max()


def test_a_short_pulse_is_missed_unless_max_step_limits_the_steps():
    def run(max_step):
        def rate(t, y):
            return np.array([-y[0] + np.exp(-(((t - 50.0) / 0.02) ** 2))])

        return ode23s(rate, lambda t, y: [[-1.0]], (0.0, 100.0), [0.0], max_step=max_step)

    assert np.abs(run(np.inf).y).max() < 1e-9
    result = run(0.05)
    assert result(50.2)[0] == pytest.approx(0.02 * np.sqrt(np.pi) * np.exp(-0.2), rel=0.01)
    assert np.diff(result.t).max() <= 0.05 * (1.0 + 1e-9)


def test_the_step_size_factor_is_a_limited_cube_root_of_the_error():
    assert step_size_factor(1.0) == pytest.approx(0.8)
    assert step_size_factor(0.125) == pytest.approx(1.6)
    assert step_size_factor(8.0) == pytest.approx(0.4)
    assert step_size_factor(0.0) == step_size_factor(1e-9) == 5.0
    assert step_size_factor(1e9) == step_size_factor(np.nan) == step_size_factor(np.inf) == 0.2


def test_a_nan_rate_raises_an_error_that_names_the_time():
    with pytest.raises(StepSizeError, match=r"at t = 0\.5"):
        ode23s(lambda t, y: [np.nan if t > 0.5 else 1.0], lambda t, y: [[0.0]], (0.0, 1.0), [0.0],
               dfdt=lambda t, y: [0.0])  # fmt: skip


@pytest.mark.parametrize(
    "wrong",
    [
        {"span": (1.0, 1.0)},
        {"span": (0.0, np.nan)},
        {"rtol": 0.0},
        {"atol": -1.0},
        {"max_step": 0.0},
    ],
    ids=str,
)
def test_invalid_input_is_rejected(wrong):
    f, J, _ = time_dependent_problem()
    given = {"span": (0.0, 1.0), "y_0": START} | wrong
    with pytest.raises(ValueError, match="must"):
        ode23s(f, J, **given)
