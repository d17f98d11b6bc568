"""Enveloping of the road's nodes by tyres."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.common.footprint import Footprint
from road_envs.roads.surface import Surface, enveloped


@pytest.mark.parametrize("length", [0.02, 0.1, 0.18])
@pytest.mark.parametrize("ds", [0.025, 0.05])
def test_a_wave_is_scaled_by_the_sinc_of_the_contact_length(length, ds):
    weights = Footprint.of(length, ds).weights
    node = np.arange(weights.size) - weights.size // 2
    for n in (0.2, 1.0, 1.8):
        gain = weights @ np.cos(2.0 * np.pi * n * ds * node)
        assert gain == pytest.approx(np.sinc(n * length), abs=4e-3)


def test_a_rough_road_is_enveloped_as_the_simulated_surface_is():
    ds, z = 0.025, np.random.default_rng(1).standard_normal((2, 400)).cumsum(axis=1)
    kernel = np.exp(-0.5 * (np.arange(-40, 41) / 10.0) ** 2)
    z = np.array([np.convolve(path, kernel / kernel.sum(), mode="same") for path in z])
    surface = enveloped(Surface(z, ds), 0.18)
    expected = surface.height(ds * np.arange(400))
    found = Footprint.of(0.18, ds).apply(z)
    inside = slice(50, -50)
    change = np.abs(z - expected)[:, inside].max()
    assert np.abs(found - expected)[:, inside].max() < 0.02 * change


@given(st.floats(0.0, 0.4), st.integers(0, 100))
def test_transpose_and_level_ends(length, seed):
    footprint, rng = Footprint.of(length, 0.04), np.random.default_rng(seed)
    a, b = rng.standard_normal((2, 2, 30))
    forward, backward = np.sum(b * footprint.apply(a)), np.sum(a * footprint.apply_transpose(b))
    assert forward == pytest.approx(backward, abs=1e-10)
    np.testing.assert_allclose(footprint.apply(np.ones((2, 30))), 1.0, atol=1e-12)


def test_no_contact_length_changes_nothing():
    c = np.random.default_rng(0).standard_normal((2, 9))
    assert Footprint.of(0.0, 0.05).apply(c) is c
