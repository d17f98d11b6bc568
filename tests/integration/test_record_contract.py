"""One contract of records: every estimator takes or refuses the same records by the same rules."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_estimator_contract import CAR, SMALL

from estimators import REGISTRY, create
from estimators.api import Estimator, Pretrained, Trainable, check_estimate
from estimators.preprocessing import RecordError, mask_record
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Profile, Record
from road_envs.roads import load_road

QUICK = {
    **{name: SMALL[name] for name in ("static_lm", "narx", "iterated_wiener")},
    "map_smoother": {"data_rate": 100.0, "step": 0.002, "draws": 0, "adapt": False},
}
"""Settings that make the tests fast; pretrained estimators keep their shipped weights."""

THOROUGH = {"map_smoother": {**QUICK["map_smoother"], "adapt": True}}
"""Settings of the slow tests, where they differ."""

INTERPOLATING = {
    "static_lm", "narx", "inverse_quarter_car", "fir_ridge", "calibrated_fir", "tcn", "tcn_causal",
    "gru", "gru_causal",
}  # fmt: skip
"""Estimators that need every sample and therefore limit the share of missing ones."""


@cache
def drive(length: float = 12.0) -> tuple[Record, Profile]:
    """A record of the paper's instruments at 36 km/h and its truth."""
    road = load_road({"kind": "iso8608", "road_class": "D", "length": length})
    return simulate_record(
        road.realise(np.random.default_rng(1)), speed_kmh=36.0, mode="handling", seed=1
    )


@cache
def ready(name: str, thorough: bool = False) -> Estimator:
    """An estimator with weights."""
    settings = THOROUGH if thorough and name in THOROUGH else QUICK
    estimator = create(name, **settings.get(name, {}))
    if isinstance(estimator, Trainable) and not isinstance(estimator, Pretrained):
        record, truth = drive(60.0) if name == "calibrated_fir" else drive()
        return estimator.fit([record], [truth], CAR, 0)
    return estimator


def select(record: Record, kept) -> Record:
    """The record reduced to the samples `kept`."""
    fields = {
        name: getattr(record, name)[kept] for name in ("t", "v", "s", "spring_stiff", "damper_high")
    }
    return replace(record, a=record.a[:, kept], **fields)


