"""Files of a report for other programs: GeoPackage, HPMS, and the road itself."""

import csv
import itertools
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from phone_recordings import phone
from scipy.spatial.transform import Rotation

from estimators.map_smoother.estimator import MapSmoother
from leaderboard.drive_report.conditions import load_conditions
from leaderboard.drive_report.export import parse_route, read_heights
from leaderboard.drive_report.report import ReportSettings, make_report, write_report
from road_envs.core.config import ConfigError
from road_envs.drives.reading import read_drives
from road_envs.drives.recording import simulate_record
from road_envs.roads import realise_road
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The folder and the result of a report of one phone by the fast estimator."""
    from phone_recordings import phyphox

    folder = tmp_path_factory.mktemp("report")
    one = phone(Rotation.random(random_state=1), duration=30.0)
    (folder / "it's.zip").write_bytes(phyphox(one))
    drives = read_drives(folder / "it's.zip", vehicle="bmw_320i")
    chosen = ReportSettings(
        conditions=load_conditions("hpms"), settings={}, estimator="wiener", route=("I-80", 12.5)
    )
    made = make_report(drives, chosen, lambda *_: None)
    write_report(made, chosen, folder / "out")
    return folder / "out", made.drives[0]


@pytest.mark.costly
def test_a_geopackage_has_the_segments_obstacles_and_the_track(reported):
    folder, result = reported
    with closing(sqlite3.connect(folder / "report.gpkg")) as base:
        assert base.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        names = {row[0] for row in base.execute("SELECT table_name FROM gpkg_contents")}
        rows = base.execute('SELECT iri_mean, condition FROM "it\'s_segments"').fetchall()
    assert names == {"it's_segments", "it's_obstacles", "it's_track"}
    assert rows == [(row["iri_mean"], row["condition"]) for row in result.segments]


def test_another_reader_finds_lines_and_values_in_the_geopackage(reported):
    pyogrio = pytest.importorskip("pyogrio")
    folder, result = reported
    meta, _, geometry, values = pyogrio.raw.read(folder / "report.gpkg", layer="it's_segments")
    assert meta["crs"] == "EPSG:4326" and meta["geometry_type"] == "LineString"
    columns = dict(zip(meta["fields"], values, strict=True))
    np.testing.assert_allclose(
        columns["iri_in_per_mi"], [63.36 * row["iri_mean"] for row in result.segments]
    )
    line = np.frombuffer(geometry[0][9:]).reshape(-1, 2)
    lat, lon = result.position(result.segments[0]["begin_m"] - result.chainage)
    assert line[0] == pytest.approx([lon, lat], abs=1e-6)
    assert len(pyogrio.list_layers(folder / "report.gpkg")) == 3


def test_hpms_sections_follow_one_another_in_miles(reported):
    folder, result = reported
    with (folder / "it's_hpms.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["Route_ID"], row["Data_Item"]) for row in rows} == {("I-80", "IRI")}
    begins = [float(row["Begin_Point"]) for row in rows]
    assert begins[0] == pytest.approx(12.5 + result.segments[0]["begin_m"] / 1609.344, abs=1e-4)
    for one, other in itertools.pairwise(rows):
        assert one["End_Point"] == other["Begin_Point"]
    assert [int(row["Value_Numeric"]) for row in rows] == [
        round(63.36 * row["iri_mean"]) for row in result.segments
    ]


@pytest.mark.parametrize("route", ["", ",3", "I-80,x", "I-80,nan", 'a"b', "I-80,inf"])
def test_a_route_that_cannot_be_is_refused(route):
    with pytest.raises(ConfigError, match="--route must be a route"):
        parse_route(route)


def test_the_exported_road_is_that_of_the_heights(reported, road_recon, tmp_path):
    folder, result = reported
    heights = folder / "it's_heights.parquet"
    for suffix in (".erd", ".crg"):
        code, _, err = road_recon("export", str(heights), "--out", f"road{suffix}")
        assert code == 0, err
        surface = realise_road(tmp_path / f"road{suffix}", 0)
        apart = surface.z[0] - result.estimate.z[0]  # a surface begins at height 0
        assert np.ptp(apart) < 1e-8
        assert surface.ds == pytest.approx(result.estimate.ds)
    pd.DataFrame({"a": [1.0]}).to_parquet(tmp_path / "x.parquet")
    code, _, err = road_recon("export", "x.parquet", "--out", "road.erd")
    assert code == 2 and "not the NAME_heights.parquet of a report" in err
    code, _, err = road_recon("export", str(heights), "--out", "road.png")
    assert code == 2 and "must end in" in err


def test_the_own_vehicle_over_the_exported_road_repeats_the_drive(tmp_path):
    """Where the vehicle is the described one, within twice the noise of the sensors."""
    phone = replace(load_instruments("phone"), speed_error=0.0)  # else both drives shift
    car = load_vehicle("bmw_320i")
    common = {"vehicle": car, "instruments": phone, "speed_kmh": 50.0}
    record, _ = simulate_record("iso_b", length=150.0, seed=3, **common)
    found = MapSmoother(instruments="phone", draws=0).estimate(record, car)
    frame = {"station_m": found.s, "left_m": found.z[0], "right_m": found.z[1]}
    pd.DataFrame(frame).to_parquet(tmp_path / "d_heights.parquet")
    surface = read_heights(tmp_path / "d_heights.parquet")
    again, _ = simulate_record(surface, seed=4, **common)
    n = min(record.t.size, again.t.size)
    inside = slice(round(0.1 * n), round(0.9 * n))
    apart = np.sqrt(np.nanmean((record.a[:, :n] - again.a[:, :n])[:, inside] ** 2, axis=1))
    noise = 0.0025 * np.sqrt(50.0)  # density of the phone's noise over half its rate
    assert (apart < 2.0 * np.sqrt(2.0) * noise).all()  # of both drives
