"""Records are reproducible, written atomically, and read back to the bit or rejected."""

import json
from dataclasses import fields, replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from vehicle_fixtures import DEFENDER, smooth_road

from road_envs.core.config import ConfigError
from road_envs.drives import recording
from road_envs.drives.recording import (
    read_record,
    simulate_record,
    true_profile,
    write_record,
)
from road_envs.records.record import PROFILE_SPACING, Record, profile_stations
from road_envs.sensing.data_logger import load_instruments
from road_envs.simulation.drive import APRON_LENGTH

ROAD = smooth_road(length=20.0, height=0.01)
PAPER = load_instruments("paper")
MIXED = {"FL": "ride", "FR": "handling", "RL": "soft_high", "RR": "stiff_low"}


def drive(seed=0, speed_kmh=54.0, mode="ride", **changes):
    options = {"step": changes.pop("step")} if "step" in changes else {}
    return simulate_record(
        ROAD, vehicle=DEFENDER, speed_kmh=speed_kmh, mode=mode,
        instruments=replace(PAPER, **changes), seed=seed, **options,
    )  # fmt: skip


def same(one: Record, other: Record) -> bool:
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(Record)]
    return all(
        np.array_equal(a, b) and np.asarray(a).dtype == np.asarray(b).dtype for a, b in pairs
    )


# --- simulation -----------------------------------------------------------------------------------


def test_a_seed_determines_the_record_and_only_the_noise_varies():
    (once, road), (again, _), (other, same_road) = drive(7), drive(7), drive(8)
    assert same(once, again) and not same(once, other)
    np.testing.assert_array_equal(road.z, same_road.z)
    quiet, _ = drive(noise_density=0.0)
    for record in (once, other):
        noise = record.a - quiet.a
        expected = PAPER.noise_density * np.sqrt(500.0 * 0.7)  # after a filter at 333 of 500 Hz
        np.testing.assert_allclose(noise.std(axis=1), expected, rtol=0.15)


def test_a_record_describes_the_drive():
    record, _ = drive(mode=MIXED)
    speed = 54.0 / 3.6
    assert record.fs == pytest.approx(1000.0)
    np.testing.assert_allclose(np.diff(record.t), 0.001, rtol=1e-9)
    assert record.t[0] == 0.0 and record.s[0] == -APRON_LENGTH
    assert record.t[-1] == pytest.approx(
        (20.0 + DEFENDER.wheelbase + 2 * APRON_LENGTH) / speed, abs=2e-3
    )
    assert (record.v == speed).all() and record.length == 20.0
    np.testing.assert_allclose(record.s, -APRON_LENGTH + speed * record.t, atol=1e-9)
    assert (record.spring_stiff == [False, True, False, True]).all()
    assert (record.damper_high == [False, True, True, False]).all()


@pytest.mark.parametrize("speed_kmh", [0.0, -5.0, float("nan"), 200.5])
def test_a_speed_that_no_vehicle_drives_is_refused(speed_kmh):
    with pytest.raises(ConfigError, match=f"at most 200 km/h, got {speed_kmh:g} km/h"):
        drive(speed_kmh=speed_kmh)


def test_the_odometer_integrates_the_measured_speed():
    record, _ = drive(speed_error=0.02)
    assert record.v[0] != 15.0 and (record.v == record.v[0]).all()
    np.testing.assert_allclose(np.diff(record.s), record.v[:-1] / 1000.0, rtol=1e-9)
    assert record.s[-1] + APRON_LENGTH == pytest.approx(record.v[0] * record.t[-1])


@pytest.mark.parametrize("chunk", [17, 1000])
def test_recording_in_chunks_equals_recording_at_once(chunk, monkeypatch):
    whole, _ = drive(step=0.0005)
    monkeypatch.setattr(recording, "CHUNK", chunk)
    assert same(drive(step=0.0005)[0], whole)


def test_a_finer_integrator_step_changes_the_record_little():
    coarse, fine = drive(noise_density=0.0)[0], drive(noise_density=0.0, step=0.0005)[0]
    assert coarse.t.size == pytest.approx(fine.t.size, abs=1)
    n = min(coarse.t.size, fine.t.size)
    error = np.std(coarse.a[:, :n] - fine.a[:, :n], axis=1)
    assert (error < 0.1 * fine.a.std(axis=1)).all()  # the finer filter has slightly less delay


