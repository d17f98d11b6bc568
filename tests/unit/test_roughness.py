"""Roughness against closed forms, published golden-car coefficients and a manual spectrum."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles_roads import (
    CLASS_MEANS,
    golden_car_gain,
    iso_density,
    sayers_iri,
    segment_spectrum,
)

from road_envs.records import roughness
from road_envs.roads.iso8608 import Iso8608

MEASURED = Path(__file__).parents[3] / "shared" / "roads" / "iri_sorel" / "profile_1.txt"


def sine(n, amplitude=1e-3, length=100.0, ds=0.01):
    s = ds * np.arange(round(length / ds))
    return amplitude * np.sin(2.0 * np.pi * n * s)


def test_the_psd_equals_a_spectrum_computed_by_hand():
    z = np.random.default_rng(1).standard_normal(5000).cumsum() * 1e-3
    n, G = roughness.displacement_psd(z, 0.05, segment=50.0)
    n_hand, G_hand = segment_spectrum(z, 0.05, 1000)
    np.testing.assert_allclose(n, n_hand)
    np.testing.assert_allclose(G, G_hand, rtol=1e-9)


@pytest.mark.parametrize("n_0", [0.2, 1.0, 3.7])
def test_the_psd_of_a_sine_has_its_power_at_its_frequency(n_0):
    n, G = roughness.displacement_psd(sine(n_0, amplitude=2e-3, length=1000.0), 0.01)
    near = np.abs(n - n_0) < 0.05
    assert G[near].sum() * n[0] == pytest.approx(2e-6, rel=1e-3)
    assert G[~near].sum() * n[0] < 5e-4 * 2e-6


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.floats(1e-3, 1e3), st.floats(0.01, 1.0))
def test_the_psd_scales_with_height_squared_and_with_spacing(seed, scale, ds):
    z = np.random.default_rng(seed).standard_normal(800)
    n, G = roughness.displacement_psd(z, 1.0, segment=200.0)
    n_scaled, G_scaled = roughness.displacement_psd(scale * z, ds, segment=200.0 * ds)
    np.testing.assert_allclose(n_scaled, n / ds)
    np.testing.assert_allclose(G_scaled, G * scale**2 * ds, rtol=1e-6, atol=1e-12 * scale**2 * ds)


def test_smoothing_preserves_the_power_in_its_bands():
    n = 0.01 * np.arange(1, 1001)
    G = np.random.default_rng(2).exponential(1.0, n.size)
    centre, mean = roughness.smooth_psd(n, G)
    # centres printed in ISO 8608 for octaves, third octaves and twelfths
    for printed in (0.0156, 0.0312, 0.0496, 0.0625, 0.0787, 0.125, 0.1984, 0.25, 0.2888, 1.0293):
        assert np.abs(centre / printed - 1.0).min() < 5e-3
    width = np.where(centre < 0.04, 2**0.5 - 2**-0.5, 0.0) + np.where(
        centre > 0.27, 2 ** (1 / 24) - 2 ** (-1 / 24), 0.0
    )
    width = np.where(width == 0.0, 2 ** (1 / 6) - 2 ** (-1 / 6), width) * centre
    low, high = centre[0] - 1e-9, centre[-1]
    inside = (n > low * 2**-0.5) & (n < high * 2 ** (1 / 24))
    assert (mean * width).sum() == pytest.approx(G[inside].sum() * 0.01, rel=2e-3)


def test_smoothing_preserves_a_constant_psd():
    n = 0.02 * np.arange(1, 300)
    assert roughness.smooth_psd(n, np.full((2, n.size), 3.0))[1] == pytest.approx(3.0)


@settings(deadline=None)
@given(st.floats(1e-6, 1.0), st.floats(1.0, 3.5))
def test_the_fit_recovers_a_straight_line(G_d0, w):
    n = np.geomspace(0.011, 2.83, 60)
    assert roughness.fit_line(n, iso_density(n, G_d0, w)) == pytest.approx((G_d0, w))
    level, kept = roughness.fit_line(n, iso_density(n, G_d0, w), w=w)
    assert (level, kept) == (pytest.approx(G_d0), w)


def test_the_fit_uses_only_its_band():
    n = np.geomspace(0.001, 20.0, 300)
    G = np.where((n >= 0.011) & (n <= 2.83), iso_density(n, 1e-4), 1.0)
    assert roughness.fit_line(n, G) == pytest.approx((1e-4, 2.0))
    with pytest.raises(ValueError, match="fewer than 2 points"):
        roughness.fit_line(n, G, band=(30.0, 40.0))


def test_class_limits_are_twice_the_geometric_means():
    for k, (name, mean) in enumerate(CLASS_MEANS.items()):
        assert roughness.roughness_class(mean) == name
        assert roughness.roughness_class(1.99 * mean) == name
        assert roughness.roughness_class(2.01 * mean) == "ABCDEFGHH"[k + 1]
    assert roughness.roughness_class(0.0) == "A"


def test_octave_levels_of_an_iso_road_equal_its_level():
    n = 1e-3 * np.arange(1, 6000)
    centre, level = roughness.octave_levels(n, iso_density(n, 256e-6), (0.2, 2.0))
    np.testing.assert_array_equal(centre, [0.25, 0.5, 1.0, 2.0])
    np.testing.assert_allclose(level, 256e-6, rtol=1e-4)


def test_a_drawn_road_is_classified_with_its_class_and_waviness():
    roads = [
        Iso8608(road_class="C", length=1000.0).realise(np.random.default_rng(k)) for k in (1, 2)
    ]
    z = np.concatenate([road.z for road in roads])
    n, G = roughness.smooth_psd(*roughness.displacement_psd(z, 0.01))
    fits = np.array([roughness.fit_line(n, g) for g in G])
    # the level of a path of 1000 m scatters by 0.09 dB RMS at w = 2, more below 0.05 cycles/m
    assert np.log10(fits[:, 0] / 256e-6).mean() == pytest.approx(0.0, abs=0.05)
    assert fits[:, 1].mean() == pytest.approx(2.0, abs=0.05)
    assert {roughness.roughness_class(roughness.fit_line(n, g, w=2.0)[0]) for g in G} == {"C"}


TRIANGLE = {3: 0.475180, 5: 0.782931, 10: 0.508670, 15: 0.371304, 20: 0.295143, 25: 0.241392}


def triangle():
    x = 0.25 * np.arange(101)
    return 1e-3 * np.interp(x, [0.0, 1.0, 3.0, 5.0, 25.0], [0.0, 0.0, 2.0, 0.0, 0.0])


def test_the_iri_of_the_triangle_profile_is_the_published_one():
    motion = 1e3 * np.abs(roughness.golden_car(triangle(), 0.25))
    cumulative = motion.cumsum() / np.arange(1, motion.size + 1)
    for x, value in TRIANGLE.items():
        assert cumulative[round(x / 0.25) - 1] == pytest.approx(value, abs=1.5e-6)


def test_the_golden_car_agrees_with_the_printed_coefficients():
    z = 1e-3 * np.random.default_rng(4).standard_normal(2000).cumsum()
    ours = 1e3 * np.abs(roughness.golden_car(z, 0.25))
    cumulative = ours.cumsum() / np.arange(1, ours.size + 1)
    np.testing.assert_allclose(cumulative, sayers_iri(z), rtol=2e-5)


@pytest.mark.parametrize("n", [0.02, 0.065, 0.2, 0.42, 1.0])
def test_the_iri_of_a_sine_is_the_golden_car_gain(n):
    ds = 0.005
    z = sine(n, length=40.0 / n, ds=ds)
    steady = roughness.golden_car(z, ds, average=0.0)[z.size // 2 :]
    slope = 2.0 * np.pi * n * 1e-3
    assert np.abs(steady).mean() == pytest.approx(2 / np.pi * slope * golden_car_gain(n), rel=3e-3)


@pytest.mark.parametrize("n", [0.5, 1.0, 1.5])
def test_the_moving_average_attenuates_as_a_sinc(n):
    ds = 0.01
    z = sine(n, length=60.0, ds=ds)
    ratio = roughness.golden_car(z, ds)[3000:5000].std()
    ratio /= roughness.golden_car(z, ds, average=0.0)[3000:5000].std()
    assert ratio == pytest.approx(np.sinc(0.25 * n) / np.sinc(ds * n), rel=5e-3)


@settings(deadline=None, max_examples=25)
@given(st.floats(-0.2, 0.2), st.floats(-100.0, 100.0), st.sampled_from([0.01, 0.1, 0.25]))
def test_a_constant_slope_has_no_iri(slope, height, ds):
    z = height + slope * ds * np.arange(4000)
    assert roughness.iri(z, ds) == pytest.approx(0.0, abs=1e-6)


def test_the_iri_of_an_iso_road_is_the_closed_form():
    values = []
    for seed in range(12):
        z = Iso8608(road_class="B", length=2000.0).realise(np.random.default_rng(seed)).z
        values.append([roughness.iri(z, 0.01, average=0.0).mean(), roughness.iri(z, 0.01).mean()])
    mean, error = np.mean(values, axis=0), np.std(values, axis=0, ddof=1) / np.sqrt(12)
    expected = np.array([2.219, 2.173]) * np.sqrt(64e-6 / 16e-6)
    assert (np.abs(mean - expected) < 3.5 * error + 1e-3).all()
    assert (error < 0.004 * expected).all()


@pytest.mark.skipif(not MEASURED.exists(), reason="needs ../shared/roads/iri_sorel/profile_1.txt")
def test_the_iri_of_a_measured_road_agrees_with_three_other_methods():
    z = np.loadtxt(MEASURED)[:, 1]
    expected = [3.29852, 2.44211, 3.55511, 4.08554, 2.70789]
    assert roughness.iri(z, 0.25, segment=100.0) == pytest.approx(expected, abs=5e-5)
    assert roughness.iri(z, 0.25) == pytest.approx(3.34, abs=0.005)


def test_segment_values_average_the_whole():
    z = np.random.default_rng(5).standard_normal((2, 3, 4001)).cumsum(axis=-1) * 1e-4
    parts = roughness.iri(z, 0.1, segment=100.0)
    assert parts.shape == (2, 3, 3)  # 400 m minus the 0.25 m of the moving average
    whole = np.abs(roughness.golden_car(z, 0.1))[..., :3000]
    np.testing.assert_allclose(parts.mean(axis=-1), 1e3 * whole.mean(axis=-1))


def test_a_profile_shorter_than_the_moving_average_is_rejected():
    with pytest.raises(ValueError, match="shorter"):
        roughness.iri(np.zeros(20), 0.01)
