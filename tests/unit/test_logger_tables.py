"""Tables as data loggers and phones write them: names, units, clocks, slow sensors."""

import re

import numpy as np
import pandas as pd
import pytest
from measured import read_measured_record
from vehicle_fixtures import DEFENDER

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables import mdf
from road_envs.drives.logger_tables.description import (
    DriveDescription,
    read_description,
    write_description,
)
from road_envs.records.units import STANDARD_GRAVITY, factor, split_header

BASE = DEFENDER.wheelbase
T = np.arange(6000) / 100.0
ACCELERATION = {
    "a_rf": np.sin(9.0 * T),
    "a_lr": np.cos(7.0 * T) + 0.3 * np.sin(40.0 * T),
    "a_rr": np.sin(5.0 * T),
}
SPEED = 10.0 + 3.0 * np.sin(0.1 * T)
DISTANCE = 10.0 * T + 30.0 * (1.0 - np.cos(0.1 * T))
RIDE = DriveDescription(mode="ride")


def write(path, columns):
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def read(path, **description):
    return read_measured_record(path, BASE, description=RIDE.updated(**description))


def test_columns_are_found_by_own_names_with_units_in_the_headers(tmp_path):
    path = write(
        tmp_path / "d.csv",
        {
            "Time (ms)": 1000.0 * T,
            "acc_front [g]": 1.0 + ACCELERATION["a_rf"] / STANDARD_GRAVITY,
            "acc_left [mg]": 1e3 * ACCELERATION["a_lr"] / STANDARD_GRAVITY,
            "down_right (m/s²)": -ACCELERATION["a_rr"],
            "Speed [km/h]": 3.6 * SPEED,
        },
    )
    names = {"a_rf": "acc_front", "a_lr": "ACC_LEFT [mg]", "a_rr": "down_right"}
    found = read(path, columns=names, invert=("a_rr",)).record
    np.testing.assert_allclose(found.t, T, atol=1e-9)
    expected = np.stack(list(ACCELERATION.values()))
    expected[0] -= expected[0].mean()  # gravity is taken from the mean
    np.testing.assert_allclose(found.a, expected, atol=1e-9)
    np.testing.assert_allclose(found.v, SPEED, atol=1e-9)


def test_a_row_of_units_below_the_header_is_read(tmp_path):
    path = write(tmp_path / "d.csv", {"t": T, **ACCELERATION, "v": 3.6 * SPEED})
    head, _, rest = path.read_text().partition("\n")
    path.write_text(f"{head}\ns,m/s2,m/s^2,m/s²,km/h\n{rest}", encoding="cp1252")
    np.testing.assert_allclose(read(path).record.v, SPEED, atol=1e-9)


@pytest.mark.parametrize(
    "stamps",
    [
        lambda t: 1_790_000_000.5 + t,
        lambda t: np.round(1e3 * (1_790_000_000.5 + t)).astype(np.int64),
        lambda t: 1_790_000_000_500_000_000 + np.round(1e9 * t).astype(np.int64),
        lambda t: [f"{x}Z" for x in np.datetime64("2026-09-21T14:13:20.5", "ms") + np.round(1e3 * t).astype("timedelta64[ms]")],  # noqa: E501
        lambda t: [f"{x}+02:00" for x in np.datetime64("2026-09-21T16:13:20.5", "ms") + np.round(1e3 * t).astype("timedelta64[ms]")],  # noqa: E501
        lambda t: [f"23:59:{x:09.6f}" if x < 60 else f"00:00:{x - 60:09.6f}" for x in t + 5.0],
    ],
    ids=["s", "ms", "ns", "iso", "iso with zone", "time of day"],
)  # fmt: skip
def test_time_stamps_are_read_as_seconds_of_the_drive(tmp_path, stamps):
    path = write(tmp_path / "d.csv", {"timestamp": stamps(T), **ACCELERATION, "v": SPEED})
    record = read(path).record
    np.testing.assert_allclose(record.t, T, atol=2e-6)
    np.testing.assert_allclose(record.a[0], ACCELERATION["a_rf"], atol=2e-5)


