"""Tables of other data loggers are read as records or rejected in one sentence."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from measured import read_measured_record
from vehicle_fixtures import DEFENDER

import estimators
from leaderboard.metrics.heights import band_pass
from road_envs.core.config import ConfigError
from road_envs.drives.recording import is_record, simulate_record, write_record
from road_envs.records.record import scored_band
from road_envs.records.units import STANDARD_GRAVITY
from road_envs.roads import load_road
from road_envs.sensing.data_logger import load_instruments

BASE = DEFENDER.wheelbase
T = np.arange(200) / 100.0
CHANNELS = {
    "t": T,
    "a_rf": np.sin(9.0 * T),
    "a_lr": np.cos(7.0 * T),
    "a_rr": np.sin(5.0 * T),
    "v": 5.0 + T,
    "mode": ["ride"] * T.size,
}


def table(path, columns, mark=",", point="."):
    def cell(x):
        text = x if isinstance(x, str) else "" if np.isnan(x) else f"{x:.12g}"
        return text.replace(".", point)

    rows = [mark.join(columns), *(mark.join(map(cell, row)) for row in zip(*columns.values()))]  # noqa: B905
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def changed(**changes):
    """Return CHANNELS with columns changed, added, or omitted where None is given."""
    columns = {**CHANNELS, **changes}
    return {name: x for name, x in columns.items() if x is not None}


@pytest.mark.parametrize(
    ("mark", "point"), [(",", "."), (";", ","), (";", "."), ("\t", ","), ("\t", ".")]
)
def test_a_table_is_read_with_any_delimiter_and_decimal_mark(tmp_path, mark, point):
    path = table(tmp_path / "d.csv", CHANNELS, mark, point)
    path.write_text("# a logger\n# of 2014\n" + path.read_text(), encoding="utf-8")
    measured = read_measured_record(path, BASE)
    record, notes = measured.record, measured.notes
    np.testing.assert_allclose(record.t, T, atol=1e-12)
    wanted = [CHANNELS[name] for name in ("a_rf", "a_lr", "a_rr")]
    np.testing.assert_allclose(record.a, wanted, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(record.v, CHANNELS["v"], rtol=1e-11)
    np.testing.assert_allclose(record.s, BASE + 5.0 * T + 0.5 * T**2, atol=1e-9)
    assert record.length == record.s[-1] and notes == ()
    assert not record.spring_stiff.any() and not record.damper_high.any()


def test_units_follow_from_column_names_and_gravity_from_the_mean(tmp_path):
    columns = changed(
        a_rf=None,
        v=None,
        a_rf_g=1.0 + CHANNELS["a_rf"] / STANDARD_GRAVITY,
        V_kmh=3.6 * CHANNELS["v"],
    )
    measured = read_measured_record(table(tmp_path / "d.csv", columns), BASE)
    record, notes = measured.record, measured.notes
    np.testing.assert_allclose(record.a[0], CHANNELS["a_rf"] - CHANNELS["a_rf"].mean(), atol=1e-9)
    np.testing.assert_allclose(record.v, CHANNELS["v"], rtol=1e-10)
    assert (
        len(notes) == 1 and notes[0].startswith("a_rf_g: its mean of 9.") and "gravity" in notes[0]
    )


def test_a_given_odometer_is_used(tmp_path):
    columns = changed(s=1000.0 + 6.0 * T)
    record = read_measured_record(table(tmp_path / "d.csv", columns), BASE).record
    np.testing.assert_allclose(record.s, BASE + 6.0 * T, atol=1e-9)


def test_strut_states_are_given_per_row_or_once(tmp_path):
    switched = ["ride"] * 120 + ["handling"] * 80
    columns = changed(mode=None, mode_front=switched, mode_rear=["soft_high"] * T.size)
    record = read_measured_record(table(tmp_path / "a.csv", columns), BASE).record
    late = T >= 1.195
    np.testing.assert_array_equal(record.spring_stiff, np.outer(late, [1, 1, 0, 0]).astype(bool))
    np.testing.assert_array_equal(record.damper_high[:, 2:], np.ones((200, 2), dtype=bool))
    np.testing.assert_array_equal(record.damper_high[:, 0], late)
    plain = table(tmp_path / "b.csv", changed(mode=None, v=None))
    mixed = {"front": "ride", "rear": "handling"}
    record = read_measured_record(plain, BASE, speed_kmh=36.0, mode=mixed).record
    assert (record.spring_stiff == [False, False, True, True]).all() and (record.v == 10.0).all()


def test_foreign_parquet_is_read_by_column_names(tmp_path):
    path = tmp_path / "d.parquet"
    pq.write_table(pa.table({name.upper(): x for name, x in CHANNELS.items()}), path)
    assert not is_record(path)
    record = read_measured_record(path, BASE).record
    np.testing.assert_array_equal(record.a[1], CHANNELS["a_lr"])
    write_record(path, record, {})
    assert is_record(path)


def test_empty_cells_and_missing_rows_become_lost_samples(tmp_path):
    a = CHANNELS["a_rf"].copy()
    a[50:53] = np.nan
    columns = changed(a_rf=a)
    kept = np.r_[0:100, 105:200]
    columns = {name: [x[k] for k in kept] for name, x in columns.items()}
    measured = read_measured_record(table(tmp_path / "d.csv", columns), BASE)
    record, notes = measured.record, measured.notes
    assert record.t.size == 200 and record.fs == pytest.approx(100.0)
    lost = np.isnan(record.a)
    assert set(np.flatnonzero(lost[0])) == {50, 51, 52, 100, 101, 102, 103, 104}
    assert set(np.flatnonzero(lost[1])) == {100, 101, 102, 103, 104}
    assert len(notes) == 1 and "4.0% of the samples lost" in notes[0]


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_a_jittering_clock_is_kept_and_one_that_bunches_samples_is_resampled(
    tmp_path_factory, seed
):
    t = T + 0.002 * np.random.default_rng(seed).uniform(-1.0, 1.0, T.size)
    columns = changed(t=t, a_rf=0.5 * (t - 1.0), v=5.0 + t)
    measured = read_measured_record(table(tmp_path_factory.mktemp("d") / "d.csv", columns), BASE)
    np.testing.assert_allclose(measured.record.t, t - t[0], atol=2e-6)
    np.testing.assert_allclose(measured.record.a[0], columns["a_rf"], atol=2e-5)
    t[50] = t[49] + 0.001
    columns = changed(t=t, a_rf=0.5 * (t - 1.0), v=5.0 + t)
    measured = read_measured_record(table(tmp_path_factory.mktemp("d") / "d.csv", columns), BASE)
    record, notes = measured.record, measured.notes
    steps = np.diff(record.t)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    np.testing.assert_allclose(record.a[0], 0.5 * (record.t + t[0] - 1.0), atol=1e-6)
    assert not np.isnan(record.a).any() and "uneven" in notes[0]


def test_the_estimated_road_of_a_measured_record_is_the_driven_road(tmp_path):
    """The middle of a simulated drive, written in the format of another logger."""
    surface = load_road("iso_d").realise(np.random.default_rng(3))
    record, truth = simulate_record(
        surface, vehicle=DEFENDER, speed_kmh=54.0, mode="handling",
        instruments=load_instruments("paper"), seed=3,
    )  # fmt: skip
    cut = slice(1200, 6200)
    columns = {
        "time": record.t[cut],
        "t": record.t[cut],
        **{
            f"a_{k}_g": 1.0 + a[cut] / STANDARD_GRAVITY
            for k, a in zip(("rf", "lr", "rr"), record.a, strict=True)
        },
    }
    path = table(tmp_path / "d.csv", columns)
    measured = read_measured_record(path, BASE, speed_kmh=54.0, mode="handling").record
    estimate = estimators.create("iterated_wiener").estimate(measured, DEFENDER)
    begin = record.s[1200] - BASE  # position of the rear axle
    expected = np.stack([np.interp(begin + estimate.s, truth.s, z) for z in truth.z])
    inside = [band_pass(z, estimate.ds, scored_band(15.0)) for z in (expected, estimate.z)]
    assert np.std(inside[1] - inside[0]) < 0.25 * np.std(inside[0])


def spoilt(column, k, value):
    cells = [x if isinstance(x, str) else f"{x:.6g}" for x in CHANNELS[column]]
    cells[k] = value
    return {column: cells}


@pytest.mark.parametrize(
    ("columns", "options", "message"),
    [
        ({"t": None}, {}, "the column t is missing: name it t, time or timestamp"),
        ({"a_lr": None}, {}, "the column a_lr is missing: name it a_lr (m/s²) or a_lr_g"),
        ({"a_lr_g": T}, {}, "a_lr is given twice, by the columns a_lr and a_lr_g"),
        ({"v": None}, {}, "the speed is missing: give one of the columns v [m/s]"),
        ({}, {"speed_kmh": 50.0}, "the speed is given twice, by the column v"),
        ({"mode": None}, {}, "the state of the struts is missing: give the column mode"),
        ({}, {"mode": "handling"}, "the table has other ones in mode: leave out --mode"),
        ({"mode": None, "mode_rear": CHANNELS["mode"]}, {}, "given as mode_rear"),
        (spoilt("mode", 7, "sport"), {}, "unknown suspension mode 'sport'"),
        (spoilt("a_rr", 4, "over"), {}, "the column a_rr: row 5: 'over' is not a number"),
        (spoilt("a_rr", 4, "1_0"), {}, "the column a_rr: row 5: '1_0' is not a number"),
        (spoilt("t", 9, ""), {}, "t must hold a time in every row; row 10 is empty"),
        (spoilt("t", 9, "noon"), {}, "the column t: row 10: 'noon' is not a number"),
        ({"t": T[::-1]}, {}, "t must increase; it does not after row 1"),
        ({"t": 1000.0 * T}, {}, "at 0.1 Hz; at least 20 Hz are needed; are the times in ms"),
        ({"t": T + 1e7 * (T > 1.0)}, {}, "the longest gap is 1e+07 s after row 101"),
        ({"v": T - 0.5}, {}, "the vehicle moves backwards"),
        ({"v": 30.0 * CHANNELS["v"]}, {}, "is it in km/h (--units v=km/h)?"),
        ({"s": 36.0 * T}, {}, "11.93 m by the speed and 71.64 m by the odometer"),
        ({"a_rf": np.full(200, np.nan)}, {}, "the column a_rf holds no number"),
        ({"a_rf": np.where(T < 1.0, np.nan, T - 1.5)}, {}, "50% of the samples are lost"),
        ({"a_rf": -9.8 + 0.1 * T}, {}, "invert its sign with --invert a_rf"),
        ({"a_rf": 8.04 + CHANNELS["a_rf"]}, {}, "an axis 35 degrees from the vertical"),
        ({"a_rf": -0.6 + 0.1 * np.sin(63.0 * T)}, {}, "Give all three axes (x, y, z)"),
        ({"a_rf": 0.0 * T}, {}, "a_rf is 0 in all rows: the sensor is dead"),
        ({"a_rf": 1.0 + 0.1 * np.sin(9.0 * T)}, {}, "as of gravity in g: say --units a_rf=g"),
        ({"a_rf": 0.01 * np.sin(9.0 * T)}, {}, "less than any driven car"),
        ({"lat": 91.0 + 0.0 * T, "lon": T}, {}, "no latitudes within ±90°"),
        ({" V ": T}, {}, "the column v is duplicated"),
    ],
)  # fmt: skip
def test_an_invalid_record_is_rejected_in_one_sentence(tmp_path, columns, options, message):
    path = table(tmp_path / "d.csv", changed(**columns))
    with pytest.raises(ConfigError) as error:
        read_measured_record(path, BASE, **options)
    sentence = str(error.value)
    assert message in sentence and str(path) in sentence and "\n" not in sentence


def test_a_mode_for_the_whole_drive_may_repeat_that_of_the_table(tmp_path):
    path = table(tmp_path / "d.csv", changed(mode=["handling"] * 200))
    repeated, own = (
        read_measured_record(path, BASE, **o).record for o in ({"mode": "handling"}, {})
    )
    assert own.damper_high.all() and np.array_equal(repeated.damper_high, own.damper_high)


def test_all_problems_of_a_file_are_named_at_once(tmp_path):
    columns = changed(mode=None, v=None, a_lr=None, **spoilt("a_rr", 4, "over"))
    with pytest.raises(ConfigError) as error:
        read_measured_record(table(tmp_path / "d.csv", columns), BASE)
    told = str(error.value)
    assert "4 problems: (1) " in told
    assert all(
        part in told for part in ("a_lr is missing", "row 5", "speed is missing", "state of the")
    )


@pytest.mark.parametrize("data", [b"", b"t\n", b"\xff\xfe\x00", b"t,a_rf\n1,2,3\n", b"t\n1\n2\n"])
def test_an_invalid_table_is_rejected_in_one_sentence(tmp_path, data):
    for name in ("d.csv", "d.parquet"):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ConfigError, match=name):
            read_measured_record(tmp_path / name, BASE)
    with pytest.raises(ConfigError, match="missing"):
        read_measured_record(tmp_path / "missing.csv", BASE)


def test_a_record_is_recognised_by_its_metadata_even_if_damaged(tmp_path):
    record = read_measured_record(table(tmp_path / "d.csv", CHANNELS), BASE).record
    path = tmp_path / "d.parquet"
    write_record(path, replace(record, length=5.0), {})
    path.write_bytes(path.read_bytes()[:-10])
    assert is_record(path) and not is_record(tmp_path / "d.csv")
