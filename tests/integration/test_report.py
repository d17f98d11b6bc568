"""The command `report`: a table of a drive in, a page and files out."""

import json
import re

import pandas as pd
import pytest

from road_envs import load_vehicle
from road_envs.drives.recording import read_record, write_record
from road_envs.vehicle.parameters import write_vehicle

DRIVE = ("--road", "iso_b", "--length", "120", "--speed-kmh", "50", "--sensors", "phone")


@pytest.mark.costly
def test_a_report_has_a_page_that_needs_no_other_file_and_tables_that_agree(road_recon, tmp_path):
    road_recon("simulate", *DRIVE, "--out", "one.csv")
    table = pd.read_csv("one.csv", comment="#")
    table["lat"] = 48.0 + 1e-5 * table["s [m]"]
    table["lon"] = 11.0
    table.to_csv("one.csv", index=False)
    words = ("report", "one.csv", "--out", "r", "--estimator", "wiener", "--segment", "20")
    code, out, err = road_recon(*words, "--sensors", "phone", "--conditions", "norway", "--json")
    assert code == 0, err
    (drive,) = json.loads(out)["drives"]
    assert {path.name for path in (tmp_path / "r").iterdir()} == {
        "index.html", "one.geojson", "one_segments.csv", "one_segments.parquet",
        "one_obstacles.csv", "one_obstacles.parquet", "one_heights.parquet", "report.gpkg",
    }  # fmt: skip
    limits = [f"iri_{path}_{end}" for path in ("left", "right", "mean") for end in ("low", "high")]
    rows = pd.read_csv(
        tmp_path / "r/one_segments.csv", keep_default_na=False, na_values=dict.fromkeys(limits, "")
    )
    assert rows["iri_mean"].tolist() == pytest.approx([r["iri_mean"] for r in drive["segments"]])
    assert rows[limits].isna().all(axis=None)  # this estimator draws no roads: no intervals
    assert set(rows["state"]) == {"ride"}
    assert rows["iri_mean"].between(2.0, 7.0).all()  # class B: 4.3
    assert set(rows["condition"]) <= {"adequate", "poor", "very poor"}
    pd.testing.assert_frame_equal(rows, pd.read_parquet(tmp_path / "r/one_segments.parquet"),
                                  check_dtype=False, check_exact=False)  # fmt: skip
    page = (tmp_path / "r/index.html").read_text(encoding="utf-8")
    assert not re.search(r"""(src|href)\s*=\s*["'](?!#)""", page) and "@import" not in page
    assert page.count("><svg") == 4 and f"{rows['iri_mean'][2]:.2f}" in page
    shown = re.findall(r'<a xlink:href="#(drive-0-\d+)"><title>[^<]*IRI ([\d.]+)', page)
    assert [float(text) for _, text in shown] == pytest.approx(rows["iri_mean"], abs=0.005)
    assert all(f'<tr class="of-segment" id="{row}"' in page for row, _ in shown)
    features = json.loads((tmp_path / "r/one.geojson").read_text())["features"]
    assert sum(f["geometry"]["type"] == "LineString" for f in features) == len(rows)


@pytest.mark.costly
def test_without_positions_there_is_no_map(road_recon, tmp_path):
    road_recon("simulate", *DRIVE, "--out", "one.parquet")
    code, out, err = road_recon("report", "one.parquet", "--out", "r", "--estimator", "wiener")
    assert code == 0 and "written: r/index.html and 5 files beside it" in out, err
    page = (tmp_path / "r/index.html").read_text(encoding="utf-8")
    assert page.count("><svg") == 3 and "on the track" not in page


