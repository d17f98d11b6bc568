"""Tests of what estimators do where their model does not explain the drive."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_fixtures import DEFENDER

import estimators
from estimators.common.explained import reduce_unexplained, trusted_share, untrusted_note
from leaderboard.metrics.heights import nrmse
from road_envs.drives.recording import simulate_record
from road_envs.records.record import PROFILE_SPACING, scored_band
from road_envs.sensing.instruments import load_instruments

PAPER = load_instruments("paper")


def share_of(record, z, car=DEFENDER):
    return trusted_share(record, np.isfinite(record.a), car, PAPER, z)


@pytest.fixture(scope="module")
def drive():
    return simulate_record("iso_d", speed_kmh=30.0, mode="handling", seed=4, length=60.0)


def test_the_true_road_is_trusted_and_another_one_is_not(drive):
    record, truth = drive
    assert share_of(record, truth.z).min() == 1.0
    other, _ = simulate_record("iso_d", speed_kmh=30.0, seed=5, length=60.0)
    assert share_of(other, truth.z).max() < 0.2
    assert share_of(record, np.full_like(truth.z, 0.3)).max() < 0.05


def test_the_share_is_local_and_its_note_gives_the_distance(drive):
    record, truth = drive
    z = truth.z.copy()
    bad = truth.s > 40.0
    z[:, bad] *= -1.0
    share = share_of(record, z)
    assert share[truth.s < 25.0].min() > 0.95 and share[truth.s > 52.0].max() < 0.05
    (note,) = untrusted_note(share)
    metres = float(note.split()[1])
    assert metres == pytest.approx(20.0, abs=10.0) and untrusted_note(np.ones(9)) == ()
    assert PROFILE_SPACING * np.sum(share < 0.95) == pytest.approx(metres, abs=0.5)


def test_lost_samples_are_not_compared(drive):
    record, truth = drive
    a, valid = record.a.copy(), np.ones(record.a.shape, dtype=bool)
    a[:, 2000:2100], valid[:, 2000:2100] = 500.0, False
    masked = replace(record, a=a)
    assert trusted_share(masked, valid, DEFENDER, PAPER, truth.z).min() > 0.9


def test_what_the_model_does_not_explain_is_taken_away_and_counted_as_error():
    z, std = np.array([[1.0, -1.0], [3.0, -3.0]]), np.full((2, 2), 0.4)
    reduced, wider = reduce_unexplained(z, std, 0.25)
    np.testing.assert_allclose(reduced, 0.25 * z)
    np.testing.assert_allclose(wider, np.hypot(0.4, 0.75 * np.abs(z)))
    assert reduce_unexplained(z, std, 1.0)[1] is std


@pytest.mark.parametrize("name", ["kalman_lag", "kalman_rts", "iterated_wiener"])
@pytest.mark.costly
def test_on_a_vehicle_far_from_the_described_one_no_estimate_is_worse_than_a_flat_road(name):
    record, truth = simulate_record(
        "iso_d", speed_kmh=54.0, mode="handling", seed=25, grade="S2", length=100.0, step=5e-4
    )
    estimate = estimators.create(name).estimate(record, DEFENDER)
    assert nrmse(truth.z, estimate.z, truth.ds, scored_band(15.0)).pooled < 1.0