def test_the_true_profile_is_the_road_on_the_papers_stations():
    _, road = drive()
    assert (
        PROFILE_SPACING == pytest.approx(0.0252, abs=5e-5) and profile_stations(100.0).size == 3964
    )
    np.testing.assert_allclose(road.s, 100.0 / 3964 * np.arange(road.s.size), rtol=1e-12)
    np.testing.assert_array_equal(road.z, ROAD.height(road.s))
    assert 20.0 - 2.0 * PROFILE_SPACING < road.s[-1] < 20.0 and road.ds == pytest.approx(
        PROFILE_SPACING
    )
    np.testing.assert_array_equal(true_profile(ROAD).z, road.z)


def test_signals_are_interpolated_at_stations():
    record, _ = drive()
    stations = np.array([0.0, 5.004, 12.3])
    actual = record.interpolate(stations, np.stack([record.s, record.t]))
    np.testing.assert_allclose(actual[0], stations, atol=1e-9)
    np.testing.assert_allclose(actual[1], (stations + APRON_LENGTH) / 15.0, atol=1e-9)


# --- writing and reading --------------------------------------------------------------------------


@pytest.fixture
def written(tmp_path):
    record, _ = drive(mode=MIXED, speed_error=0.02)
    path = tmp_path / "drive.parquet"
    write_record(path, record, {"road": "smooth", "seed": 0})
    return path, record


def test_parquet_round_trips_a_record_and_its_provenance_to_the_bit(written):
    path, record = written
    actual, provenance = read_record(path)
    assert same(actual, record)
    assert provenance == {"road": "smooth", "seed": 0}
    assert actual.length == record.length


def test_a_failed_write_keeps_the_old_file_and_leaves_no_other(written, monkeypatch):
    path, record = written
    assert [f.name for f in path.parent.iterdir()] == ["drive.parquet"]
    before = path.read_bytes()

    def full_disk(table, where):
        where.write_bytes(b"half a fi")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", full_disk)
    with pytest.raises(OSError, match="No space"):
        write_record(path, record, {})
    assert [f.name for f in path.parent.iterdir()] == ["drive.parquet"]
    assert path.read_bytes() == before


def rewrite(path, change):
    """Rewrite the file at `path` with its table changed."""
    table = change(pq.read_table(path))
    pq.write_table(table, path)


def about(table, text):
    return table.replace_schema_metadata({"roadrecon": text})


DAMAGE = {
    "cut short": (lambda p: p.write_bytes(p.read_bytes()[:-100]), "damaged, or no Parquet file"),
    "not Parquet": (lambda p: p.write_text("t,a_rf\n0,1\n"), "damaged, or no Parquet file"),
    "empty": (lambda p: p.write_bytes(b""), "damaged, or no Parquet file"),
    "gone": (lambda p: p.unlink(), "cannot be read: "),
    "a foreign table": (
        lambda p: pq.write_table(pa.table({"x": [1.0]}), p), "not a RoadRecon record"
    ),
    "another version": (
        lambda p: rewrite(p, lambda t: about(t, json.dumps({"format": "roadrecon record 9"}))),
        "not a RoadRecon record",
    ),
    "broken metadata": (
        lambda p: rewrite(p, lambda t: about(t, "{oops")), "not a RoadRecon record"
    ),
    "strange metadata": (lambda p: rewrite(p, lambda t: about(t, "[1]")), "not a RoadRecon record"),
    "a column missing": (
        lambda p: rewrite(p, lambda t: t.drop_columns(["v"])), r"columns \['v'\] are missing"
    ),
    "a column of text": (
        lambda p: rewrite(
            p, lambda t: t.set_column(4, "v", pa.array(["fast"] * t.num_rows))
        ),
        r"columns \['v'\] must hold numbers",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("harm", "reason"), DAMAGE.values(), ids=DAMAGE.keys())
def test_a_damaged_or_foreign_file_is_rejected_in_one_sentence(written, harm, reason):
    path, _ = written
    harm(path)
    with pytest.raises(ConfigError, match=reason) as caught:
        read_record(path)
    sentence = str(caught.value)
    assert sentence.startswith(str(path)) and "\n" not in sentence
    assert caught.value.__cause__ is None and (
        caught.value.__context__ is None or caught.value.__suppress_context__
    )


def test_columns_have_their_documented_order(written):
    assert tuple(pq.read_table(written[0]).column_names) == (
        "t", "a_rf", "a_lr", "a_rr", "v", "s", "commands",
    )  # fmt: skip
