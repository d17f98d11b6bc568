"""Force curves against SciPy's PCHIP, and the table that kernels read."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
from hypothesis import given
from hypothesis import strategies as st
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
    """Any curve whose breakpoints are multiples of 0.05."""
    places = sorted(draw(st.sets(st.integers(-20, 20), min_size=2, max_size=9)))
    forces = draw(st.lists(st.integers(-9999, 9999), min_size=len(places), max_size=len(places)))
    return Curve(x=tuple(0.05 * i for i in places), F=tuple(map(float, forces)))


@given(curves_on_the_grid(), st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=9))
def test_the_table_is_the_curve_wherever_breakpoints_lie_on_its_grid(curve, xs):
    table, slope = tabulate([curve], -1.0, 0.05, 40), oracles.CubicCurve(curve)
    size = np.abs(curve.F).max() + 1e-12
    for x in xs:
        found = interpolate_table(table[None], 0.0, -1.0, 0.05, x)[0]
        assert found == pytest.approx(float(slope(x)), abs=1e-9 * size * (1.0 + 40.0 * abs(x)))


@every_curve
def test_a_curve_passes_through_its_breakpoints_and_goes_on_straight(curve):
    found, _ = curve(np.array(curve.x))
    np.testing.assert_allclose(found, curve.F, rtol=1e-12, atol=1e-9)
    for end, sign in ((curve.x[0], -1.0), (curve.x[-1], 1.0)):
        F, slope = curve(end + sign * np.array([0.1, 0.2, 0.4]))
        np.testing.assert_allclose(np.diff(F), sign * slope[0] * np.array([0.1, 0.2]), atol=1e-6)
        assert (slope == slope[0]).all()


@every_curve
def test_the_slope_of_a_curve_is_its_derivative(curve):
    x, d = np.linspace(1.1 * curve.x[0], 1.1 * curve.x[-1], 1234), 1e-7
    by_differences = (curve(x + d)[0] - curve(x - d)[0]) / (2.0 * d)
    size = np.abs(by_differences).max()
    np.testing.assert_allclose(curve(x)[1] / size, by_differences / size, atol=1e-4)


def test_a_table_adds_its_curves_up():
    pair = STRUT.damper.ride, STRUT.friction.ride
    table = tabulate(pair, -3.0, 0.01, 600)
    for x in np.linspace(-4.0, 4.0, 321):
        F, slope = interpolate_table(table[None], 0.0, -3.0, 0.01, x)
        alone = [curve(np.array(x)) for curve in pair]
        assert (F, slope) == pytest.approx(tuple(np.sum(alone, axis=0)), rel=1e-9, abs=1e-6)


def test_breakpoints_between_grid_points_cost_little():
    """A kink lies at most half a cell from the grid: the error is bounded by that corner."""
    moved = replace(STRUT.bushing, x=tuple(x + 0.0011 for x in STRUT.bushing.x))
    table, exact = tabulate([moved], -0.2, 0.0025, 160), oracles.CubicCurve(moved)
    xs = np.linspace(-0.2, 0.2, 2001)
    found = np.array([interpolate_table(table[None], 0.0, -0.2, 0.0025, x)[0] for x in xs])
    assert np.abs(found - exact(xs)).max() < 0.002 * max(np.abs(moved.F))


def test_a_table_continues_straight_and_without_a_jump_past_both_ends():
    table = tabulate([Curve(x=(-1.0, 0.0, 1.0), F=(-3.0, 0.0, 8.0))], -0.5, 0.25, 4)
    for end, sign in ((-0.5, -1.0), (0.5, 1.0)):
        F, slope = interpolate_table(table[None], 0.0, -0.5, 0.25, end)
        assert interpolate_table(table[None], 0.0, -0.5, 0.25, end + sign * 1e-9)[
            0
        ] == pytest.approx(F, abs=1e-7)
        F_far, slope_far = interpolate_table(table[None], 0.0, -0.5, 0.25, end + sign)
        assert slope_far == pytest.approx(slope)
        assert F_far == pytest.approx(F + sign * slope)


def test_not_a_number_stays_inside_the_table():
    table = tabulate([STRUT.bushing], -0.2, 0.0025, 160)
    assert np.isnan(interpolate_table(table[None], 0.0, -0.2, 0.0025, np.nan)[0])


@pytest.mark.parametrize(
    ("x", "F", "reason"),
    [
        ((0.0, 1.0), (1.0,), "one length"),
        ((0.0,), (1.0,), "one length"),
        ((0.0, 0.0), (1.0, 2.0), "must increase"),
        ((1.0, 0.0), (1.0, 2.0), "must increase"),
        ((0.0, float("nan")), (1.0, 2.0), "finite"),
        ((0.0, 1.0), (1.0, float("inf")), "finite"),
    ],
)
def test_breakpoints_that_make_no_curve_are_refused(x, F, reason):
    with pytest.raises(ValueError, match=reason):
        Curve(x=x, F=F)
