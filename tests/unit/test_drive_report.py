"""Results of a drive report: posterior of the IRI, obstacles, categories, segments and files."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from leaderboard.drive_report import analysis, obstacles
from leaderboard.drive_report.analysis import analyse
from leaderboard.drive_report.conditions import Conditions, load_conditions
from leaderboard.drive_report.export import _write_geojson
from leaderboard.drive_report.obstacles import (
    CERTAIN,
    FALSE_ALARMS,
    HEIGHT_STD,
    DetectedObstacle,
    detect,
)
from leaderboard.drive_report.page import write_page
from leaderboard.drive_report.pictures import _iri_chart
from leaderboard.drive_report.posterior_iri import posterior_iri
from road_envs.core.config import ConfigError
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.records.record import PROFILE_SPACING, Estimate, Record, profile_stations
from road_envs.records.roughness import iri
from road_envs.roads import realise_road

HPMS = load_conditions("hpms")


def estimate(road, length=300.0, std=0.0, seed=1):
    surface = realise_road(road, seed, None if road == "street" else length)
    s = profile_stations(length)
    return Estimate(s, surface.height(s), np.full((2, s.size), std))


def drive(length=300.0, speed=15.0, fs=200.0):
    """Three silent accelerometers at constant speed from station 0."""
    t = np.arange(int(length / speed * fs) + 1) / fs
    off = np.zeros((t.size, 4), dtype=bool)
    a = np.zeros((3, t.size))
    return Record(t, a, np.full(t.size, speed), speed * t, off, off, length)


def with_draws(one: Estimate, changes: np.ndarray) -> Estimate:
    return replace(one, draws=one.z + changes)


def test_the_iri_of_a_profile_alone_has_no_interval_unless_a_deviation_is_known():
    one, edges = estimate("iso_c"), np.array([0.0, 100.0, 200.0, 300.0])
    bare = posterior_iri(one, edges)
    expected = iri(one.z, one.ds, segment=100.0)
    np.testing.assert_allclose(bare.median[:2, :2], expected[:, :2], rtol=0.02)
    assert np.isnan(bare.low).all() and np.isnan(bare.high).all()
    known = posterior_iri(one, edges, factor=1.1, relative_std=0.05)
    np.testing.assert_allclose(known.median, 1.1 * bare.median)
    np.testing.assert_allclose(np.log(known.high / known.low), 2 * 1.96 * 0.05)
    assert any("no interval" in note for note in measured_result(one).notes)


def test_the_iri_of_draws_is_their_geometric_mean_with_the_interval_of_their_spread():
    """Draws that are multiples of the road have multiples of its IRI."""
    one, edges = estimate("iso_c"), np.array([0.0, 100.0, 200.0, 300.0])
    log = np.linspace(-0.1, 0.1, 9)
    found = posterior_iri(with_draws(one, np.expm1(log)[:, None, None] * one.z), edges)
    np.testing.assert_allclose(found.median, posterior_iri(one, edges).median, rtol=1e-9)
    # with 1 % for the model of the vehicle, and 0.05 mm/m for what hides smooth roads
    spread = np.sqrt(log.var() + 0.01**2 + (0.05 / found.median) ** 2)
    np.testing.assert_allclose(np.log(found.high / found.low), 2 * 1.96 * spread, rtol=1e-9)
    assert not any("no interval" in note for note in measured_result(one, log).notes)


def measured_result(one: Estimate, log: np.ndarray | None = None):
    """The result of a drive with an estimate, with draws that are multiples of it by exp `log`."""
    if log is not None:
        one = with_draws(one, np.expm1(log)[:, None, None] * one.z)
    return analyse("d", MeasuredRecord(drive()), one, HPMS)


def test_the_interval_of_a_smoothed_profile_contains_the_iri_of_the_road():
    """Estimate: the road less an error that is independent of the estimate, as of a posterior."""
    rng, hits, bias = np.random.default_rng(3), 0, []
    edges = np.arange(0.0, 301.0, 50.0)
    for seed in range(8):
        one = estimate("iso_b", seed=seed)
        errors = 8e-6 * np.cumsum(rng.standard_normal((33, *one.z.shape)), axis=2)
        true = posterior_iri(replace(one, z=one.z + errors[0]), edges).median
        found = posterior_iri(with_draws(one, errors[1:]), edges)
        plain = posterior_iri(one, edges).median
        hits += int(((found.low <= true) & (true <= found.high)).sum())
        bias.append([np.mean(found.median / true) - 1.0, np.mean(plain / true) - 1.0])
    assert hits >= 0.88 * 8 * 18
    ours, of_profile = np.mean(bias, axis=0)
    assert abs(ours) < 0.25 * abs(of_profile)


def test_a_hump_a_pothole_and_a_bump_are_found_between_the_waves_of_a_street():
    hump, hole, bump = detect(estimate("street", std=0.002))
    assert hump.station == pytest.approx(80.0, abs=0.3)
    assert hump.height == pytest.approx(0.075, rel=0.1)
    # a half sine exceeds half its height over two thirds of its length
    assert hump.length == pytest.approx(2.0 / 3.0 * 3.7, rel=0.15)
    assert hole.station == pytest.approx(150.0, abs=0.3)
    assert hole.height == pytest.approx(-0.05, rel=0.2)
    assert bump.station == pytest.approx(220.0, abs=0.3)
    assert bump.height == pytest.approx(0.03, rel=0.2)
    assert [hump.side, hole.side, bump.side] == ["both", "right", "both"]
    assert min(hump.confidence, hole.confidence, bump.confidence) > 0.9


@pytest.mark.parametrize("letter", ["b", "c"])
def test_heights_of_obstacles_are_read_over_the_line_between_their_feet(letter):
    """A median over 10 m is 11 to 13 % off on class C, where the road itself is as uneven."""
    heights, places = [], []
    for seed in range(12):
        one = estimate(f"iso_{letter}", length=120.0, seed=seed)
        z = one.z.copy()
        for at, length, height in ((35.0, 3.7, 0.075), (85.0, 0.9, 0.03)):
            inside = np.abs(one.s - at) < 0.5 * length
            z[:, inside] += height * np.cos(np.pi * (one.s[inside] - at) / length)
        near = [
            o
            for o in detect(Estimate(one.s, z))
            if min(abs(o.station - 35), abs(o.station - 85)) < 0.5
        ]
        assert [o.side for o in near] == ["both", "both"]
        heights.append([near[0].height / 0.075 - 1.0, near[1].height / 0.03 - 1.0])
        places.append([near[0].station - 35.0, near[1].station - 85.0])
        assert all(0.3 * abs(o.height) > o.height_std > 0.01 * abs(o.height) for o in near)
    assert np.abs(places).max() < 0.15
    assert np.std(heights) < (0.05 if letter == "b" else 0.09)
    assert abs(np.mean(heights)) < 0.04


@pytest.mark.parametrize("length", [0.9, 3.7])
def test_a_half_sine_has_its_height_and_the_deviation_of_an_estimate(length):
    s = np.arange(0.0, 60.0, PROFILE_SPACING)
    z = 0.05 * np.cos(np.pi * np.clip((s - 30.0) / length, -0.5, 0.5))
    (found,) = detect(Estimate(s, np.array([z, z])))
    assert found.height == pytest.approx(0.05, rel=0.02)
    measured = MeasuredRecord(drive(length=60.0))
    (row,) = analyse("one", measured, Estimate(s, np.array([z, z])), HPMS).obstacles
    half_width = 1.96e3 * np.hypot(found.height_std, HEIGHT_STD * 0.05)
    assert row["height_high_mm"] - row["height_mm"] == pytest.approx(half_width, rel=0.02)


def test_a_deep_hole_leaves_no_rims_as_bumps():
    one = estimate("flat", length=60.0)
    z = one.z.copy()
    z[1] -= 0.05 * np.clip((0.6 - np.abs(one.s - 30.0)) / 0.2, 0.0, 1.0)
    (hole,) = detect(Estimate(one.s, z))
    assert hole.side == "right" and hole.height == pytest.approx(-0.05, rel=0.02)
    assert hole.length == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("gap, count", [(0.1, 1), (2.0, 2)])
def test_obstacles_less_than_half_a_metre_apart_are_one(gap, count):
    """Where a wheel flew, a report had six bumps and two holes in two metres for one bump."""
    s = np.arange(0.0, 60.0, PROFILE_SPACING)
    bump = 0.06 * np.cos(np.pi * np.clip((s - 30.0) / 0.9, -0.5, 0.5))
    hole = 0.03 * np.cos(np.pi * np.clip((s - 30.65 - gap) / 0.4, -0.5, 0.5))
    found = detect(Estimate(s, np.array([bump - hole, bump - hole])))
    assert len(found) == count
    assert found[0].height == pytest.approx(0.06, rel=0.15)


def test_an_obstacle_of_little_confidence_is_called_possible(monkeypatch):
    found = [
        DetectedObstacle(40.0 * k, height, 0.002, 1.0, "left", confidence)
        for k, (height, confidence) in enumerate([(0.03, 0.97), (-0.03, 0.97), (-0.03, 0.99)], 1)
    ]
    monkeypatch.setattr(analysis, "detect", lambda estimate: found)
    result = analyse("d", MeasuredRecord(drive()), estimate("street"), HPMS)
    kinds = [row["kind"] for row in result.obstacles]
    assert kinds == ["possible bump", "possible hole", "hole"]


def test_the_place_of_an_obstacle_is_as_uncertain_as_the_driven_distance():
    measured = MeasuredRecord(drive())
    rows = analyse("d", measured, estimate("street"), HPMS, distance_std=0.005).obstacles
    assert [row["station_std_m"] for row in rows] == pytest.approx([0.43, 0.76, 1.11], abs=0.02)


def test_random_roads_have_next_to_no_obstacles():
    """At a confidence of 0.95 there is one in 20 wheel paths of 100 m; here are 120."""
    for road in ("iso_c", "iso_d"):
        found = [o for seed in range(20) for o in detect(estimate(road, seed=seed))]
        assert len(found) <= 12
        assert all(obstacle.confidence < 0.9999 for obstacle in found)
    assert not [o for seed in range(10) for o in detect(estimate("iso_b", seed=seed))]


@pytest.mark.slow
@pytest.mark.parametrize("letter", FALSE_ALARMS)
def test_random_roads_have_as_many_obstacles_as_the_report_says(letter):
    roads = [estimate(f"iso_{letter.lower()}", seed=seed) for seed in range(200)]
    found = [obstacle for road in roads for obstacle in detect(road)]
    certain = sum(obstacle.confidence >= CERTAIN for obstacle in found)
    assert (len(found) / 60.0, certain / 60.0) == pytest.approx(FALSE_ALARMS[letter], abs=0.005)


def test_categories_change_at_95_and_170_inches_per_mile():
    inch_per_mile = 1e3 * 0.0254 / 1609.344
    for value, category in ((94.9, "good"), (95.1, "fair"), (169.9, "fair"), (170.1, "poor")):
        assert HPMS.category(inch_per_mile * value) == category
    with pytest.raises(ConfigError, match="2 categories need 1 limits"):
        Conditions(name="x", title="x", categories=("a", "b"), limits=(1.0, 2.0), source="")
    with pytest.raises(ConfigError, match="must increase"):
        Conditions(name="x", title="x", categories=("a", "b", "c"), limits=(2.0, 1.0), source="")


@pytest.mark.parametrize(
    ("road", "named"), [("iso_b", {"good", "fair", "poor"}), ("iso_d", {"poor"})]
)
def test_the_chart_names_the_categories_for_which_there_is_room(road, named):
    chart = _iri_chart(analyse("d", MeasuredRecord(drive()), estimate(road), HPMS), HPMS)
    assert {name for name in HPMS.categories if f">{name}<" in chart} == named


def test_the_page_has_as_many_categories_as_there_are(tmp_path):
    names, limits = tuple("abcdefg"), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    seven = Conditions(name="x", title="x", categories=names, limits=limits, source="")
    result = analyse("d", MeasuredRecord(drive()), estimate("iso_d"), seven)
    about = {"estimator": "x", "vehicle": "y", "sensors": "z"}
    write_page([result], seven, about, None, tmp_path / "index.html")
    assert "</span>g</span>" in (tmp_path / "index.html").read_text()


def test_segments_end_at_multiples_of_their_length_in_the_chainage_of_the_user():
    measured = MeasuredRecord(drive(), chainage=1234.0)
    rows = analyse("d", measured, estimate("iso_c"), HPMS, segment=100.0).segments
    assert [round(row["end_m"]) for row in rows] == [1300, 1400, 1534]
    assert rows[0]["begin_m"] == 1234.0
    assert all(a["end_m"] == b["begin_m"] for a, b in pairwise(rows))
    short = analyse("d", measured, estimate("iso_c"), HPMS, segment=10.0).segments
    assert len(short) == 30 and short[1]["end_m"] == pytest.approx(1250.0)
    mean = np.average(
        [r["iri_mean"] for r in short], weights=[r["end_m"] - r["begin_m"] for r in short]
    )
    whole = np.average(
        [r["iri_mean"] for r in rows], weights=[r["end_m"] - r["begin_m"] for r in rows]
    )
    assert mean == pytest.approx(whole, rel=0.02)


@pytest.mark.parametrize(("road", "letter"), [("iso_a", "A"), ("iso_b", "B"), ("iso_d", "D")])
def test_the_class_of_a_segment_is_that_of_the_road(road, letter):
    rows = analyse("d", MeasuredRecord(drive()), estimate(road), HPMS, segment=100.0).segments
    assert {row["class"] for row in rows} == {letter}
    assert {row["class_0.25"] for row in rows} <= {chr(ord(letter) + k) for k in (-1, 0, 1)}
    assert analyse("d", MeasuredRecord(drive()), estimate(road), HPMS, segment=10.0).segments[3][
        "class_0.125"
    ] == ""  # 1.25 waves  # fmt: skip


def test_flags_name_the_segments_that_they_belong_to():
    record = drive()
    record.a[:, (record.s > 110.0) & (record.s < 130.0)] = np.nan
    record.a[0, (record.s > 250.0) & (record.s < 251.0)] = 70.0
    record.v[record.s < 90.0] = 4.0
    measured = MeasuredRecord(record, fs=50.0)
    rows = analyse("d", measured, estimate("iso_c"), HPMS, segment=100.0, clipping=68.6).segments
    assert "slow: waves longer than" in rows[0]["flags"] and "start" in rows[0]["flags"]
    assert "20% of the samples lost" in rows[1]["flags"] and "clipped" not in rows[1]["flags"]
    assert "clipped" in rows[2]["flags"] and "lost" not in rows[2]["flags"]
    fast = analyse("d", MeasuredRecord(drive(speed=30.0)), estimate("iso_c"), HPMS).segments
    assert "waves shorter than 1.3 m are not resolved" in fast[1]["flags"]


def test_geojson_has_lines_for_segments_and_points_for_obstacles(tmp_path):
    record = drive()
    position = np.stack([48.0 + record.s / 111_195.0, 11.0 + 0.0 * record.s])
    measured = MeasuredRecord(record, chainage=500.0, position=position)
    result = analyse("d", measured, estimate("street", std=0.002), HPMS)
    (path,) = _write_geojson(result, tmp_path)
    features = json.loads(path.read_text())["features"]
    kinds = [feature["geometry"]["type"] for feature in features]
    assert kinds == ["LineString"] * 3 + ["Point"] * 3
    lon, lat = features[3]["geometry"]["coordinates"]
    assert (lat - 48.0) * 111_195.0 == pytest.approx(80.0, abs=0.5) and lon == 11.0
    assert features[3]["properties"]["station_m"] == pytest.approx(580.0, abs=0.3)
    first, last = (features[1]["geometry"]["coordinates"][k] for k in (0, -1))
    assert (last[1] - first[1]) * 111_195.0 == pytest.approx(100.0, abs=0.5)
    assert (
        _write_geojson(analyse("d", MeasuredRecord(record), estimate("iso_c"), HPMS), tmp_path)
        == []
    )


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", [82, 100, 119, 162, 220])
def test_obstacles_whose_feet_lie_beside_their_peak_end_the_search(seed, monkeypatch):
    """Steps near the ends: the feet that are read may be those of a neighbour."""
    rng, z, readings = np.random.default_rng(seed), np.zeros(400), []
    for _ in range(rng.integers(1, 4)):
        at, width = rng.integers(0, z.size), rng.integers(1, 120)
        z[at : at + width] += rng.choice([-1, 1]) * rng.uniform(0.01, 0.06)
    if rng.random() < 0.5:
        z += np.cumsum(rng.standard_normal(z.size)) * rng.choice([0, 1e-4, 5e-4])
    read = obstacles._read

    def counted(*args):
        readings.append(args)
        assert len(readings) <= z.size
        return read(*args)

    monkeypatch.setattr(obstacles, "_read", counted)
    list(obstacles._detect_path(z, np.zeros(z.size), PROFILE_SPACING))
    assert readings
