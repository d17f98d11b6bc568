"""Nonstationary roads: mean spectrum, kurtosis and patches."""

import numpy as np
import pytest
from oracles_roads import iso_density, segment_spectrum
from scipy.signal import butter, sosfiltfilt
from scipy.stats import gamma, kstest, lognorm

from road_envs.core.config import ConfigError
from road_envs.roads import load_road
from road_envs.roads.iso8608 import Iso8608, RoughnessVariation

LAWS = {
    "gamma": lambda cv: gamma(1.0 / cv**2, scale=cv**2),
    "lognormal": lambda cv: lognorm(np.sqrt(np.log(1.0 + cv**2)), scale=1.0 / np.sqrt(1.0 + cv**2)),
}


def rng(seed=0):
    return np.random.default_rng(seed)


def varying(law="gamma", spread=0.7, patch=50.0, length=4000.0, **settings):
    variation = RoughnessVariation(law=law, spread=spread, patch=patch)
    band = dict(n_min=0.05, n_max=5.0, ds=0.05)
    return Iso8608(G_d0=256e-6, length=length, variation=variation, **band, **settings)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("spread", [0.3, 0.7, 1.5])
def test_patch_levels_follow_their_distribution(law, spread):
    level = RoughnessVariation(law=law, spread=spread, patch=2.0).draw(rng(), 40_000, 1.0)
    patches = level[1:][np.diff(level) != 0.0]
    assert patches.size == pytest.approx(20_000, abs=1)
    assert kstest(patches, LAWS[law](spread).cdf).pvalue > 1e-3
    assert LAWS[law](spread).mean() == pytest.approx(1.0)
    assert LAWS[law](spread).std() == pytest.approx(spread)


def test_patches_have_their_length_and_a_uniform_offset():
    firsts = []
    for seed in range(200):
        level = RoughnessVariation(patch=10.0).draw(rng(seed), 1000, 0.1)
        ends = np.flatnonzero(np.diff(level))
        np.testing.assert_array_equal(np.diff(ends), 100)
        firsts.append(ends[0])
    assert kstest(np.array(firsts) / 100.0, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.costly
def test_the_mean_spectrum_is_that_of_the_stationary_road(law):
    paths = np.concatenate([varying(law).realise(rng(k)).z for k in range(12)])
    each = np.array([segment_spectrum(z, 0.05, 800)[1] for z in paths])
    n = segment_spectrum(paths[0], 0.05, 800)[0]
    ratio = each[:, (n > 0.25) & (n < 4.5)] / iso_density(n[(n > 0.25) & (n < 4.5)], 256e-6)
    level = ratio.mean(axis=1)  # of each path; both paths of a road share the level
    assert abs(level.mean() - 1.0) < 4.0 * level.std() / np.sqrt(12)
    assert level.std() / np.sqrt(12) < 0.04
    octaves = [part.mean() for part in np.array_split(ratio, 4, axis=1)]
    np.testing.assert_allclose(octaves, level.mean(), rtol=0.05)


def short_waves(z, ds=0.05, low=1.0):
    """Return the waves of the paths (2, N) that are shorter than 1 / `low`, without the ends."""
    sos = butter(4, low, "highpass", fs=1.0 / ds, output="sos")
    return sosfiltfilt(sos, z)[:, 200:-200]


@pytest.mark.parametrize(("law", "spread"), [("gamma", 0.7), ("lognormal", 0.5)])
@pytest.mark.costly
def test_short_waves_have_the_kurtosis_of_their_distribution(law, spread):
    parts = [short_waves(varying(law, spread).realise(rng(k)).z) for k in range(40)]
    m2, m4 = (np.array([np.mean(x**p) for x in parts]) for p in (2, 4))
    kurtosis = m4.mean() / m2.mean() ** 2
    drop_one = [np.delete(m4, k).mean() / np.delete(m2, k).mean() ** 2 for k in range(40)]
    error = np.sqrt(39.0) * np.std(drop_one)  # jackknife
    # 0.1: bias, because short waves average the levels of both patches at a boundary
    assert abs(kurtosis - 3.0 * (1.0 + spread**2)) < 4.0 * error + 0.1
    assert error < 0.2


def test_a_stationary_road_has_gaussian_kurtosis():
    road = Iso8608(G_d0=256e-6, length=4000.0, n_min=0.05, n_max=5.0, ds=0.05)
    parts = np.array([short_waves(road.realise(rng(k)).z) for k in range(10)])
    assert np.mean(parts**4) / np.mean(parts**2) ** 2 == pytest.approx(3.0, abs=0.05)


def test_both_wheel_paths_share_the_roughness_level():
    z = short_waves(varying(length=8000.0, coherence="none").realise(rng(1)).z)
    power = np.log((z[:, : z.shape[1] // 500 * 500] ** 2).reshape(2, -1, 500).mean(axis=-1))
    assert np.corrcoef(power)[0, 1] > 0.9
    assert abs(np.corrcoef(z)[0, 1]) < 0.05


def test_there_are_no_steps_between_patches():
    z = varying("lognormal", spread=3.0, patch=20.0).realise(rng(2)).z
    n, G = segment_spectrum(z[0], 0.05, 800)
    assert G[n > 6.0].max() < 1e-3 * G[(n > 3.0) & (n < 5.0)].mean()


@pytest.mark.parametrize("road_class", ["A", "D"])
def test_the_variation_scales_with_the_class(road_class):
    variation = RoughnessVariation()
    road, b = (Iso8608(road_class=c, variation=variation) for c in (road_class, "B"))
    factor = 2.0 ** ("ABCD".index(road_class) - 1)
    np.testing.assert_allclose(road.realise(rng()).z, factor * b.realise(rng()).z, rtol=1e-9)


@pytest.mark.parametrize(
    ("variation", "reason"),
    [
        ({"law": "normal"}, "law"),
        ({"spread": 0.0}, "spread: must be positive"),
        ({"spread": 11.0}, "spread: must be at most 10"),
        ({"patch": 1e-9}, "patch: must be at least 1, got 1e-09 m"),
        ({"patches": 3.0}, "patches: unknown key"),
    ],
)
def test_an_invalid_variation_is_named_in_one_sentence(variation, reason):
    with pytest.raises(ConfigError) as error:
        load_road({"kind": "iso8608", "road_class": "C", "variation": variation})
    assert reason in str(error.value)
