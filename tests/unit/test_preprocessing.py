"""Damaged records are repaired where possible and rejected with a reason otherwise."""

from dataclasses import replace

import numpy as np
import pytest
from test_estimator_contract import drive, fit

from estimators.preprocessing import RecordError, clean_record, clipped_signs, mask_record
from road_envs.records.record import Record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")
TRAINABLE = ["static_lm", "narx", "fir_ridge", "tcn", "tcn_causal", "gru", "gru_causal"]


def select_samples(record: Record, kept: np.ndarray) -> Record:
    """The record reduced to the samples `kept`."""
    fields = {
        name: getattr(record, name)[kept] for name in ("t", "v", "s", "spring_stiff", "damper_high")
    }
    return replace(record, a=record.a[:, kept], **fields)


def with_gap(record: Record, share: float, row: int = 1) -> Record:
    """The record with NaN in the middle of one sensor, over a fraction of its samples."""
    a = record.a.copy()
    begin = record.t.size // 3
    a[row, begin : begin + round(share * record.t.size)] = np.nan
    return replace(record, a=a)


def test_a_clean_record_is_returned_itself():
    record, _ = drive(200)
    found, notes = clean_record(record)
    assert found is record and notes == ()


def test_missing_samples_are_interpolated_linearly_and_noted():
    record, _ = drive(201)
    found, notes = clean_record(with_gap(record, 0.01))
    assert notes == ("LR: 1.0% of the samples are missing",)
    begin, size = record.t.size // 3, round(0.01 * record.t.size)
    bridge = found.a[1, begin - 1 : begin + size + 1]
    np.testing.assert_allclose(np.diff(bridge, 2), 0.0, atol=1e-12)
    np.testing.assert_array_equal(found.a[[0, 2]], record.a[[0, 2]])
    np.testing.assert_array_equal(found.a[1, :begin], record.a[1, :begin])


def test_dropped_samples_are_restored_at_their_times():
    record, _ = drive(202)
    kept = np.ones(record.t.size, dtype=bool)
    kept[100:103] = kept[500:520:2] = False
    switching = (np.arange(record.t.size) // 7 % 2 > 0)[:, None].repeat(4, axis=1)
    record = replace(record, damper_high=switching)
    found, notes = clean_record(select_samples(record, kept))
    assert notes[-1] == "the clock is uneven (longest step 0.020 s)"
    assert [note.partition(":")[0] for note in notes[:-1]] == ["RF", "LR", "RR"]
    np.testing.assert_allclose(found.t, record.t, atol=1e-9)
    np.testing.assert_allclose(found.s, record.s, atol=1e-9)
    np.testing.assert_allclose(found.a[:, kept], record.a[:, kept], atol=1e-9)
    np.testing.assert_array_equal(found.damper_high[kept], switching[kept])


def test_samples_of_an_uneven_clock_are_interpolated_to_an_even_one():
    record, _ = drive(202)
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, record.t.size) / record.fs
    t = record.t + jitter
    hum = np.tile(np.sin(2.0 * np.pi * 2.0 * t), (3, 1))
    found, valid, _ = mask_record(replace(record, t=t, a=hum, s=np.interp(t, record.t, record.s)))
    assert valid.all() and np.ptp(np.diff(found.t)) < 1e-9
    np.testing.assert_allclose(found.a[0], np.sin(2.0 * np.pi * 2.0 * found.t), atol=2e-3)
    hum[1, -20:] = np.nan
    lost = np.isnan(mask_record(replace(record, t=t, a=hum)).record.a)
    assert 18 <= lost[1, -21:].sum() == lost.sum() <= 21


def test_infinite_samples_are_missing():
    record, _ = drive(203)
    a = record.a.copy()
    a[0, 100:120] = np.inf
    found, valid, notes = mask_record(replace(record, a=a), load_instruments("paper"))
    assert np.isnan(found.a[0, 100:120]).all() and np.isfinite(found.a).sum() == a.size - 20
    assert not valid[0, 100:120].any() and len(notes) == 1 and "missing" in notes[0]
    assert not clipped_signs(found, load_instruments("paper")).any()


def test_a_clipped_sensor_is_noted_and_a_smooth_peak_is_not():
    record, _ = drive(203)
    limit = np.quantile(np.abs(record.a[0]), 0.9)
    clipped = replace(record, a=np.clip(record.a, -limit, limit))
    _, notes = clean_record(clipped)
    assert any(note.startswith(f"RF is clipped at {limit:.1f} m/s²") for note in notes)
    hum = np.sin(2.0 * np.pi * 1.0 * record.t)
    assert clean_record(replace(record, a=np.array([hum, hum, hum])))[1] == ()


def test_a_stop_and_a_late_start_are_noted():
    record, _ = drive(204)
    s = np.where(record.s < 5.0, record.s, np.maximum(record.s - 4.0, 5.0))
    _, notes = clean_record(replace(record, s=s))
    assert "the vehicle stood still for 0.5 s; these samples carry no road information" in notes
    late = select_samples(record, record.s > 3.0)
    assert clean_record(late)[1] == (
        "the first 3.04 m lie behind the front axle at the start: at most the rear wheels drove "
        "over them",
    )


REFUSED = {
    "LR is missing in 30% of its samples; at most 20% can be interpolated": lambda r: with_gap(
        r, 0.3
    ),
    "RF is missing in 49% of its samples; at most 20% can be interpolated": lambda r: (
        select_samples(
            r, (np.arange(r.t.size) < 0.5 * r.t.size) | (np.arange(r.t.size) > 0.99 * r.t.size)
        )
    ),
    r"damper_high of the record must have the shape \(\d+, 4\), got \(\d+, 3\)": lambda r: replace(
        r, damper_high=r.damper_high[:, :3]
    ),
    r"a of the record must have the shape \(3, \d+\)": lambda r: replace(r, a=r.a[:2]),
    r"the road must be longer than 0\.05 m, got 0\.0 m": lambda r: replace(r, length=0.0),
}


@pytest.mark.parametrize("sentence", REFUSED)
def test_an_unusable_record_is_refused_with_the_reason(sentence):
    record, _ = drive(205)
    with pytest.raises(RecordError, match=sentence):
        clean_record(REFUSED[sentence](record))


@pytest.mark.parametrize("name", TRAINABLE)
def test_a_short_gap_changes_the_estimate_of_a_trainable_estimator_little(name):
    estimator = fit(name)
    record, _ = drive(206)
    whole = estimator.estimate(record, CAR)
    gap = estimator.estimate(with_gap(record, 0.005), CAR)
    change = np.sqrt(np.mean((gap.z - whole.z) ** 2) / np.mean(whole.z**2))
    assert change < (1.0 if name == "narx" else 0.3)  # fed-back errors persist
