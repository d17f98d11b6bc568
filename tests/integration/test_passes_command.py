"""The command `estimate` with several passes over one road."""

import json

import pytest

from road_envs.data.recording import simulate_record, true_profile, write_record
from road_envs.roads import Surface, realise_road, write_csv

ROAD = realise_road("iso_c", 3, 45.0)


@pytest.fixture
def passes(tmp_path):
    """Drives a.csv and b.csv over one road, c.csv over another, and road.csv."""
    for name, road, kmh, seed in (
        ("a", ROAD, 14.5, 1), ("b", ROAD, 30.0, 2), ("c", realise_road("iso_c", 9, 45.0), 30.0, 3),
    ):  # fmt: skip
        record, _ = simulate_record(road, speed_kmh=kmh, mode="handling", seed=seed)
        write_record(tmp_path / f"{name}.csv", record, {})
    truth = true_profile(ROAD)
    write_csv(Surface(truth.z, truth.ds, name="road"), tmp_path / "road.csv")
    return tmp_path


def test_several_drives_give_one_road_that_is_better_than_that_of_one(road_recon, passes):
    def nrmse(*files):
        words = ("estimate", "iterated_wiener", *files, "--truth", "road.csv", "--json")
        code, out, err = road_recon(*words)
        assert code == 0, err
        return json.loads(out)["scores"]["nrmse"], json.loads(out)["notes"]

    one, _ = nrmse("a.csv")
    both, notes = nrmse("a.csv", "b.csv", "--out", "road_found.csv")
    assert both < one
    assert any(note.startswith("b.csv: stations moved by") for note in notes)
    assert "lateral wander between the passes is neglected" in notes
    assert (passes / "road_found.csv").exists()


def test_a_drive_of_another_road_is_refused_by_name_and_nothing_is_written(road_recon, passes):
    code, _, err = road_recon("estimate", "iterated_wiener", "a.csv", "c.csv", "--out", "e.csv")
    assert code == 2
    assert "c.csv matches a.csv nowhere" in err and "Traceback" not in err
    assert not (passes / "e.csv").exists()


def test_each_table_is_read_by_the_description_beside_it(road_recon, passes):
    """b.csv has columns of other names, which its own description tells."""
    text = (passes / "b.csv").read_text().replace("a_rf [m/s2]", "front")
    (passes / "b.csv").write_text(text)
    (passes / "b.yaml").write_text("columns: {a_rf: front}\n")
    code, out, err = road_recon("estimate", "iterated_wiener", "a.csv", "b.csv", "--json")
    assert code == 0, err
    assert "b.csv: read by the description b.yaml" in json.loads(out)["notes"]
