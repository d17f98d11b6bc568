"""A task in files of tables has the drives of its arrays, and heights in a file their scores."""

import numpy as np
import pandas
import pyarrow.parquet
import pytest
from fakes import fake_drives, task

from leaderboard.api import load_task, score_arrays
from leaderboard.evaluation import results
from leaderboard.task_tables import score_file, write_task
from road_envs.core.config import ConfigError
from road_envs.vehicle.parameters import load_vehicle


@pytest.fixture(scope="module")
def arrays():
    test = {"roads": ["iso_d"], "seeds": [11, 12], "length": 16.0}
    return load_task(task(test=test), simulate=fake_drives)


def guesses(arrays, seed=0):
    rng = np.random.default_rng(seed)
    return [0.01 * rng.standard_normal((2, drive["stations"].size)) for drive in arrays.test]


def filled(table, heights):
    for side, values in zip(("left", "right"), zip(*heights, strict=True), strict=True):
        table[side] = np.concatenate(values)
    return table


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_the_files_have_the_numbers_of_the_arrays(arrays, form, tmp_path):
    write_task(arrays, tmp_path, form)
    read = pandas.read_csv if form == "csv" else pandas.read_parquet
    rtol = 1e-11 if form == "csv" else 0.0  # the last digit of a text is pandas'
    records = read(tmp_path / f"test_records.{form}")
    for k, drive in enumerate(arrays.test, start=1):
        rows = records[records.drive == k]
        a = rows[list(drive["channels"])].to_numpy().T
        np.testing.assert_allclose(a, drive["a"], rtol=rtol)
        np.testing.assert_array_equal(rows["damper_high_RL"], drive["damper_high"][:, 2])
    profiles = read(tmp_path / f"training_profiles.{form}")
    z = np.concatenate([drive["z"] for drive in arrays.training], axis=1)
    np.testing.assert_allclose(profiles[["left", "right"]].to_numpy().T, z, rtol=rtol)
    assert read(tmp_path / f"test_profiles.{form}")[["left", "right"]].isna().all(axis=None)
    assert len(read(tmp_path / f"drives.{form}")) == len(arrays.training) + len(arrays.test)
    assert f"road-recon score HEIGHTS.{form}" in (tmp_path / "README.md").read_text()


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_heights_in_a_file_score_as_in_arrays(arrays, form, tmp_path):
    write_task(arrays, tmp_path, "parquet")
    heights = guesses(arrays)
    table = filled(pandas.read_parquet(tmp_path / "test_profiles.parquet"), heights)
    path = tmp_path / f"heights.{form}"
    table.to_csv(path, index=False) if form == "csv" else table.to_parquet(path)
    found, expected = score_file(arrays, path).values, score_arrays(arrays, heights).values
    np.testing.assert_equal(found, expected)


@pytest.mark.parametrize("form", ["csv", "parquet"])
@pytest.mark.parametrize(
    "change", [lambda z: z > 0.0, lambda z: pandas.to_timedelta(z, unit="s"), pandas.to_datetime]
)
def test_columns_that_are_no_numbers_are_not_scored(arrays, form, change, tmp_path):
    write_task(arrays, tmp_path, "parquet")
    table = filled(pandas.read_parquet(tmp_path / "test_profiles.parquet"), guesses(arrays))
    table["left"] = change(table["left"])
    path = tmp_path / f"heights.{form}"
    table.to_csv(path, index=False) if form == "csv" else table.to_parquet(path)
    with pytest.raises(ConfigError, match=r"heights\.\w+: column 'left' is not one of numbers"):
        score_file(arrays, path)


def test_deviations_below_0_and_columns_that_are_there_twice_are_refused(arrays, tmp_path):
    write_task(arrays, tmp_path, "csv")
    table = filled(pandas.read_csv(tmp_path / "test_profiles.csv"), guesses(arrays))
    table["left_std"], table["right_std"] = 0.01, -0.01
    table.to_csv(tmp_path / "negative.csv", index=False)
    with pytest.raises(ConfigError, match="test drive 1 has negative standard deviations"):
        score_file(arrays, tmp_path / "negative.csv")
    path = tmp_path / "twice.parquet"
    both = pyarrow.Table.from_pandas(table[["drive", "station", "left", "right", "task"]])
    pyarrow.parquet.write_table(both.append_column("left", both["left"]), path)
    csv = tmp_path / "twice.csv"
    csv.write_text("drive,station,left,right,task,left\n1,0,0,0,a,1\n")
    with pytest.raises(ConfigError, match=r"twice.csv: it has two columns 'left'"):
        score_file(arrays, csv)
    with pytest.raises(ConfigError, match=r"twice.parquet: it has two columns 'left'"):
        score_file(arrays, path)


