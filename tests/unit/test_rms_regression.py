"""Gaussian process against dense formulae, and its roughness estimates against the roads."""

import json
from functools import cache

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import approx_fprime
from test_wiener import drive

from estimators.roughness.rms_regression import (
    N_INPUTS,
    SLOPE_STD,
    RmsRoughness,
    _features,
    _neg_log_marginal_likelihood,
    _predict_gp,
    roughness_level,
)
from road_envs.drives.training_corpus import Corpus, drives_in_mode
from road_envs.records.record import Profile, profile_stations
from road_envs.records.roughness import roughness_class

THETA = np.array([-0.3, 0.5, 0.2, 1.0, -0.1, -1.2])


def dense(x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Covariance of the outputs at `x`, entry by entry."""
    amplitude, lengths, noise = np.exp(theta[0]), np.exp(theta[1:-1]), np.exp(theta[-1])
    K = np.empty((len(x), len(x)))
    for i, a in enumerate(x):
        for j, b in enumerate(x):
            line = SLOPE_STD**2 * (1.0 + a @ b)
            K[i, j] = line + amplitude**2 * np.exp(-0.5 * np.sum(((a - b) / lengths) ** 2))
    return K + noise**2 * np.eye(len(x))


def synthetic_data(size: int):
    rng = np.random.default_rng(0)
    x = rng.standard_normal((size, N_INPUTS))
    return x, rng.multivariate_normal(np.zeros(size), dense(x, THETA))


def test_the_marginal_likelihood_is_the_outputs_density_and_its_gradient_matches():
    x, y = synthetic_data(15)
    value, slope = _neg_log_marginal_likelihood(x, y, THETA)
    assert value == pytest.approx(-stats.multivariate_normal(cov=dense(x, THETA)).logpdf(y))
    differences = approx_fprime(
        THETA, lambda theta: _neg_log_marginal_likelihood(x, y, theta)[0], 1e-6
    )
    np.testing.assert_allclose(slope, differences, rtol=1e-3, atol=1e-4)


def test_a_prediction_is_the_conditional_of_the_joint_density():
    x, y = synthetic_data(15)
    K = dense(x, THETA)
    rest = slice(0, 12), slice(12, 15)
    known, across, own = K[rest[0], rest[0]], K[rest[1], rest[0]], K[rest[1], rest[1]]
    mean, std = _predict_gp(x[:12], y[:12], THETA, x[12:])
    solved = np.linalg.inv(known)
    np.testing.assert_allclose(mean, across @ solved @ y[:12], rtol=1e-6)
    expected = np.sqrt(np.diag(own - across @ solved @ across.T))
    np.testing.assert_allclose(std, expected, rtol=1e-6)


def test_the_road_level_is_the_geometric_mean_of_its_scored_octaves():
    """One cosine per octave; the level is the geometric mean of their densities."""
    stations = profile_stations(400.0)
    z = np.zeros(stations.size)
    for n, G_d0 in ((0.25, 4e-4), (0.5, 1e-4), (1.0, 4e-4)):
        width = n * (2.0**0.5 - 2.0**-0.5)
        z += np.sqrt(2.0 * G_d0 * (n / 0.1) ** -2.0 * width) * np.cos(2.0 * np.pi * n * stations)
    truth = Profile(stations, np.array([z, z]))
    assert roughness_level(truth, 15.0) == pytest.approx((4e-4 * 1e-4 * 4e-4) ** (1 / 3), rel=0.05)


@cache
def regression(mode: str):
    drives = drives_in_mode(Corpus(), dict.fromkeys(("front", "rear"), mode), (30.0, 72.0), 40)
    return RmsRoughness.fit(*zip(*drives, strict=True))


@pytest.mark.parametrize("road", ["iso_b", "iso_c", "iso_d"])
def test_roads_are_classified_correctly(road):
    record, truth = drive("defender", road, "handling", 54.0, length=150.0)
    found, true = regression("handling").predict(record), roughness_level(truth, 15.0)
    off = np.log(found.G_d0 / true)
    assert abs(off) < np.log(10.0**0.2) and abs(off) < 4.0 * found.log_std
    assert found.log_std < 0.4
    assert sum(found.probability.values()) == pytest.approx(1.0)
    assert found.letter == roughness_class(true)


def test_the_estimate_does_not_depend_on_the_speed():
    """The same road driven faster shakes the vehicle more; the estimates agree."""
    slow, fast = (drive("defender", "iso_c", "handling", v, length=150.0) for v in (33.0, 60.0))
    difference = _features(fast[0])[1:] - _features(slow[0])[1:]
    assert difference.mean() > 0.3  # as if its density were almost twice as high
    for record, truth in (slow, fast):
        true = roughness_level(truth, float(np.median(record.v)))
        assert abs(np.log(regression("handling").predict(record).G_d0 / true)) < 0.46


@pytest.mark.costly
def test_the_command_reports_the_class_by_either_method(road_recon):
    simulate = ("simulate", "--road", "iso_c", "--length", "100", "--speed-kmh", "36")
    assert road_recon(*simulate, "--out", "d.parquet")[0] == 0
    code, out, _ = road_recon("classify", "d.parquet", "--method", "rms", "--json")
    facts = json.loads(out)
    assert code == 0 and facts["class"] == "C" and facts["probability"]["C"] > 0.5
    code, _, err = road_recon("classify", "d.parquet", "--method", "rsm")
    assert code == 2 and "unknown method 'rsm'" in err and "rms" in err
