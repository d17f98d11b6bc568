"""Surfaces against SciPy's Hermite splines through Catmull-Rom slopes."""

import copy
import pickle

import numpy as np
import oracles
import pytest
from hypothesis import given
from hypothesis import strategies as st

from road_envs.roads.surface import PAD, Surface, height_and_slope

heights = st.integers(4, 30).flatmap(
    lambda n: st.lists(
        st.lists(st.floats(-0.5, 0.5), min_size=n, max_size=n), min_size=2, max_size=2
    )
)
spacings = st.sampled_from([0.0252, 0.05, 0.1, 1.0])
starts = st.sampled_from([0.0, -3.3, 12.5])


@given(heights, spacings, starts)
def test_between_samples_the_height_is_the_catmull_rom_cubic(z, ds, start):
    surface, road = Surface(np.array(z), ds, start), oracles.SplineRoad(z, ds, start)
    s = np.linspace(start - 4.0 * ds, surface.end + 4.0 * ds, 333)
    inside = np.clip(s, *road.ends)
    np.testing.assert_allclose(surface.height(s), road.z(inside), atol=1e-9)
    np.testing.assert_allclose(surface.slope(s) * ds, road.dz(inside) * ds, atol=1e-9)


@given(heights, spacings, starts)
def test_the_surface_passes_through_its_samples(z, ds, start):
    surface = Surface(np.array(z), ds, start)
    np.testing.assert_allclose(surface.height(surface.s), z, atol=1e-9)
    assert surface.s.size == len(z[0]) and surface.s[0] == start
    assert surface.end == surface.s[-1]
    assert surface.length == pytest.approx(ds * (len(z[0]) - 1))


@given(heights, spacings, starts)
def test_the_surface_is_level_one_spacing_beyond_its_ends(z, ds, start):
    surface = Surface(np.array(z), ds, start)
    for s, end in ((start - ds * np.array([1.0, 2.5, 1e6]), 0),
                   (surface.end + ds * np.array([1.0, 2.5, 1e6]), -1)):  # fmt: skip
        np.testing.assert_allclose(
            surface.height(s), np.array(z)[:, end, None] + 0.0 * s, atol=1e-9
        )
        np.testing.assert_allclose(surface.slope(s), 0.0, atol=1e-7)


@given(heights)
def test_height_and_slope_are_continuous_everywhere(z):
    surface, d = Surface(np.array(z), 0.1), 1e-7
    knots = 0.1 * np.arange(-3, len(z[0]) + 3)
    np.testing.assert_allclose(surface.height(knots + d), surface.height(knots - d), atol=1e-5)
    np.testing.assert_allclose(surface.slope(knots + d), surface.slope(knots - d), atol=1e-3)


def test_heights_are_left_then_right_for_any_shape_of_stations():
    surface = Surface(np.array([[1.0] * 5, [2.0] * 5]), 0.5)
    for s in (0.3, np.array([0.1, 0.7]), np.zeros((3, 4))):
        actual = surface.height(s)
        assert actual.shape == (2, *np.shape(s))
        assert (actual[0] == 1.0).all() and (actual[1] == 2.0).all()


def test_the_height_at_nan_is_nan():
    surface = Surface(np.ones((2, 5)), 0.5)
    assert np.isnan(surface.height(np.array([np.nan]))).all()


def test_compiled_and_interpreted_interpolation_agree():
    surface = Surface(np.random.default_rng(0).standard_normal((2, 9)), 0.3, -1.0)
    for s in np.linspace(-3.0, 4.0, 41):
        for side in (0, 1):
            plain = height_and_slope.py_func(surface.buffers, side, s)
            actual = height_and_slope(surface.buffers, side, s)
            np.testing.assert_allclose(actual, plain, rtol=1e-12, atol=1e-13)


def test_a_surface_copies_its_heights_and_makes_them_read_only():
    z = np.zeros((2, 6))
    surface = Surface(z, 0.1)
    z[:] = 7.0
    assert (surface.height(np.array([0.2])) == 0.0).all()
    with pytest.raises(ValueError, match="read-only"):
        surface.z[0, 0] = 1.0
    assert surface.padded.shape == (2, 6 + 2 * PAD)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_of_a_surface_are_equal(duplicate):
    surface = Surface(np.random.default_rng(0).standard_normal((2, 9)), 0.3, notes=("drawn",))
    s = np.linspace(-1.0, 4.0, 50)
    before = surface.height(s)
    np.testing.assert_array_equal(duplicate(surface).height(s), before)
    assert duplicate(surface).notes == ("drawn",)


@pytest.mark.parametrize(
    ("z", "options", "reason"),
    [
        (np.zeros((2, 3)), {}, r"heights must be \(2, N\) with N >= 4, got \(2, 3\)"),
        (np.zeros((3, 9)), {}, "heights must be"),
        (np.zeros(9), {}, "heights must be"),
        (np.array([[0, 0, np.nan, 0]] * 2), {}, "heights must be finite"),
        (np.array([[0, 0, np.inf, 0]] * 2), {}, "heights must be finite"),
        (np.zeros((2, 9)), {"ds": 0.0}, "spacing ds must be positive and finite, got 0.0"),
        (np.zeros((2, 9)), {"ds": -0.1}, "spacing ds must be positive"),
        (np.zeros((2, 9)), {"ds": np.nan}, "spacing ds must be positive"),
        (np.zeros((2, 9)), {"start": np.nan}, "first station must be finite"),
    ],
)
def test_invalid_heights_raise_an_error_with_the_surface_name(z, options, reason):
    with pytest.raises(ValueError, match=f"lane: .*{reason}"):
        Surface(z, **{"ds": 0.1, "name": "lane", **options})
