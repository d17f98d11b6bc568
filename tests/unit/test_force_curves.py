"""Force curves against SciPy's PCHIP, and their tables for kernels."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator
from vehicle_fixtures import DEFENDER

from road_envs.vehicle.force_curves import Curve, interpolate_table, tabulate

STRUT = DEFENDER.strut
SHIPPED = {
    "damper ride": STRUT.damper.ride,
    "damper handling": STRUT.damper.handling,
    "friction ride": STRUT.friction.ride,
    "friction handling": STRUT.friction.handling,
    "bushing": STRUT.bushing,
    "front stop": STRUT.bump_stop.front,
    "rear stop": STRUT.bump_stop.rear,
}
every_curve = pytest.mark.parametrize("curve", SHIPPED.values(), ids=SHIPPED.keys())


@st.composite
def curves_on_the_grid(draw):
    """Draw a curve whose breakpoints are multiples of 0.05."""
    places = sorted(draw(st.sets(st.integers(-20, 20), min_size=2, max_size=9)))
    forces = draw(st.lists(st.integers(-9999, 9999), min_size=len(places), max_size=len(places)))
    return Curve(x=tuple(0.05 * i for i in places), F=tuple(map(float, forces)))


@given(curves_on_the_grid(), st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=9))
def test_a_table_is_exact_if_breakpoints_are_grid_points(curve, xs):
    table, slope = tabulate([curve], -1.0, 0.05, 40), oracles.CubicCurve(curve)
    size = np.abs(curve.F).max() + 1e-12
    for x in xs:
        actual = interpolate_table(table[None], 0.0, -1.0, 0.05, x)[0]
        assert actual == pytest.approx(float(slope(x)), abs=1e-9 * size * (1.0 + 40.0 * abs(x)))


@given(
    st.lists(st.integers(-1000, 1000), min_size=2, max_size=8, unique=True),
    st.lists(st.sampled_from([-3.0, -1.0, 0.0, 0.0, 0.5, 40.0]), min_size=8, max_size=8),
)
def test_curves_are_the_pchip_of_scipy(places, forces):
    """Among them are curves of two points, plateaus, and steep chords at the ends."""
    x, F = 1e-3 * np.sort(places), np.array(forces[: len(places)])
    at = np.r_[x, np.linspace(x[0], x[-1], 50)]
    cubic = PchipInterpolator(x, F)
    value, slope = Curve(x=tuple(x), F=tuple(F))(at)
    np.testing.assert_allclose(value, cubic(at), rtol=1e-12, atol=1e-12 * np.abs(F).max())
    size = np.abs(cubic.derivative()(at)).max()
    np.testing.assert_allclose(slope, cubic.derivative()(at), rtol=1e-9, atol=1e-12 * size)


@every_curve
def test_a_curve_interpolates_its_breakpoints_and_extrapolates_linearly(curve):
    actual, _ = curve(np.array(curve.x))
    np.testing.assert_allclose(actual, curve.F, rtol=1e-12, atol=1e-9)
    for end, sign in ((curve.x[0], -1.0), (curve.x[-1], 1.0)):
        F, slope = curve(end + sign * np.array([0.1, 0.2, 0.4]))
        np.testing.assert_allclose(np.diff(F), sign * slope[0] * np.array([0.1, 0.2]), atol=1e-6)
        assert (slope == slope[0]).all()


@every_curve
def test_the_slope_of_a_curve_matches_differences(curve):
    x, d = np.linspace(1.1 * curve.x[0], 1.1 * curve.x[-1], 1234), 1e-7
    by_differences = (curve(x + d)[0] - curve(x - d)[0]) / (2.0 * d)
    size = np.abs(by_differences).max()
    np.testing.assert_allclose(curve(x)[1] / size, by_differences / size, atol=1e-4)


def test_a_table_is_the_sum_of_its_curves():
    pair = STRUT.damper.ride, STRUT.friction.ride
    table = tabulate(pair, -3.0, 0.01, 600)
    for x in np.linspace(-4.0, 4.0, 321):
        F, slope = interpolate_table(table[None], 0.0, -3.0, 0.01, x)
        alone = [curve(np.array(x)) for curve in pair]
        assert (F, slope) == pytest.approx(tuple(np.sum(alone, axis=0)), rel=1e-9, abs=1e-6)


def test_breakpoints_off_the_grid_cause_a_small_error():
    """A kink is at most half a cell from a grid point, which bounds the error."""
    moved = replace(STRUT.bushing, x=tuple(x + 0.0011 for x in STRUT.bushing.x))
    table, exact = tabulate([moved], -0.2, 0.0025, 160), oracles.CubicCurve(moved)
    xs = np.linspace(-0.2, 0.2, 2001)
    actual = np.array([interpolate_table(table[None], 0.0, -0.2, 0.0025, x)[0] for x in xs])
    assert np.abs(actual - exact(xs)).max() < 0.002 * max(np.abs(moved.F))


def test_a_table_extrapolates_linearly_and_continuously():
    table = tabulate([Curve(x=(-1.0, 0.0, 1.0), F=(-3.0, 0.0, 8.0))], -0.5, 0.25, 4)
    for end, sign in ((-0.5, -1.0), (0.5, 1.0)):
        F, slope = interpolate_table(table[None], 0.0, -0.5, 0.25, end)
        assert interpolate_table(table[None], 0.0, -0.5, 0.25, end + sign * 1e-9)[
            0
        ] == pytest.approx(F, abs=1e-7)
        F_far, slope_far = interpolate_table(table[None], 0.0, -0.5, 0.25, end + sign)
        assert slope_far == pytest.approx(slope)
        assert F_far == pytest.approx(F + sign * slope)


def test_nan_arguments_give_nan():
    table = tabulate([STRUT.bushing], -0.2, 0.0025, 160)
    assert np.isnan(interpolate_table(table[None], 0.0, -0.2, 0.0025, np.nan)[0])


@pytest.mark.parametrize(
    ("x", "F", "reason"),
    [
        ((0.0, 1.0), (1.0,), "same length"),
        ((0.0,), (1.0,), "same length"),
        ((0.0, 0.0), (1.0, 2.0), "must increase"),
        ((1.0, 0.0), (1.0, 2.0), "must increase"),
        ((0.0, float("nan")), (1.0, 2.0), "finite"),
        ((0.0, 1.0), (1.0, float("inf")), "finite"),
    ],
)
def test_invalid_breakpoints_raise_value_error(x, F, reason):
    with pytest.raises(ValueError, match=reason):
        Curve(x=x, F=F)
