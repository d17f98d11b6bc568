"""Quick corrections of trained estimators by calibration drives of one vehicle."""

from functools import cache

import numpy as np
import pytest

from estimators import create
from estimators.api import Calibratable, CalibrationDrive, CalibrationError, check_estimate
from estimators.common import pretrained
from estimators.common.pretrained import NOTE, Prediction, TrainingExample, fit_corrections
from estimators.common.spatial_signals import SpatialSignals
from leaderboard.metrics.heights import nrmse
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Profile, Record, scored_band
from road_envs.roads import realise_road
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")


@cache
def drive(seed: int, speed_kmh: float = 54.0, mode: str = "handling") -> tuple[Record, Profile]:
    """A drive of one individual of grade S3, which the shipped weights do not know."""
    road = realise_road("iso_d", seed, 100.0)
    return simulate_record(road, speed_kmh=speed_kmh, mode=mode, seed=7, grade="S3")


def error(estimator, record: Record, truth: Profile) -> float:
    estimate = estimator.estimate(record, CAR)
    check_estimate(estimate, record)
    band = scored_band(float(record.v.mean()))
    return nrmse(truth.z, estimate.z, truth.ds, band).pooled


@pytest.mark.parametrize("name", ["fir_ridge", "tcn"])
def test_one_known_drive_reduces_the_error_on_a_vehicle_with_a_frame(name):
    record, truth = drive(41)
    plain = create(name)
    assert isinstance(plain, Calibratable)
    calibrated = plain.calibrate([CalibrationDrive(record, truth)], CAR)
    assert error(calibrated, *drive(51)) < 0.75 * error(plain, *drive(51))
    assert NOTE in calibrated.estimate(drive(51)[0], CAR).notes
    for key, x in calibrated.weights().items():
        np.testing.assert_array_equal(x, plain.weights()[key])


def test_a_correction_serves_its_own_state_and_speed_only():
    record, truth = drive(41)
    plain = create("fir_ridge")
    calibrated = plain.calibrate([CalibrationDrive(record, truth)], CAR)
    for other in (drive(51, 36.0)[0], drive(51, 54.0, "ride")[0]):
        estimate = calibrated.estimate(other, CAR)
        np.testing.assert_array_equal(estimate.z, plain.estimate(other, CAR).z)
        assert NOTE not in estimate.notes


def test_unmeasured_roads_correct_nothing_and_wrong_profiles_are_refused():
    record, truth = drive(41)
    assert create("fir_ridge").calibrate([CalibrationDrive(record)], CAR).corrections == ()
    for wrong in (drive(99)[1], Profile(truth.s, truth.z[::-1, ::-1])):
        with pytest.raises(CalibrationError, match=r"a\.csv: .* nothing of the profile"):
            create("fir_ridge").calibrate([CalibrationDrive(record, wrong, name="a.csv")], CAR)


def test_known_coefficients_are_found(monkeypatch):
    """Of three features, from an error that is their weighted sum, in the unit of each station."""
    monkeypatch.setattr(pretrained, "keep_short_waves", lambda x, causal: x)
    record, truth = drive(41)
    example = TrainingExample.of(record, truth, False)
    rng = np.random.default_rng(0)
    m, q = np.array([0.5, -1.0, 2.0]), np.array([0.0, 0.3, 0.1])
    x = rng.standard_normal((2, 3, example.signals.size))
    unit = 0.01 * (1.0 + rng.random(example.signals.size))

    def predict(signals: SpatialSignals) -> Prediction:
        estimate = example.target - unit * np.array([m @ x[0], q @ x[1]])
        return Prediction(estimate, unit, 1e9, x)

    drives = [CalibrationDrive(record, truth)]
    (found,) = fit_corrections(drives, False, predict)
    np.testing.assert_allclose(found.coefficients[:, :3], [m, q], atol=2e-3)
    corrected = found.correct(predict(example.signals), example.signals, False)
    np.testing.assert_allclose(corrected, example.target, atol=1e-4)
    assert found.speed == pytest.approx(15.0, rel=0.03)
    np.testing.assert_array_equal(found.state, np.ones(4))


def test_stations_beside_the_profile_are_not_used():
    record, truth = drive(41)
    half = Profile(truth.s[: truth.s.size // 2], truth.z[:, : truth.s.size // 2])
    calibrated = create("fir_ridge").calibrate([CalibrationDrive(record, half)], CAR)
    assert error(calibrated, *drive(51)) < 0.8 * error(create("fir_ridge"), *drive(51))
