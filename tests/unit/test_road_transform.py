"""The road of the MAP smoother as filtered white noise: density, coherence, transposes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.fft import next_fast_len

from estimators.common.road_prior import increment_amplitude
from estimators.common.spline import evaluate_spline
from estimators.map_smoother.road_prior import RoadTransform
from estimators.map_smoother.tuning import TUNING
from road_envs.analysis.information_bound import RoadPrior
from road_envs.records.roughness import displacement_psd

PRIOR = RoadPrior()
NODES = next_fast_len(4064, real=True)


def free_road(size: int = NODES, ds: float = 0.05) -> RoadTransform:
    level, density = np.zeros((2, size)), np.ones(size // 2 + 1)
    amplitude = increment_amplitude(PRIOR, size, ds, flat_below=TUNING.n_flat)
    return RoadTransform(0.0, ds, level, np.ones(size), amplitude, density, np.ones((2, size)))


def uneven_road() -> RoadTransform:
    """A road that is rough in two places of one wheel path, and level at its ends."""
    road = free_road(next_fast_len(464, real=True))
    free, local = road.free.copy(), np.full(road.background.shape, 0.05)
    free[:20], free[-40:], local[0, 80:90], local[0, 300:305] = 0.0, 0.0, 4.0, 7.0
    return replace(road, free=free, local=local)


def test_roads_drawn_from_the_prior_have_its_density_and_coherence():
    road, rng = free_road(), np.random.default_rng(1)
    at = 0.02 * np.arange(500, 9500) / road.ds
    drawn = (road.coefficients(rng.standard_normal((2, road.size))) for _ in range(40))
    z = np.array([evaluate_spline(c, at) for c in drawn])
    n, G = displacement_psd(z, 0.02)
    for low, high in ((0.3, 1.0), (1.0, 3.0), (3.0, 8.0)):  # below, drift leaks into the windows
        inside = (n > low) & (n < high)
        ratio = np.mean(G[..., inside] / PRIOR.density(n[inside]))
        assert ratio == pytest.approx(1.0, abs=0.05)
    n, mean = displacement_psd(z.mean(axis=1), 0.02)
    for low, high in ((0.1, 0.2), (0.3, 0.5), (1.0, 2.0)):
        inside = (n > low) & (n < high)
        S = PRIOR.spectrum(n[inside])
        expected = 0.25 * np.real(S.sum(axis=(1, 2)))
        assert np.mean(mean[:, inside] / expected) == pytest.approx(1.0, abs=0.15)


def test_the_prior_density_is_flat_below_its_lowest_frequency():
    road = free_road()
    G = 2.0 * road.ds * np.sum(np.abs(road.transfer_function()) ** 2, axis=0)
    low = (road.n > 0.0) & (road.n < 1.0)
    np.testing.assert_allclose(
        G[low], PRIOR.density(np.maximum(road.n, TUNING.n_flat))[low], rtol=1e-12, atol=0.0
    )


def test_the_road_transform_has_its_transpose_and_is_level_where_not_free():
    road = free_road(next_fast_len(364, real=True))
    free = np.zeros(road.size)
    free[50:200] = 1.0
    road, rng = replace(road, free=free), np.random.default_rng(2)
    u, dual = rng.standard_normal((2, 2, road.size))
    c = road.apply(u)
    assert np.sum(c * dual) == pytest.approx(np.sum(u * road.apply_transpose(dual)), rel=1e-10)
    assert (c[:, :50] == 0.0).all() and (c[:, 200:] == c[:, 199:200]).all()
    twice = replace(road, density=np.full(road.n.size, 4.0))
    np.testing.assert_allclose(twice.apply(u), 2.0 * c, atol=1e-15)
    np.testing.assert_allclose(twice.apply(twice.convert_noise(u, road)), c, atol=1e-12)


def test_whitened_increments_give_the_same_coefficients_and_the_map_has_its_transpose():
    road, rng = uneven_road(), np.random.default_rng(3)
    c = np.cumsum(road.free * rng.standard_normal((2, road.size)), axis=1)
    u = road.whiten(np.diff(c, axis=1, prepend=0.0))
    np.testing.assert_allclose(road.coefficients(u), c, atol=1e-10)
    v = rng.standard_normal(c.shape)
    assert np.vdot(road.apply(u), v) == pytest.approx(np.vdot(u, road.apply_transpose(v)))
    even = replace(road, local=np.ones_like(road.local))
    np.testing.assert_allclose(even.apply(even.convert_noise(u, road)), c, atol=1e-10)


def test_the_transfer_function_is_the_gain_of_a_single_wave():
    road, k = free_road(next_fast_len(2064, real=True)), 120
    wave = np.sqrt(2.0) * np.cos(2.0 * np.pi * k * np.arange(road.size) / road.size)
    c = road.coefficients(np.stack([wave, np.zeros(road.size)]))
    z = evaluate_spline(c, 0.05 * np.arange(20, 1900) / road.ds)
    assert (z[0] == z[1]).all()
    assert z[0].std() == pytest.approx(abs(road.transfer_function()[0, k]), rel=1e-3)
