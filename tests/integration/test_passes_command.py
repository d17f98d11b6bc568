"""The command `estimate` with several passes over one road."""

import json
import shutil
from pathlib import Path

import pytest

from road_envs.drives.recording import read_record, simulate_record, true_profile, write_record
from road_envs.roads import Surface, realise_road, write_csv

ROAD = realise_road("iso_c", 3, 45.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("passes")
    for name, road, kmh, seed in (
        ("a", ROAD, 14.5, 1), ("b", ROAD, 30.0, 2), ("c", realise_road("iso_c", 9, 45.0), 30.0, 3),
    ):  # fmt: skip
        record, _ = simulate_record(road, speed_kmh=kmh, mode="handling", seed=seed)
        write_record(folder / f"{name}.parquet", record, {})
    truth = true_profile(ROAD)
    write_csv(Surface(truth.z, truth.ds, name="road"), folder / "road.csv")
    return folder


@pytest.fixture
def passes(files, tmp_path):
    """Drives a.parquet and b.parquet over one road, c.parquet over another, and road.csv."""
    return Path(shutil.copytree(files, tmp_path, dirs_exist_ok=True))


@pytest.mark.costly
def test_several_drives_give_one_road_that_is_better_than_that_of_one(road_recon, passes):
    def nrmse(*files):
        words = ("estimate", "iterated_wiener", *files, "--truth", "road.csv", "--json")
        code, out, err = road_recon(*words)
        assert code == 0, err
        return json.loads(out)["scores"]["nrmse"], json.loads(out)["notes"]

    one, _ = nrmse("a.parquet")
    both, notes = nrmse("a.parquet", "b.parquet", "--out", "road_found.csv")
    assert both < one
    assert any(note.startswith("b.parquet: stations moved by") for note in notes)
    assert "lateral wander between the passes is neglected" in notes
    assert (passes / "road_found.csv").exists()


@pytest.mark.costly
def test_a_drive_of_another_road_is_refused_by_name_and_nothing_is_written(road_recon, passes):
    code, _, err = road_recon("estimate", "wiener", "a.parquet", "c.parquet", "--out", "e.csv")
    assert code == 2
    assert "c.parquet matches a.parquet nowhere" in err and "Traceback" not in err
    assert not (passes / "e.csv").exists()


@pytest.mark.parametrize("words", [("estimate", "wiener"), ("report",)])
def test_a_drive_given_twice_is_refused(road_recon, passes, words):
    shutil.copy(passes / "a.parquet", passes / "copy.parquet")
    code, _, err = road_recon(*words, "a.parquet", "copy.parquet", "--out", "twice.csv")
    assert code == 2 and "copy.parquet are the same drive: give each pass once" in err
    assert not (passes / "twice.csv").exists()


@pytest.mark.costly
def test_each_table_is_read_by_the_description_beside_it(road_recon, passes):
    """b.csv has columns of other names, which its own description tells."""
    for name in ("a", "b"):
        write_record(passes / f"{name}.csv", *read_record(passes / f"{name}.parquet"))
    text = (passes / "b.csv").read_text().replace("a_rf [m/s2]", "front")
    (passes / "b.csv").write_text(text)
    (passes / "b.yaml").write_text("columns: {a_rf: front}\n")
    code, out, err = road_recon("estimate", "wiener", "a.csv", "b.csv", "--json")
    assert code == 0, err
    assert "b.csv: read by the description b.yaml" in json.loads(out)["notes"]
