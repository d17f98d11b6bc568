"""The page of a report in a browser: profiles of segments on demand, on screens of two sizes."""

import numpy as np
import pytest

from leaderboard.drive_report.conditions import load_conditions
from leaderboard.drive_report.report import ReportSettings, make_report, write_report
from leaderboard.metrics.heights import band_pass
from road_envs.drives.reading import read_drive
from road_envs.drives.recording import simulate_record, write_record
from road_envs.records.record import scored_band
from road_envs.roads import realise_road
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle

pytestmark = pytest.mark.costly

POINTS = """[...document.querySelectorAll('tr.opened polyline')]
.map(line => [...line.points].map(p => [p.x, p.y]))"""
OPENED = "[...document.querySelectorAll('tr.opened')].map(r => r.previousElementSibling.id)"
FIRST, SEGMENT = 2, 20.0


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The page and the result of a drive of 120 m by an estimator that is fast."""
    folder = tmp_path_factory.mktemp("report")
    record, _ = simulate_record(
        realise_road({"kind": "iso8608", "road_class": "B", "length": 120.0}, 3),
        speed_kmh=50.0, vehicle="bmw_320i", instruments=load_instruments("phone"), seed=3,
    )  # fmt: skip
    write_record(folder / "one.parquet", record, {}, load_vehicle("bmw_320i").modes)
    drive = read_drive(folder / "one.parquet", vehicle="bmw_320i")._replace(sensors="phone")
    chosen = ReportSettings(
        conditions=load_conditions("hpms"), settings={}, estimator="wiener", segment=SEGMENT
    )
    made = make_report([drive], chosen, lambda *_: None)
    return write_report(made, chosen, folder / "out")[0], made.drives[0]


def test_a_link_to_a_segment_opens_its_heights_below_its_row(browser, reported):
    page, result = reported
    browser.open(page, after=f"#drive-0-{FIRST}")
    assert browser.value(OPENED) == [f"drive-0-{FIRST}"]
    drawn, row = browser.value(POINTS), result.segments[FIRST]
    z = 1e3 * band_pass(result.estimate.z, result.estimate.ds, (0.05, scored_band(result.v)[1]))
    trim = (result.estimate.s.size - z.shape[1]) // 2
    s = result.estimate.s[trim : trim + z.shape[1]]
    assert len(drawn) == 2
    limit = 0.0
    for heights, points in zip(z, np.array(drawn), strict=True):
        x, y = points.T
        across = np.interp(x, [46, 892], [row["begin_m"], row["end_m"]])
        true = np.interp(across, s, heights)
        line = np.polynomial.Polynomial.fit(true, y, 1)
        assert line(true) == pytest.approx(y, abs=0.6)
        assert len(points) > 100 and across[-1] - across[0] > 0.98 * SEGMENT
        assert line.deriv()(0.0) < 0.0  # heights go up
        limit = max(limit, np.abs(y - 81).max())
    assert 40 < limit < 63  # of 63 pixels on either side of zero


def test_a_click_closes_it_and_no_screen_overflows(browser, reported):
    page, _ = reported
    browser.open(page, after=f"#drive-0-{FIRST}")
    browser.value(f"document.getElementById('drive-0-{FIRST}').click()")
    assert browser.value(OPENED) == []
    browser.value("document.getElementById('drive-0-0').click()")
    for width in (400, 1280):
        browser.resize(width)
        assert browser.value("document.documentElement.scrollWidth - innerWidth") <= 0
    assert browser.value(OPENED) == ["drive-0-0"] and browser.errors == []
