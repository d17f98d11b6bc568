"""Random roads against their specified spectra, coherences and variances."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles_roads import CLASS_MEANS, iso_density, isotropic_root_coherence, segment_spectrum

from road_envs.records.roughness import root_coherence
from road_envs.roads import load_road, with_length
from road_envs.roads.iso8608 import Iso8608


def rng(seed=0):
    return np.random.default_rng(seed)


# random roads


@cache
def draws(name, count=60, length=100.0):
    road = with_length(load_road(name), length)
    return np.array([road.realise(rng(1000 + k)).z for k in range(count)])


def spectra(z, ds=0.01, size=2000):
    """Return n, the mean density of both paths over all roads, and its standard error."""
    each = np.array([segment_spectrum(path, ds, size)[1] for path in z.reshape(-1, z.shape[-1])])
    n = segment_spectrum(z[0, 0], ds, size)[0]
    return n, each.mean(axis=0), each.std(axis=0) / np.sqrt(len(each))


def test_an_iso_road_has_the_specified_spectrum():
    n, G, error = spectra(draws("iso_d"))
    use = (n >= 0.25) & (n <= 9.5)  # spectral leakage of the 20 m segments below
    score = (G[use] / iso_density(n[use], 1024e-6) - 1.0) / (error[use] / G[use])
    assert np.abs(score).max() < 4.5
    assert np.abs(score.mean()) < 4.0 / np.sqrt(score.size)


def test_there_is_no_roughness_beyond_n_max():
    n, G, _ = spectra(draws("iso_d"))
    assert G[n > 11.0].max() < 1e-3 * iso_density(10.0, 1024e-6)


@pytest.mark.parametrize("w", [1.0, 2.0, 2.6])
def test_the_variance_is_the_integral_of_the_density(w):
    road = Iso8608(G_d0=256e-6, w=w, length=2000.0, ds=0.04, n_min=0.05, coherence="none")
    variance = np.array([road.realise(rng(k)).z.var(axis=1) for k in range(30)]).ravel()
    n = np.geomspace(0.05, 10.0, 20001)
    expected = np.trapezoid(iso_density(n, 256e-6, w), n)
    assert abs(variance.mean() - expected) < 4.0 * variance.std() / np.sqrt(variance.size)
    assert variance.std() < 0.2 * expected


def test_the_synthesis_is_not_periodic_in_the_road_length():
    z = draws("iso_d", 100)[:, :, -1]  # relative to the start, which is at 0
    n = np.linspace(0.01, 10.0, 100001)
    expected = 2.0 * np.trapezoid(
        iso_density(n, 1024e-6) * (1.0 - np.cos(2 * np.pi * n * 100.0)), n
    )
    square = z**2
    assert abs(square.mean() - expected) < 4.0 * square.std() / np.sqrt(100)
    assert square.mean() > 0.3 * expected


@settings(deadline=None, max_examples=25)
@given(st.floats(4.0, 60.0), st.floats(0.02, 0.2), st.floats(0.02, 1.0), st.floats(0.05, 1.0))
def test_every_valid_band_can_be_realised(length, ds, n_min, share):
    n_max = n_min + share * (0.5 / ds - n_min)
    road = Iso8608(G_d0=1e-4, length=length, ds=ds, n_min=n_min, n_max=n_max)
    surface = road.realise(rng())
    assert np.isfinite(surface.z).all()
    assert surface.length == pytest.approx(length, abs=ds)


@pytest.mark.parametrize(("road_class", "mean"), CLASS_MEANS.items())
def test_a_class_is_its_geometric_mean(road_class, mean):
    a = Iso8608(road_class=road_class).realise(rng(3)).z
    np.testing.assert_allclose(a, Iso8608(G_d0=mean).realise(rng(3)).z)


@settings(deadline=None, max_examples=15)
@given(st.floats(1e-6, 1e-2), st.floats(0.01, 100.0), st.integers(0, 2**32))
def test_height_scales_with_the_root_of_the_density(G_d0, factor, seed):
    one, other = (Iso8608(G_d0=g, length=20.0).realise(rng(seed)).z for g in (G_d0, G_d0 * factor))
    np.testing.assert_allclose(other, one * np.sqrt(factor), rtol=1e-9, atol=1e-12 * one.max())


@pytest.mark.parametrize("w", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("n", [0.01, 0.05, 0.2, 0.5])
def test_the_isotropic_coherence_matches_an_isotropic_surface(n, w):
    assert root_coherence(np.array(n), w, 1.5) == pytest.approx(
        isotropic_root_coherence(n, w, 1.5), abs=2e-6
    )


def coherence(z, low, high, size=2000):
    """Return the root coherence of the paths in [`low`, `high`] cycles/m, and its error."""
    window = np.hanning(size)
    parts = z[:, :, : z.shape[-1] // size * size].reshape(len(z), 2, -1, size)
    lines = np.fft.rfft((parts - parts.mean(axis=-1, keepdims=True)) * window)
    n = np.fft.rfftfreq(size, 0.01)
    left, right = np.moveaxis(lines[..., (n >= low) & (n <= high)], 1, 0)
    cross = (left * right.conj()).real.sum()
    auto = np.sqrt((np.abs(left) ** 2).sum() * (np.abs(right) ** 2).sum())
    return cross / auto, 1.0 / np.sqrt(left.size / 2.0)


def test_wheel_paths_of_an_iso_road_have_the_isotropic_coherence():
    z = draws("iso_d", 60)
    for n in (0.1, 0.2, 0.3, 0.5):
        actual, error = coherence(z, n - 1e-9, n + 1e-9)
        # 0.02: bias by the window, which averages over 0.1 cycles/m, and by leakage of long waves
        assert (
            abs(actual - isotropic_root_coherence(n, 2.0, 1.5)) < 4.0 * error + 0.02 + 0.1 * actual
        )
    actual, error = coherence(z, 2.0, 8.0)
    assert abs(actual) < 4.0 * error


def test_wheel_paths_can_be_identical_or_independent():
    same = Iso8608(road_class="C", coherence="full").realise(rng()).z
    np.testing.assert_array_equal(same[0], same[1])
    strangers = Iso8608(road_class="C", coherence="none", length=1000.0).realise(rng()).z[None]
    actual, error = coherence(strangers, 0.2, 2.0)
    assert abs(actual) < 4.0 * error


# Belgian paving


def test_belgian_paving_is_class_d_and_smoother_at_short_waves():
    n, G, _ = spectra(draws("belgian_like"))
    level = G * (n / 0.1) ** 2

    def octave(low, high):
        return level[(n >= low) & (n <= high)].mean()

    for low, high in ((0.25, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 3.0)):
        assert 512e-6 < octave(low, high) < 2048e-6
    assert 128e-6 < octave(3.5, 5.0) < 512e-6  # C
    assert 32e-6 < octave(7.2, 8.5) < 128e-6  # B
    assert octave(9.3, 9.9) < 32e-6  # A


def test_the_base_of_belgian_paving_has_its_waviness():
    n, G, _ = spectra(draws("belgian_like"))
    use = (n > 0.3) & (n < 2.8)
    assert -np.polyfit(np.log(n[use]), np.log(G[use]), 1)[0] == pytest.approx(2.15, abs=0.05)


def test_the_cobble_peak_is_six_times_the_base():
    n, G, _ = spectra(draws("belgian_like"))
    below, above = (np.argmin(np.abs(n - x)) for x in (4.7, 7.1))  # 4 sigma off the peak
    slope = np.log(G[above] / G[below]) / np.log(n[above] / n[below])
    base = G[below] * (n / n[below]) ** slope
    top = np.abs(n - 5.9) < 0.06
    assert (G[top] / base[top]).mean() == pytest.approx(6.0, rel=0.1)
    excess = np.where(np.abs(n - 5.9) < 1.2, G - base, 0.0)
    middle = (excess * n).sum() / excess.sum()
    assert middle == pytest.approx(5.9, abs=0.05)
    assert np.sqrt((excess * (n - middle) ** 2).sum() / excess.sum()) == pytest.approx(
        0.29, abs=0.05
    )


def test_coherence_is_specified_at_the_peak_and_zero_below():
    z = draws("belgian_like")
    actual, error = coherence(z, 5.85, 5.95)
    assert abs(actual - np.sqrt(0.22)) < 4.0 * error
    actual, error = coherence(z, 2.3, 4.0)
    assert abs(actual) < 4.0 * error


@pytest.mark.parametrize("length", [83.38983050847457, 124.40677966101694])
def test_paving_with_an_empty_last_spectral_cell_is_finite(length):
    surface = load_road({"kind": "belgian", "length": length}).realise(np.random.default_rng(0))
    assert np.isfinite(surface.z).all()
