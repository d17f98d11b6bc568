"""Enveloping by tyres: the mean of a road over the length of their contact."""

import numpy as np
import oracles
import pytest
from scipy.integrate import quad
from vehicle_fixtures import smooth_road

from road_envs.roads.surface import Surface, enveloped


@pytest.mark.parametrize("n", [0.2, 1.0, 2.5, 4.0, 5.0, 8.0])
def test_enveloping_scales_a_sine_by_the_sinc_of_the_contact_length(n):
    ds, L = 0.002, 0.2
    s = ds * np.arange(4001)
    z = 0.01 * np.stack([np.sin(2.0 * np.pi * n * s), np.cos(2.0 * np.pi * n * s)])
    enveloped_surface = enveloped(Surface(z, ds), L)
    gain = np.sinc(n * L)
    inside = slice(200, -200)
    np.testing.assert_allclose(
        enveloped_surface.height(s)[:, inside], gain * z[:, inside], atol=2e-8
    )
    if n == 5.0:  # a contact length of one wavelength averages the sine to 0
        assert np.abs(enveloped_surface.height(s)[:, inside]).max() < 1e-7


@pytest.mark.parametrize("ds", [0.01, 0.07, 0.5])
@pytest.mark.parametrize("L", [0.03, 0.18])
def test_enveloping_is_the_mean_of_the_cubic_over_the_contact_length(ds, L):
    """Reference: SciPy's spline and quadrature, for cells shorter and longer than the contact."""
    rng = np.random.default_rng(2)
    road = Surface(rng.standard_normal((2, 40)), ds, start=3.0)
    enveloped_surface, cubic = enveloped(road, L), oracles.SplineRoad(road.z, ds, 3.0)
    assert (
        enveloped_surface.ds == ds
        and enveloped_surface.start <= 3.0 - 0.5 * L - ds < enveloped_surface.start + ds + 1e-9
    )
    assert enveloped_surface.end >= road.end + 0.5 * L + ds > enveloped_surface.end - ds - 1e-9
    for k in range(0, enveloped_surface.z.shape[1], 3):
        begin, end = enveloped_surface.s[k] - 0.5 * L, enveloped_surface.s[k] + 0.5 * L
        low, high = 3.0 - ds, road.end + ds
        ends = np.clip([begin, end], low, high)
        knots = [s for s in (3.0, road.end, *road.s) if ends[0] < s < ends[1]]
        before, behind = max(min(end, low) - begin, 0.0), max(end - max(begin, high), 0.0)
        for side in range(2):
            area, _ = quad(lambda s, side=side: cubic.z(s)[side], *ends, points=knots or None)
            # the road is level before the first and after the last sample
            area += before * road.z[side, 0] + behind * road.z[side, -1]
            assert enveloped_surface.z[side, k] == pytest.approx(area / L, abs=1e-7)


def test_enveloping_leaves_planes_unchanged_at_any_altitude():
    s = 0.1 * np.arange(200)
    z = np.stack([np.full(s.size, 1300.0), 1300.0 + 0.05 * s])
    enveloped_surface = enveloped(Surface(z, 0.1), 0.25)
    np.testing.assert_allclose(enveloped_surface.height(s)[:, 3:-3], z[:, 3:-3], atol=1e-9)
    assert enveloped_surface.notes == ("enveloped over a contact length of 250 mm",)


@pytest.mark.parametrize("length", [0.0, -0.1, float("nan"), float("inf")])
def test_an_invalid_contact_length_raises_value_error(length):
    with pytest.raises(ValueError, match="contact length must be positive"):
        enveloped(smooth_road(length=20.0, height=0.01), length)