def test_a_jittering_clock_loses_no_sample_and_keeps_the_signal(tmp_path):
    """The 100 Hz of a phone: intervals between 2 and 18 ms, sine waves up to 15 Hz."""
    rng = np.random.default_rng(5)
    t = T + 0.004 * rng.uniform(-1.0, 1.0, T.size)
    wave = {
        f"a_{k}": np.sin(2 * np.pi * f * t) for k, f in (("rf", 3.0), ("lr", 8.0), ("rr", 15.0))
    }
    measured = read(write(tmp_path / "d.csv", {"t": t, **wave, "v": 10.0 + 0.0 * t}))
    record = measured.record
    assert np.isfinite(record.a).all() and record.fs == pytest.approx(100.0, rel=1e-3)
    for x, f, limit in zip(record.a, (3.0, 8.0, 15.0), (1e-3, 0.02, 0.15), strict=True):
        error = x - np.sin(2 * np.pi * f * (record.t + t[0]))
        assert np.sqrt(2.0 * np.mean(error**2)) < limit
    assert "uneven" in measured.notes[0] and "0.0% of the samples lost" in measured.notes[0]


def test_a_gap_in_a_jittering_clock_is_lost_and_nothing_else(tmp_path):
    rng = np.random.default_rng(6)
    t = T + 0.004 * rng.uniform(-1.0, 1.0, T.size)
    keep = (T < 20.0) | (T > 21.0)
    columns = {"t": t, **ACCELERATION, "v": SPEED}
    record = read(write(tmp_path / "d.csv", {k: x[keep] for k, x in columns.items()})).record
    lost = record.t[np.isnan(record.a[0])] + t[0]
    assert 20.0 < lost.min() < 20.03 and 20.97 < lost.max() < 21.0 and 94 <= lost.size <= 99


