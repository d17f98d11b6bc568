"""Calibration factors of standard deviations: recovered where known, and coverage on the main
board.
"""

import numpy as np
import pytest
from scipy import signal
from test_pretraining import errors_and_coverage

from estimators import create
from estimators.common.coverage import coverage_factors
from estimators.common.spatial_signals import SPACING
from estimators.linear.fir_bank import FirBank
from estimators.networks.std_calibration import (
    N_TERMS,
    StdScale,
    _design_matrix,
    in_scored_band,
)
from leaderboard import pretraining
from leaderboard.metrics.heights import band_pass, scored_band
from road_envs.drives.training_corpus import Corpus
from road_envs.records.record import PROFILE_SPACING


def conditions(rng: np.random.Generator, size: int = 1) -> np.ndarray:
    """Conditions as of a network: speed, its square, four states, level, scale."""
    states = np.repeat(rng.choice([-1.0, 1.0], (4, 1)), size, axis=1)
    u, level = rng.uniform(-2.0, 1.4), rng.uniform(-1.0, 1.0)
    rest = np.array([[u], [u**2 - 1.0]]), np.array([[level], [level]])
    return np.concatenate([rest[0] * np.ones(size), states, rest[1] * np.ones(size)])


def drives(true: StdScale, draw, number: int = 400):
    """Error ratios drawn by `draw` at unit scale, times the factor of `true`, with conditions."""
    rng = np.random.default_rng(1)
    drive_conditions = [conditions(rng) for _ in range(number)]
    return [draw(rng, (2, 500)) * true(each) for each in drive_conditions], drive_conditions


def normal(rng, shape):
    return rng.standard_normal(shape)


def test_factors_depending_on_speed_states_and_level_are_recovered():
    true = StdScale(0.15 * np.random.default_rng(0).standard_normal(N_TERMS))
    ratios, drive_conditions = drives(true, normal)
    found = StdScale.fit(ratios, drive_conditions)
    new = [conditions(np.random.default_rng(k)) for k in range(1000, 1200)]
    off = [found(each)[0] / true(each)[0] for each in new]
    np.testing.assert_allclose(off, 1.0, atol=0.06)


def test_heavy_tailed_errors_get_a_compromise_between_both_coverages():
    """Student's t with three degrees of freedom: 50 % and 90 % need 1.13 and 1.43."""
    ratios, drive_conditions = drives(
        StdScale.constant(2.0), lambda rng, shape: rng.standard_t(3, shape)
    )
    found = StdScale.fit(ratios, drive_conditions)
    inside = np.mean(
        [
            [np.mean(np.abs(r) < far * found(c)) for far in (0.6745, 1.6449)]
            for r, c in zip(ratios, drive_conditions, strict=True)
        ],
        axis=0,
    )
    assert inside.sum() == pytest.approx(1.4, abs=0.01)
    assert 0.5 < inside[0] < 0.58 and 0.82 < inside[1] < 0.9


def test_a_constant_factor_is_the_same_under_all_conditions():
    drive_conditions = conditions(np.random.default_rng(3), 5)
    np.testing.assert_allclose(StdScale.constant(0.7)(drive_conditions), 0.7)
    assert _design_matrix(drive_conditions).shape == (N_TERMS, 5)


def test_the_coverage_factors_of_gaussian_errors_are_their_scale():
    errors = np.random.default_rng(0).standard_normal(200_000)
    assert coverage_factors(3.0 * errors) == pytest.approx(3.0, rel=0.01)


@pytest.mark.parametrize("v", [4.0, 15.0])
def test_the_scored_band_at_the_stations_equals_that_of_the_metrics(v):
    """Up to 1.5 cycles/m stations every 0.15 m represent the profile at 25 mm."""
    rng = np.random.default_rng(2)
    sos = signal.butter(4, [0.1, 1.7], "band", fs=1.0 / PROFILE_SPACING, output="sos")
    fine = signal.sosfiltfilt(sos, rng.standard_normal((2, 8000)), axis=1)
    step = round(SPACING / PROFILE_SPACING)
    found = in_scored_band(fine[:, ::step], v)[:, 60:-60].std()
    assert found == pytest.approx(band_pass(fine, PROFILE_SPACING, scored_band(v)).std(), rel=0.02)


def test_the_command_trains_and_then_calibrates_on_the_nominal_vehicle(tmp_path, monkeypatch):
    """By the command, and again step by step; the bank is fitted to the rigid bodies."""
    numbers_of_drives = []

    def fake_bank(_, all_signals, targets, behind, ahead):
        numbers_of_drives.append(len(all_signals))
        return FirBank(np.full(FirBank.shape(behind, ahead), 1e-3, np.float16), ahead)

    monkeypatch.setattr(FirBank, "fit", classmethod(fake_bank))
    corpus = Corpus(number=4, shortest=20, longest=30)
    estimator, path = create("tcn", channels=4, steps=4), tmp_path / "t.safetensors"
    written = pretraining.train(estimator, "tcn", corpus, 1, path, "road-recon train tcn")
    examples = [estimator.training_example(*corpus.simulate_drive(k)) for k in range(4)]
    plain = estimator.pretrain(examples, corpus.vehicle, 1)
    calibration_drives = [
        estimator.training_example(*corpus.simulate_drive(k, nominal=True)) for k in (4, 5)
    ]
    again, before = plain.calibrate_deviations(calibration_drives).weights(), plain.weights()
    for name, x in written.weights().items():
        np.testing.assert_array_equal(x, again[name])
        if name != "widths":
            np.testing.assert_array_equal(x, before[name])
    assert (again["widths"] != before["widths"]).any()
    assert numbers_of_drives == [3, 3] == 2 * [sum(example.rigid for example in examples)]


def test_a_nominal_drive_differs_from_its_twin_by_the_vehicle_only():
    corpus = Corpus(number=4, shortest=20, longest=30)
    (record, truth, _), (plain, same, _) = (
        corpus.simulate_drive(3),
        corpus.simulate_drive(3, nominal=True),
    )
    np.testing.assert_array_equal(truth.z, same.z)
    np.testing.assert_array_equal(record.v, plain.v)
    np.testing.assert_array_equal(record.spring_stiff, plain.spring_stiff)
    assert np.abs(record.a - plain.a).max() > 0.1


@pytest.mark.costly
@pytest.mark.parametrize(
    "name",
    [
        "tcn",
        "gru_causal",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("tcn_causal", "gru")),
    ],
)
def test_shipped_intervals_have_the_stated_coverage_on_the_main_board(name):
    """Within 4 points over all conditions; in each, of two roads, within 14 and 10."""
    rows = errors_and_coverage(name, 2).values()
    found = np.array([np.mean([inside for _, inside in row], axis=0) for row in rows])
    np.testing.assert_allclose(found.mean(axis=0), [0.5, 0.9], atol=0.04)
    assert (np.abs(found - [0.5, 0.9]) < [0.14, 0.10]).all()