@pytest.mark.costly
def test_a_record_says_which_vehicle_was_simulated_and_else_a_note_which_is_assumed(
    road_recon, tmp_path
):
    """A file of a vehicle that a record names is not opened: records may come from anybody."""
    words = ("report", "--out", "r", "--estimator", "wiener", "--json")
    road_recon("simulate", *DRIVE, "--vehicle", "suv", "--out", "suv.parquet")
    code, told, err = road_recon(*words, "suv.parquet")
    assert code == 0, err
    assert told == road_recon(*words, "suv.parquet", "--vehicle", "suv")[1]
    assert "is assumed" not in told
    write_vehicle(tmp_path / "mine.yaml", load_vehicle("land_rover_defender_110"))
    road_recon("simulate", *DRIVE, "--vehicle", "mine.yaml", "--out", "mine.parquet")
    _, out, _ = road_recon(*words, "mine.parquet")
    assert json.loads(out)["drives"][0]["notes"][0] == (
        "the record is of the vehicle 'mine.yaml', which is no shipped one: "
        "land_rover_defender_110 is assumed (--vehicle says which)"
    )
    _, out, _ = road_recon(*words, "mine.parquet", "--vehicle", "mine.yaml")
    assert "is assumed" not in out
    write_record(tmp_path / "bare.parquet", read_record(tmp_path / "mine.parquet")[0], {})
    _, out, _ = road_recon(*words, "bare.parquet")
    assert "does not say which vehicle was simulated" in json.loads(out)["drives"][0]["notes"][0]


@pytest.mark.costly
def test_passes_are_moved_onto_the_first_and_compared(road_recon, tmp_path):
    """Two speeds, one of them without odometer; and a drive over another road."""
    road_recon("simulate", *DRIVE, "--seed", "2", "--out", "one.csv")
    road_recon("simulate", *DRIVE[:4], "--speed-kmh", "40", "--seed", "2", "--out", "two.csv")
    road_recon("simulate", *DRIVE, "--seed", "5", "--out", "other.csv")
    table = pd.read_csv("two.csv", comment="#")
    table.drop(columns=["s [m]"]).to_csv("two.csv", index=False)
    files = ("one.csv", "two.csv", "other.csv")
    words = ("--out", "r", "--estimator", "wiener", "--segment", "10", "--json")
    code, out, err = road_recon("report", *files, *words)
    assert code == 0, err
    told = json.loads(out)
    agreement = told["agreement"]
    assert agreement["names"] == ["one", "two"]
    assert len(agreement["segments"]) >= 9
    (row,) = agreement["passes"]
    assert abs(row["bias"]) < 0.5 and row["correlation"] > 0.8
    assert agreement["repeatability"] < 0.5 and agreement["icc"] > 0.7
    assert any("two: stations moved by" in note for note in told["drives"][1]["notes"])
    assert any("not compared with" in note for note in told["drives"][2]["notes"])
    road = {round(row["begin_m"]): row["iri_mean"] for row in told["road"]["segments"]}
    for row in agreement["segments"]:  # the joined road lies between its passes, or near
        assert min(row["iri"]) - 0.3 < road[round(row["begin_m"])] < max(row["iri"]) + 0.3
    assert "one road from one, two" in told["road"]["notes"][0]
    assert (tmp_path / "r/all_passes_segments.csv").exists()
    page = (tmp_path / "r/index.html").read_text(encoding="utf-8")
    assert "R 56-style" in page and "compliant" not in page
    assert "<li>one road from one, two" in page and "First doubt: one road" not in page


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("missing.csv", "--out", "r"), "missing.csv: cannot be read: No such file or directory"),
        (("one.csv", "--out", "r", "--segment", "50"), "--segment must be one of 10, 20, 100 m"),
        (("one.csv", "--out", "r", "--conditions", "hpm"), "did you mean 'hpms'"),
        (("one.csv", "--out", "one.csv"), "--out must be a folder"),
    ],
)
def test_wrong_words_end_in_one_sentence_without_a_folder(road_recon, tmp_path, words, message):
    (tmp_path / "one.csv").write_text("t\n1\n")
    code, _, err = road_recon("report", *words)
    assert code == 2 and message in err and err.count("\n") == 1
    assert not (tmp_path / "r").exists()
