"""Long drives by sections, and the sections that an interrupted report keeps."""

from dataclasses import replace

import numpy as np
import pytest
from phone_recordings import phone, phyphox
from scipy.spatial.transform import Rotation

from estimators.map_smoother.estimator import MapSmoother
from leaderboard.commands.drive_files import DriveOptions
from leaderboard.commands.report import report
from leaderboard.drive_report import sections
from leaderboard.drive_report.sections import KEPT, Sections, _DriveSection, join, split
from road_envs.drives.recording import simulate_record
from road_envs.records.record import PROFILE_SPACING, DistanceScale, Estimate, profile_stations
from road_envs.roads import realise_road
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle

ONE = MapSmoother(adapt=False, instruments="phone")


@pytest.fixture(scope="module")
def drive():
    """A record of three phones in a saloon over 60 m, and the saloon."""
    record, _ = simulate_record(
        realise_road("iso_c", 3, 60.0),
        speed_kmh=50.0,
        vehicle="saloon",
        instruments=load_instruments("phone"),
    )
    return record, load_vehicle("saloon")


@pytest.fixture
def short(monkeypatch):
    """Sections of 20 m."""
    monkeypatch.setattr(sections, "_SECTION", 20.0)
    monkeypatch.setattr(sections, "_RUN_IN", 10.0)
    monkeypatch.setattr(sections, "_RUN_OUT", 5.0)


def estimate(drive, folder=None, one=ONE, said=None):
    record, car = drive
    said = [] if said is None else said
    return Sections(folder, said=said.append).estimator(one).estimate(record, car)


def interrupt_after(monkeypatch, count, error=KeyboardInterrupt):
    """Make the estimate of another section than the first `count` raise an error."""
    original, calls = MapSmoother.estimate, []

    def counted(self, record, car):
        calls.append(record)
        if len(calls) > count:
            raise error
        return original(self, record, car)

    monkeypatch.setattr(MapSmoother, "estimate", counted)
    return calls