def test_a_file_of_other_drives_is_refused_by_a_sentence(arrays, tmp_path):
    write_task(arrays, tmp_path, "csv")
    path = tmp_path / "test_profiles.csv"
    with pytest.raises(ConfigError, match="test drive 1 needs finite heights"):
        score_file(arrays, path)
    table = filled(pandas.read_csv(path), guesses(arrays))
    table.drop(columns="left").to_csv(path, index=False)
    with pytest.raises(ConfigError, match=r"no column 'left'; needed are drive, station, left"):
        score_file(arrays, path)
    table.assign(task="new_road-0").to_csv(path, index=False)
    with pytest.raises(ConfigError, match=r"its heights are of new_road-0, not of .*: give --task"):
        score_file(arrays, path)
    table[:-1].to_csv(path, index=False)
    last = len(arrays.test)
    with pytest.raises(ConfigError, match=f"test drive {last} needs its .* stations, 0 to"):
        score_file(arrays, path)
    table.assign(station=table.station[::-1].to_numpy()).to_csv(path, index=False)
    with pytest.raises(ConfigError, match="test drive 1 needs its"):
        score_file(arrays, path)
    table.assign(station=table.station.where(table.index != 3)).to_csv(path, index=False)
    with pytest.raises(ConfigError, match="test drive 1 needs its"):
        score_file(arrays, path)
    table.assign(left_std=0.01).to_csv(path, index=False)
    with pytest.raises(ConfigError, match="left_std is there alone"):
        score_file(arrays, path)
    pandas.concat([table, table[:1].assign(drive=last + 1)]).to_csv(path, index=False)
    with pytest.raises(ConfigError, match=f"a row is of no test drive; those are 1 to {last}"):
        score_file(arrays, path)
    path.write_bytes(b"\x00\xff")
    with pytest.raises(ConfigError, match="not a table of numbers"):
        score_file(arrays, path)


def test_heights_of_drives_that_other_code_made_are_refused(arrays, tmp_path, monkeypatch):
    path = tmp_path / "test_profiles.csv"
    with monkeypatch.context() as earlier:
        earlier.setattr(results, "evaluation_version", lambda: "0123+4567")
        write_task(arrays, tmp_path, "csv")
    table = filled(pandas.read_csv(path), guesses(arrays))
    for told in (table, table.assign(task=table.task.str.removesuffix("-0123+4567"))):
        told.to_csv(path, index=False)
        with pytest.raises(ConfigError, match=r"another version of this program made those drives"):
            score_file(arrays, path)
    table.assign(task=arrays.identity).to_csv(path, index=False)
    assert score_file(arrays, path).values["nrmse"] > 0.0


def test_each_drive_has_the_vehicle_of_its_condition_and_earlier_drives_of_it(tmp_path):
    """Tables have neither, and say so."""
    cars = ("van", "bmw_320i")
    conditions = [{"mode": "passive", "speed_kmh": 36.0, "car": car} for car in cars]
    road = {"roads": ["iso_d"], "length": 16.0}
    calibration = [{"mode": "passive", "speed_kmh": 36.0, "road": "iso_c", "seed_offset": 100,
                    "length": 16.0, "survey_std": 0.001}]  # fmt: skip
    common = {"car": "van", "training": {**road, "seeds": [1]}, "test": {**road, "seeds": [2]}}
    arrays = load_task(task(**common, conditions=conditions), simulate=fake_drives)
    masses = [load_vehicle(car).m_b for car in cars]
    assert [drive["vehicle"]["m_b"] for drive in arrays.test] == masses
    assert [drive["vehicle"]["m_b"] for drive in arrays.training] == masses
    calibrated = load_task(task(**common, conditions=conditions[:1], calibration=calibration))
    ((earlier,),) = (drive["calibration"] for drive in calibrated.test)
    assert earlier["z"].shape[0] == 2 and earlier["a"].shape[1] == earlier["t"].size
    for one in (arrays, calibrated):
        with pytest.raises(ConfigError, match="neither calibration drives nor a vehicle for each"):
            write_task(one, tmp_path / "tables", "csv")
    assert not (tmp_path / "tables").exists()


@pytest.mark.parametrize(
    "change",
    [
        lambda z: z + 1j,
        lambda z: z > 0.0,
        lambda z: (1e9 * z).astype("timedelta64[ns]"),
        lambda z: np.ma.masked_array(z, mask=z > 0.0),
        lambda z: [np.ma.masked_array(row, mask=row > 0.0) for row in z],
        lambda z: (z > 0.0).astype(object),
        lambda z: [[1.0, 2.0], [1.0]],
        lambda z: z.astype(str),
    ],
)
def test_heights_that_are_no_real_numbers_are_refused(arrays, change):
    heights = guesses(arrays)
    objects = score_arrays(arrays, [z.astype(object) for z in heights]).values
    np.testing.assert_equal(objects, score_arrays(arrays, heights).values)
    with pytest.raises(ConfigError, match=r"test drive 2 needs finite heights of the shape"):
        score_arrays(arrays, [heights[0], change(heights[1]), *heights[2:]])