def lose(record: Record, share: float) -> Record:
    """The record without a share of its samples, in bursts of ten."""
    lost = np.repeat(np.random.default_rng(2).random(record.t.size // 10 + 1) < share, 10)
    return replace(record, a=np.where(lost[: record.t.size], np.nan, record.a))


def stop(record: Record) -> Record:
    """The record with a standstill of 0.5 s."""
    first = record.t.size // 2
    held = np.minimum(np.arange(record.t.size), first)
    later = np.arange(record.t.size) > first + round(0.5 * record.fs)
    samples = np.where(later, np.arange(record.t.size) - round(0.5 * record.fs), held)
    v = np.where(samples == first, 0.0, record.v)
    return replace(record, s=record.s[samples], a=record.a[:, samples], v=v)


def drop(record: Record) -> Record:
    """The record without a tenth of its rows, on a clock with jitter."""
    rng = np.random.default_rng(3)
    kept = rng.random(record.t.size) > 0.1
    kept[[0, -1]] = True
    jitter = rng.uniform(-0.2, 0.2, record.t.size) / record.fs
    return select(replace(record, t=record.t + jitter), kept)


def with_gaps(x: np.ndarray) -> np.ndarray:
    """The signal without 50 samples."""
    return np.where(np.abs(np.arange(x.size) - x.size // 2) < 25, np.nan, x)


Damages = dict[str, tuple[Callable[[Record], Record], tuple[str, ...]]]

NOTED: Damages = {
    "lost 5 % and clipped": (
        lambda r: lose(replace(r, a=np.clip(r.a, -1.5, 1.5)), 0.05),
        ("RR: 5.2% of the samples are missing", "RF is clipped at 1.5 m/s²"),
    ),
    "lost speed and odometer": (
        lambda r: replace(r, v=with_gaps(r.v), s=with_gaps(r.s)),
        ("v: 2.0% of the samples are missing", "s: 2.0% of the samples are missing"),
    ),
    "standstill": (stop, ("the vehicle stood still for 0.5 s",)),
    "late start on an uneven clock": (
        lambda r: drop(select(r, r.s > 2.0)),
        ("the clock is uneven (longest step", "lie behind the front axle at the start"),
    ),
}
"""Damaged records that every estimator takes, and a part of each note."""

NOTED_ALONE: Damages = {
    "lost 5 %": (lambda r: lose(r, 0.05), ("RR: 5.2% of the samples are missing",)),
    "clipped": (lambda r: replace(r, a=np.clip(r.a, -1.5, 1.5)), ("RF is clipped at 1.5 m/s²",)),
    "lost speed": (lambda r: replace(r, v=with_gaps(r.v)), ("v: 2.0% of the samples are missing",)),
    "lost odometer": (
        lambda r: replace(r, s=with_gaps(r.s)),
        ("s: 2.0% of the samples are missing",),
    ),
    "uneven clock": (drop, ("the clock is uneven (longest step",)),
    "late start": (lambda r: select(r, r.s > 2.0), ("lie behind the front axle at the start",)),
}
"""Records with one damage each."""

REFUSED: dict[str, tuple[Callable[[Record], Record], str]] = {
    "clock runs backward": (
        lambda r: replace(r, t=np.where(r.t == r.t[70], r.t[60], r.t)),
        "the times t must be finite and increase; they do not after sample 69",
    ),
    "50 Hz": (
        lambda r: select(r, slice(None, None, 20)),
        "the record is sampled at 50 Hz; at least 60 Hz are needed for a bandwidth of 25 Hz",
    ),
    "parked": (
        lambda r: replace(r, s=0.0 * r.s, v=0.0 * r.v),
        "the vehicle moved by 0.00 m; at least 1 m are needed",
    ),
    "dead speed": (
        lambda r: replace(r, v=0.0 * r.v),
        "the vehicle stands: its mean speed is 0 m/s; at least 0.1 m/s are needed",
    ),
    "reversed odometer": (
        lambda r: replace(r, s=r.s[::-1]),
        "the odometer decreases by 2",
    ),
    "jumping odometer": (
        lambda r: replace(r, s=r.s + 5.0 * (r.s > 3.0)),
        "the odometer jumps by 5.01 m from one sample to the next",
    ),
    "reversed speed": (lambda r: replace(r, v=-r.v), "the speed falls to -"),
    "NaN speed": (
        lambda r: replace(r, v=np.nan * r.v),
        "v is missing in 100% of its samples; at most 20% can be interpolated",
    ),
    "NaN accelerations": (
        lambda r: replace(r, a=np.nan * r.a),
        "the record has no finite acceleration: check the sensors' channels",
    ),
    "empty": (
        lambda r: select(r, slice(0)),
        "the record lasts 0.00 s; at least 1 s are needed",
    ),
    "1 m": (
        lambda r: select(r, (r.s > 3.0) & (r.s < 4.0)),
        "the record lasts 0.10 s; at least 1 s are needed",
    ),
    "strut states": (
        lambda r: replace(r, spring_stiff=np.full((r.t.size, 4), 3)),
        "the strut states 'spring_stiff' must be true or false throughout",
    ),
}
"""Records that every estimator refuses, and the beginning of the sentence."""

INCOMPLETE: dict[str, tuple[Callable[[Record], Record], str]] = {
    "lost 40 %": (lambda r: lose(r, 0.4), "is missing in 40% of its samples"),
    "dead channel": (
        lambda r: replace(r, a=np.where(np.arange(3)[:, None] == 2, np.nan, r.a)),
        "RR is missing in 100% of its samples; at most 20% can be interpolated",
    ),
}
"""Records that only estimators take which can leave samples out."""


@pytest.mark.costly
@pytest.mark.parametrize(
    "thorough", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["quick", "thorough"]
)
@pytest.mark.parametrize("name", REGISTRY)
def test_every_estimator_takes_the_same_damaged_records_with_the_same_note(name, thorough):
    record, _ = drive()
    for what, (damage, expected) in (NOTED | NOTED_ALONE if thorough else NOTED).items():
        notes = mask_record(damage(record)).notes
        assert all(any(note in one for one in notes) for note in expected), (what, notes)
        estimate = ready(name, thorough).estimate(damage(record), CAR)
        check_estimate(estimate, record)
        assert estimate.notes[: len(notes)] == notes, (what, estimate.notes)


@pytest.mark.parametrize("name", REGISTRY)
@pytest.mark.costly
def test_every_estimator_refuses_the_same_records_with_the_same_sentence(name):
    record, _ = drive()
    for what, (damage, sentence) in REFUSED.items():
        with pytest.raises(RecordError) as error:
            ready(name).estimate(damage(record), CAR)
        assert str(error.value).startswith(sentence), (what, str(error.value))


@pytest.mark.parametrize("name", REGISTRY)
@pytest.mark.costly
def test_a_record_with_many_missing_samples_is_refused_only_where_they_are_interpolated(name):
    record, _ = drive()
    for what, (damage, sentence) in INCOMPLETE.items():
        if name in INTERPOLATING:
            with pytest.raises(RecordError) as error:
                ready(name).estimate(damage(record), CAR)
            assert sentence in str(error.value), (what, str(error.value))
            continue
        estimate = ready(name).estimate(damage(record), CAR)
        check_estimate(estimate, record)
        assert any("RR: " in said and "missing" in said for said in estimate.notes), what


@pytest.mark.parametrize("name", REGISTRY)
@pytest.mark.costly
def test_a_road_of_one_metre_is_estimated_by_every_estimator(name):
    record = replace(drive()[0], length=1.0)
    check_estimate(ready(name).estimate(record, CAR), record)