def assert_equal(one, other):
    for name in ("s", "z", "z_std", "draws"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert (one.notes, one.distance, one.residual) == (other.notes, other.distance, other.residual)


def test_sections_cover_the_drive_with_their_run_ins_on_its_own_stations(drive, short):
    record, car = drive
    found = split(record, car.wheelbase, 20.0)
    assert [round(x.start * PROFILE_SPACING) for x in found] == [0, 20, 40]
    for section in found[1:]:
        part = section.of(record)
        shift = PROFILE_SPACING * section.first
        assert 0.0 <= part.s[0] - car.wheelbase < 2.0 * PROFILE_SPACING
        assert part.s[0] + shift == pytest.approx(section.start * PROFILE_SPACING - 10.0, abs=0.2)
        np.testing.assert_allclose(part.s + shift, record.s[section.begin : section.end])
    assert found[-1].end == record.t.size and found[0].begin == 0


@pytest.mark.costly
def test_a_short_drive_is_one_section_and_its_estimate_that_without_sections(drive):
    assert len(split(*drive[:1], drive[1].wheelbase)) == 1
    assert_equal(estimate(drive), ONE.estimate(*drive))


@pytest.mark.costly
def test_the_road_of_all_sections_is_that_of_the_drive(drive, short):
    whole, joined = ONE.estimate(*drive), estimate(drive)
    slopes, others = (np.diff(x.z, axis=1)[:, 400:-200] for x in (whole, joined))
    assert np.std(slopes - others) < 0.25 * np.std(slopes)
    assert not np.array_equal(slopes, others)  # it is another one


def test_parts_go_on_at_the_height_of_those_before():
    s = profile_stations(30.0)
    z = np.array([np.sin(s), np.cos(s)])
    cut = [_DriveSection(0, 0, 0, 0), _DriveSection(0, 0, 300, 500), _DriveSection(0, 0, 700, 900)]
    spans = [(0, 600), (300, 1000), (700, s.size)]

    def part(k, note):
        a, b = spans[k]
        here, level = s[: b - a], 0.3 * k
        draws = np.array([z[:, a:b] + level, 2.0 * z[:, a:b] - level], dtype=np.float32)
        distance = DistanceScale(1.0 + 0.01 * k, 0.01)
        return Estimate(
            here, z[:, a:b] + level, 0.0 * z[:, a:b] + k, (note, f"residual {k}.5"),
            distance=distance, draws=draws, residual=float(k),
        )  # fmt: skip

    found = join([part(0, "all"), part(1, "all"), part(2, "all")], cut, 30.0)
    np.testing.assert_allclose(found.z, z, atol=1e-12)
    np.testing.assert_allclose(found.draws, [z, 2.0 * z], atol=1e-6)
    np.testing.assert_array_equal(found.z_std[0], np.repeat([0, 1, 2], [500, 400, s.size - 900]))
    assert found.notes == ("all", "residual 2.5 (23 to 30 m; the worst of 3 such sections)")
    assert found.distance == pytest.approx((1.01, 0.01)) and found.residual == 2.0


@pytest.mark.costly
def test_an_interrupted_estimate_goes_on_and_is_that_of_one_that_was_not(
    drive, short, tmp_path, monkeypatch
):
    undisturbed, said = estimate(drive), []
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupt_after(patch, 2)
        estimate(drive, tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    calls = interrupt_after(monkeypatch, 1)  # the third section is all that is left
    assert_equal(estimate(drive, tmp_path, said=said), undisturbed)
    assert len(calls) == 1 and said[0].endswith(": 2 of 3 sections")
    Sections(tmp_path).clear()
    assert not tmp_path.exists()


@pytest.mark.costly
def test_nothing_is_kept_for_another_record_vehicle_or_setting(drive, short, tmp_path, monkeypatch):
    record, car = drive
    estimate(drive, tmp_path)
    calls = interrupt_after(monkeypatch, 0, error=RuntimeError)
    estimate(drive, tmp_path)
    assert not calls
    heavier = replace(car, m_b=car.m_b + 1.0)
    louder = replace(record, a=1.001 * record.a)
    others = [((louder, car), ONE), ((record, heavier), ONE), (drive, replace(ONE, huber=1.7))]
    for other, one in others:
        with pytest.raises(RuntimeError):
            estimate(other, tmp_path, one)
    assert len(calls) == len(others)


@pytest.mark.parametrize("damage", ["cut", "changed", "another's"])
@pytest.mark.costly
def test_a_damaged_section_is_estimated_anew(drive, short, tmp_path, monkeypatch, damage):
    first = estimate(drive, tmp_path)
    one, other = sorted(tmp_path.iterdir())[:2]
    text = one.read_text()
    texts = {
        "cut": text[:-9],
        "changed": text.replace('"residual": ', '"residual": 1'),
        "another's": other.read_text(),
    }
    one.write_text(texts[damage])
    calls = interrupt_after(monkeypatch, 1)
    assert_equal(estimate(drive, tmp_path), first)
    assert len(calls) == 1 and one.read_text() == text


@pytest.mark.costly
def test_a_stopped_report_says_what_is_kept_and_the_next_one_removes_it(
    short, tmp_path, monkeypatch, capsys
):
    path, out = tmp_path / "drive.zip", tmp_path / "out"
    path.write_bytes(phyphox(phone(Rotation.random(random_state=1), duration=10.0, speed=6.0)))
    given = {"drives": [path], "out": out, "options": DriveOptions(vehicle="saloon")}
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt, match="the same command"):
        interrupt_after(patch, 1)
        report(**given)
    assert [x.name for x in out.iterdir()] == [KEPT]
    report(**given)
    assert ": 1 of 3 sections" in capsys.readouterr().err
    assert (out / "index.html").exists() and not (out / KEPT).exists()
