"""One road from several passes: the mean of estimates of any estimator, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import estimators
from estimators.common.alignment import identity_map
from estimators.passes import AlignedPass, _combine, align_passes, estimate_passes
from leaderboard.metrics.heights import nrmse
from road_envs.core.config import ConfigError
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Estimate, Record, profile_stations, scored_band
from road_envs.roads import realise_road

ROAD = realise_road("iso_c", 4, 120.0)
LENGTH = 60.0


def drive(begin=0.0, lag=0.0, stretch=0.0, length=LENGTH, v=10.0):
    """A record whose odometer tells 0 where the true station is `begin` + `lag`."""
    t = np.arange(0.0, length / v, 1e-3)
    off = np.zeros((t.size, 4), dtype=bool)
    record = Record(t, np.zeros((3, t.size)), np.full(t.size, v), v * t, off, off, length)
    s = profile_stations(length)
    return record, begin + lag + (1.0 + stretch) * s


def single(true, std, seed, slope=0.0):
    """An estimate of ROAD at the `true` stations, with white errors of `std` [m] and a drift."""
    error = std * np.random.default_rng(seed).standard_normal((2, true.size))
    s = profile_stations(LENGTH)[: true.size]
    return Estimate(s, ROAD.height(true) + error + slope * s, np.full((2, true.size), std))


def test_the_mean_is_weighted_by_inverse_variance_and_its_error_is_that_of_the_weights():
    s = profile_stations(LENGTH)
    std = np.array([0.001, 0.003])
    whole = identity_map(LENGTH)
    passes = [
        AlignedPass("a", drive()[0], single(s, x, k, slope=0.01 * k), whole)
        for k, x in enumerate(std)
    ]
    found = _combine(passes)
    expected = np.average([p.estimate.z for p in passes], axis=0, weights=std**-2)
    difference = found.z - expected
    assert np.ptp(difference, axis=1).max() < 1e-12  # but for the datum
    np.testing.assert_allclose(found.z_std, 1.0 / np.sqrt(np.sum(std**-2)), rtol=0.3)
    error = found.z - ROAD.height(s)
    band = scored_band(10.0)
    alone = nrmse(ROAD.height(s), passes[0].estimate.z, passes[0].estimate.ds, band).pooled
    joint = nrmse(ROAD.height(s), found.z, found.ds, band).pooled
    assert error.shape == found.z.shape and joint < 0.97 * alone


def test_passes_that_disagree_widen_the_standard_deviation():
    s = profile_stations(LENGTH)
    whole, record = identity_map(LENGTH), drive()[0]
    honest = [single(s, 0.001, k) for k in range(4)]
    # the standard deviation is that inside the band, a fifth of the power of white errors
    told = [replace(x, z_std=np.full_like(x.z, 0.0001)) for x in honest]
    ratio = [
        _combine([AlignedPass("a", record, x, whole) for x in each]).z_std.mean()
        / each[0].z_std.mean()
        for each in (honest, told)
    ]
    assert ratio[0] == pytest.approx(0.5, rel=1e-3)
    assert ratio[1] > 1.5 * 0.5


def test_a_pass_that_ends_early_leaves_no_step():
    s = profile_stations(LENGTH)
    half = replace(single(s, 0.0002, 1), s=s[: s.size // 2])
    half = replace(half, z=half.z[:, : half.s.size] + 0.3, z_std=half.z_std[:, : half.s.size])
    passes = [
        AlignedPass("a", drive()[0], single(s, 0.0002, 0), identity_map(LENGTH)),
        AlignedPass("b", drive(length=LENGTH / 2)[0], half, identity_map(LENGTH / 2)),
    ]
    error = _combine(passes).z - ROAD.height(s)
    assert np.abs(np.diff(error, axis=1)).max() < 0.002
    after = _combine(passes).z_std[:, -10:]
    np.testing.assert_allclose(after, 0.0002, rtol=1e-6)


def test_records_get_the_stations_of_the_first_and_the_note_has_the_shift():
    (first, at), (second, moved) = drive(begin=10.0), drive(begin=10.0, lag=2.5, stretch=0.008)
    told = replace(single(moved, 0.0005, 2), notes=("samples clipped",))
    aligned, notes = align_passes(
        [first, second], [single(at, 0.0005, 1), told], ["a.csv", "b.csv"]
    )
    assert _combine(aligned).notes == ("b.csv: samples clipped",)
    true = 2.5 + 1.008 * second.s
    inner = (second.s > 8.0) & (second.s < 50.0)
    assert np.abs(aligned[1].record.s - true)[inner].max() < 0.02
    assert np.median(aligned[1].record.v) == pytest.approx(10.08, abs=0.01)
    assert "b.csv: stations moved by +2.7" in notes[0] and "onto a.csv" in notes[0]
    assert "it covers 2.5 to 60.0 m" in notes[0]


def test_another_road_and_the_opposite_direction_are_refused_by_name():
    record, s = drive(begin=10.0)
    first = single(s, 0.0005, 1)
    names, records = ["a.csv", "b.csv"], [record, record]
    back = replace(first, z=first.z[::-1, ::-1].copy())
    with pytest.raises(ConfigError, match=r"b.csv was recorded in the opposite direction to a.csv"):
        align_passes(records, [first, back], names)
    swapped = replace(first, z=first.z[::-1].copy())
    with pytest.raises(ConfigError, match=r"b.csv was recorded with left and right exchanged"):
        align_passes(records, [first, swapped], names)
    other = replace(first, z=realise_road("iso_c", 9, 80.0).height(first.s))
    with pytest.raises(ConfigError, match=r"b.csv matches a.csv nowhere"):
        align_passes(records, [first, other], names)


@pytest.mark.costly
def test_any_estimator_estimates_several_passes():
    road = realise_road("iso_c", 3, 40.0)
    records, truths = zip(
        *(simulate_record(road, speed_kmh=14.5, mode="handling", seed=k) for k in (1, 2)),
        strict=True,
    )
    later = replace(records[1], s=records[1].s + 1.5)
    found = estimate_passes("iterated_wiener", [records[0], later])
    alone = estimators.estimate("iterated_wiener", records[0])
    error, once = (nrmse(truths[0].z, x.z, x.ds, scored_band(4.0)).pooled for x in (found, alone))
    assert error < once
    assert any("pass 2: stations moved by -1.5" in note for note in found.notes)
    np.testing.assert_array_equal(estimate_passes("iterated_wiener", records[:1]).z, alone.z)


def test_a_drive_given_twice_is_refused():
    record, _ = drive()
    other = replace(record, a=record.a + 1.0)
    with pytest.raises(ConfigError, match=r"^a and c are the same drive: give each pass once$"):
        estimate_passes("flat", [record, other, record], names=["a", "b", "c"])


def test_as_many_vehicles_and_names_as_records_are_needed():
    record, _ = drive()
    with pytest.raises(ConfigError, match="2 records need one vehicle or 2, got 3"):
        estimate_passes("flat", [record, record], ["land_rover_defender_110"] * 3)
    with pytest.raises(ConfigError, match="2 records need as many names, got 1"):
        estimate_passes("flat", [record, record], names=["a"])
    with pytest.raises(ConfigError, match="at least one record"):
        estimate_passes("flat", [])