@pytest.mark.parametrize("held", [False, True])
def test_speed_and_odometer_at_one_hertz_are_interpolated(tmp_path, held):
    rows = np.arange(T.size)
    if held:
        slow = {"v": SPEED[rows // 100 * 100], "s": 500.0 + DISTANCE[rows // 100 * 100]}
    else:
        slow = {"v": np.where(rows % 100 == 0, SPEED, np.nan),
                "s": np.where(rows % 100 == 50, 500.0 + DISTANCE, np.nan)}  # fmt: skip
    measured = read(write(tmp_path / "d.csv", {"t": T, **ACCELERATION, **slow}))
    inside = (T > 1.0) & (T < 58.9)
    np.testing.assert_allclose(measured.record.v[inside], SPEED[inside], atol=0.01)
    distance = measured.record.s + measured.chainage
    np.testing.assert_allclose(distance[inside], 500.0 + DISTANCE[inside], atol=0.1)


def test_a_constant_speed_between_changes_is_no_ramp(tmp_path):
    v = np.where(T < 30.0, 10.0, 12.0 + np.floor(T) % 2)
    record = read(write(tmp_path / "d.csv", {"t": T, **ACCELERATION, "v": v})).record
    assert np.abs(record.v[T < 29.0] - 10.0).max() < 1e-9


def test_rows_of_a_slower_sensor_between_those_of_the_accelerations_are_no_samples(tmp_path):
    columns = pd.DataFrame({"t": T, **ACCELERATION})
    fixes = pd.DataFrame({"t": T[::100] + 0.003, "v": np.interp(T[::100] + 0.003, T, SPEED)})
    path = tmp_path / "d.csv"
    pd.concat([columns, fixes]).sort_values("t").to_csv(path, index=False)
    record = read(path).record
    assert record.t.size == T.size and np.isfinite(record.a).all()
    np.testing.assert_allclose(record.v[100:-100], SPEED[100:-100], atol=0.01)


def test_speed_and_distance_follow_from_positions(tmp_path):
    """A straight track to the north-east at 48° N; radii of the sphere."""
    degree = np.pi * 6_371_008.8 / 180.0
    lat = 48.0 + DISTANCE * np.sqrt(0.5) / degree
    lon = 11.0 + DISTANCE * np.sqrt(0.5) / (degree * np.cos(np.radians(48.0)))
    rows = np.arange(T.size) % 100 == 0
    columns = {"lat": np.where(rows, lat, np.nan), "lon": np.where(rows, lon, np.nan)}
    measured = read(write(tmp_path / "d.csv", {"t": T, **ACCELERATION, **columns}))
    inside = (T > 2.0) & (T < 58.0)
    np.testing.assert_allclose(measured.record.v[inside], SPEED[inside], atol=0.05)
    np.testing.assert_allclose(measured.record.s[inside] - BASE, DISTANCE[inside], atol=0.1)
    np.testing.assert_allclose(measured.position[0, inside], lat[inside], atol=1e-6)


@pytest.mark.parametrize("gain", [0.97, 1.03])
def test_a_speed_that_is_a_few_percent_wrong_is_scaled_to_the_track(tmp_path, gain):
    """Positions once a second with independent errors of 1 m on a gentle curve."""
    degree, rng = np.pi * 6_371_008.8 / 180.0, np.random.default_rng(4)
    heading = 0.3 + DISTANCE / 400.0
    step = np.gradient(DISTANCE)
    north, east = np.cumsum(step * np.cos(heading)), np.cumsum(step * np.sin(heading))
    rows = np.arange(T.size) % 100 == 0
    lat, lon = (
        np.where(rows, origin + (x + rng.standard_normal(T.size)) / scale, np.nan)
        for x, origin, scale in (
            (north, 48.0, degree), (east, 11.0, degree * np.cos(np.radians(48.0))),
        )
    )  # fmt: skip
    columns = {"t": T, **ACCELERATION, "v": gain * SPEED, "lat": lat, "lon": lon}
    measured = read(write(tmp_path / "d.csv", columns))
    assert np.median(measured.record.v / SPEED) == pytest.approx(1.0, abs=0.006)
    assert any("scaled by" in note for note in measured.notes)


@pytest.mark.parametrize(("gain", "told"), [(1.1, True), (1.02, False)])
def test_a_speed_that_disagrees_with_the_positions_is_told(tmp_path, gain, told):
    degree = np.pi * 6_371_008.8 / 180.0
    track = {"lat": 48.0 + DISTANCE / degree, "lon": np.full(T.size, 11.0)}
    columns = {"t": T, **ACCELERATION, "v": gain * SPEED, **track}
    measured = read(write(tmp_path / "d.csv", columns))
    notes = [note for note in measured.notes if "distances are those of the speed" in note]
    assert len(notes) == told
    if told:
        driven, track = (float(x) for x in re.findall(r"(\d+) m by", notes[0]))
        assert driven / track == pytest.approx(gain, abs=0.01)


def test_a_length_at_the_end_of_a_header_is_a_unit_of_distances_alone(tmp_path):
    columns = {"time": T, "t_in": 20.0 + T, **ACCELERATION, "v": SPEED}
    columns["odometer_km"] = 1e-3 * DISTANCE + 7.0
    found = read(write(tmp_path / "d.csv", columns)).record
    np.testing.assert_allclose(found.t, T, atol=1e-9)
    np.testing.assert_allclose(found.s - found.s[0], DISTANCE, atol=1e-6)


def test_fifty_hertz_are_interpolated_and_noted(tmp_path):
    every = slice(None, None, 2)
    columns = {"t": T, **ACCELERATION, "v": SPEED}
    measured = read(write(tmp_path / "d.csv", {k: x[every] for k, x in columns.items()}))
    assert measured.fs == pytest.approx(50.0) and measured.record.fs == pytest.approx(100.0)
    expected = np.stack(list(ACCELERATION.values()))[:, :-1]
    np.testing.assert_allclose(measured.record.a, expected, atol=0.01)
    assert "nothing above 20 Hz is measured" in measured.notes[-1]


def test_chainage_is_kept_or_given(tmp_path):
    columns = {"t": T, **ACCELERATION, "v": SPEED, "chainage (km)": 1e-3 * (12_000.0 + DISTANCE)}
    path = write(tmp_path / "d.csv", columns)
    assert read(path).chainage == pytest.approx(12_000.0 - BASE)
    assert read(path, offset=400.0).chainage == pytest.approx(400.0 - BASE)


def test_a_description_is_written_and_read(tmp_path):
    given = DriveDescription(
        columns={"a_rf": "front"}, units={"a_rf": "g"}, invert=("a_rf",),
        mode={"front": "ride", "rear": "handling"}, offset=120.0, vehicle="car.yaml",
    )  # fmt: skip
    write_description(tmp_path / "d.yaml", given)
    assert read_description(tmp_path / "d.yaml") == given


@pytest.mark.parametrize("changes", [{"vehicle": "van"}, {"at": "trunk"}, {"sensors": "paper"}])
def test_the_factor_of_another_car_or_place_is_not_kept(changes):
    known = {"vehicle": "bmw_320i", "at": "dashboard", "sensors": "phone"}
    given = DriveDescription(**known, iri_factor=0.55, iri_factor_std=0.05)
    assert given.updated(**known, offset=3.0).iri_factor == 0.55
    other = given.updated(**changes)
    assert other.iri_factor is None and other.iri_factor_std is None
    assert given.updated(**changes, iri_factor=0.6).iri_factor == 0.6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"columns": {"a_fr": "x"}}, "unknown quantity in columns 'a_fr' (did you mean "),
        ({"units": {"a_rf": "furlong"}}, "acceleration unit 'furlong' is unknown; known: m/s2, g"),
        ({"units": {"mode": "g"}}, "mode has no unit"),
        ({"invert": ("v",)}, "unknown acceleration in invert 'v'"),
    ],
)
def test_an_invalid_description_is_rejected(changes, message):
    with pytest.raises(ConfigError) as error:
        RIDE.updated(**changes)
    assert message in str(error.value)


