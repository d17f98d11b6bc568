"""Calibration by identification: what is remembered, and how records are corrected."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from vehicle_fixtures import DEFENDER, smooth_road

from estimators import create
from estimators.api import Calibratable, CalibrationDrive, CalibrationError
from estimators.map_smoother import identification, identified_vehicle
from estimators.map_smoother.identified_vehicle import IdentifiedVehicle, _identify_once
from road_envs.core import config
from road_envs.drives.recording import simulate_record

OTHER = replace(DEFENDER, m_b=1.1 * DEFENDER.m_b)
FOUND = IdentifiedVehicle(car=OTHER, gain=(1.02, 0.98, 1.0), displacement=0.15)
WITH_A_MODEL = ("map_smoother", "kalman", "kalman_lag", "kalman_rts", "wiener", "iterated_wiener")


@pytest.fixture
def identified(tmp_path, monkeypatch):
    """An empty cache, and the calls of an identification that always finds FOUND."""
    calls = []
    monkeypatch.setattr(identified_vehicle, "cache_home", lambda: tmp_path)
    monkeypatch.setattr(
        identified_vehicle, "_identify", lambda *arguments: calls.append(arguments) or FOUND
    )
    return calls


def drive(seed=1):
    road = smooth_road(length=12.0, height=0.01)
    return CalibrationDrive(simulate_record(road, vehicle=DEFENDER, speed_kmh=30.0, seed=seed)[0])


def test_a_vehicle_is_identified_once_for_the_same_drives(identified, tmp_path):
    first, second = drive(), drive(2)
    assert _identify_once([first], DEFENDER, "paper") == FOUND
    assert _identify_once([first], DEFENDER, "paper") == FOUND and len(identified) == 1
    for drives, car, instruments in (
        ([second], DEFENDER, "paper"),
        ([first, second], DEFENDER, "paper"),
        ([first], OTHER, "paper"),
        ([first], DEFENDER, "ideal"),
        ([replace(first, record=replace(first.record, s=first.record.s + 0.1))], DEFENDER, "paper"),
    ):
        before = len(identified)
        _identify_once(drives, car, instruments)
        assert len(identified) == before + 1
    for path in (tmp_path / "identified_vehicle").iterdir():
        path.write_text("{", encoding="utf-8")
    assert _identify_once([first], DEFENDER, "paper") == FOUND and len(identified) == 7


def test_a_vehicle_is_identified_again_when_shipped_instruments_change(
    identified, tmp_path, monkeypatch
):
    shutil.copytree(config.folder(), tmp_path / "configs")
    monkeypatch.setattr(config, "folder", lambda: tmp_path / "configs")
    paper, one = tmp_path / "configs" / "sensors" / "paper.yaml", [drive()]
    text = paper.read_text()
    noise = text.replace("noise_density: 0.01", "noise_density: 0.02")
    first, last = re.findall(r"^  [RL][RF]: .*$", text, re.MULTILINE)[::2]
    order = text.replace(first, "?").replace(last, first).replace("?", last)
    for changed in (text, noise, order):
        paper.write_text(changed)
        for instruments in ("paper", "paper", str(paper)):
            _identify_once(one, DEFENDER, instruments)
    assert len({text, noise, order}) == len(identified) == 3


@pytest.mark.parametrize("name", WITH_A_MODEL)
@pytest.mark.costly
def test_every_estimator_with_a_model_uses_what_was_identified(identified, name):
    """As if it had been told that vehicle, with readings corrected by hand."""
    estimator, calibration = create(name), drive()
    assert isinstance(estimator, Calibratable)
    calibrated = estimator.calibrate([calibration], DEFENDER)
    assert estimator.identified is None and calibrated.identified == FOUND
    record = drive(3).record
    corrected = replace(
        record, a=record.a / np.array(FOUND.gain)[:, None], s=record.s + FOUND.displacement
    )
    told = estimator.estimate(corrected, replace(OTHER, tolerances={}))
    np.testing.assert_array_equal(calibrated.estimate(record, DEFENDER).z, told.z)


def test_an_identification_that_breaks_down_says_so(monkeypatch, tmp_path):
    def breaks(*arguments, **options):
        raise ArithmeticError("not finite")

    monkeypatch.setattr(identified_vehicle, "cache_home", lambda: tmp_path)
    monkeypatch.setattr(identification, "_parts", lambda *arguments: (drive(), drive()))
    monkeypatch.setattr(identification, "_identify", breaks)
    with pytest.raises(CalibrationError, match="no vehicle explains the drives: not finite"):
        create("map_smoother").calibrate([drive()], DEFENDER)