def test_a_missing_column_is_named_with_the_nearest(tmp_path):
    path = write(tmp_path / "d.csv", {"t": T, **ACCELERATION, "acc_front": T, "v": SPEED})
    with pytest.raises(ConfigError, match="no column 'acc_fron' for a_rf") as error:
        read(path, columns={"a_rf": "acc_fron"})
    assert "the column a_rf is missing" not in str(error.value)


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("a_rf [g]", "a_rf", "g"), ("speed (km/h)", "speed", "km/h"), ("v_kmh", "v", "kmh"),
        ("a_rf", "a_rf", None), ("g", "g", None), ("x_long", "x_long", None),
        ("GPS speed mph", "GPS speed", "mph"),
    ],
)  # fmt: skip
def test_a_header_is_split_into_name_and_unit(header, name, unit):
    assert split_header(header) == (name, unit)


@pytest.mark.parametrize("unit", ["m/s²", "m/s^2", "ms-2", "M/S2", "m·s−2"])
def test_spellings_of_a_unit_are_one_unit(unit):
    assert factor("acceleration", unit) == 1.0


@pytest.mark.costly
def test_an_mdf_file_with_channels_of_two_rates_is_read(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path / "d.mf4"
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(x, T, name=k, unit="m/s²") for k, x in ACCELERATION.items()])
        slow = slice(None, None, 100)
        file.append(asammdf.Signal(3.6 * SPEED[slow], T[slow], name="speed", unit="km/h"))
        file.save(path)
    record = read(path).record
    np.testing.assert_allclose(record.a, list(ACCELERATION.values()), atol=1e-9)
    np.testing.assert_allclose(record.v[:5900], SPEED[:5900], atol=0.01)


def write_mdf(path, *channels):
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        for name, x, t in channels:
            file.append(asammdf.Signal(x, t, name=name, unit="m/s²"))
        file.save(path)
    return path.read_bytes()


@pytest.mark.costly
def test_two_samples_of_a_channel_at_one_time_are_refused_by_its_name(tmp_path):
    path, twice = tmp_path / "d.mf4", np.repeat(T[::2], 2)
    write_mdf(path, ("a_lf", SPEED, T), ("a_rf", SPEED[: twice.size], twice))
    with pytest.raises(ConfigError, match=r"'a_rf \[m/s²\]' have one time"):
        read(path)


def test_what_a_parser_says_of_a_damaged_mdf_file_is_cut_to_one_line(tmp_path, monkeypatch):
    def refuse(path):
        raise ValueError("samples=array([36.  ,\n 36.01]) " + "x" * 9000)

    monkeypatch.setattr(mdf, "read_channels", refuse)
    mdf._main("d.mf4", tmp_path / "channels", tmp_path / "failure")
    said = (tmp_path / "failure").read_text()
    assert said.startswith("samples=array([36. , 36.01]) x") and len(said) < 600


@pytest.mark.parametrize(
    "program, said",
    [
        ("os.kill(os.getpid(), 11)", "its parser failed (-11)"),
        ("open(sys.argv[3], 'w').write('no block')", "no block"),
        ("time.sleep(8)", "no MDF file that is read within 2 s"),
    ],
)
def test_a_parser_that_is_killed_or_stays_busy_ends_in_a_sentence(
    tmp_path, monkeypatch, program, said
):
    pytest.importorskip("asammdf")
    (tmp_path / "parser_of_mdf.py").write_text(f"import os, sys, time\n{program}\n")
    monkeypatch.setattr(mdf, "__name__", "parser_of_mdf")
    monkeypatch.setattr(mdf, "MAX_SECONDS", 2.0)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=re.escape(said)):
        mdf.read_mdf(tmp_path / "d.mf4")


@pytest.mark.costly
def test_a_damaged_mdf_file_is_refused_in_one_sentence_without_a_word_beside_it(tmp_path, capfd):
    path = tmp_path / "d.mf4"
    whole = write_mdf(path, ("speed", SPEED, T))
    changed = whole[:64] + b"\xff" * 100 + whole[164:], whole.replace(b"##FH", b"@@FH")
    for content in (b"not a measurement", whole[:300], *changed):
        path.write_bytes(content)
        with pytest.raises(ConfigError) as refused:
            read(path)
        said = str(refused.value)
        assert said.startswith(f"{path}: no readable MDF file"), said
        assert said.count(str(path)) == 1 and "mmap" not in said and "\n" not in said
    assert capfd.readouterr() == ("", "")
