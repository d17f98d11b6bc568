"""Kept drives of foreign plants: all that tasks need are there, and are what the plants make."""

import dataclasses
import importlib.util
import sys

import numpy as np
import pytest

from leaderboard import kept_drives
from leaderboard.evaluation.tasks import load_task
from leaderboard.evaluation.test_data import simulate_drives
from leaderboard.kept_drives import drive_of_plant, kept_digest, kept_path
from road_envs.core.config import ConfigError
from road_envs.plants.commonroad_car import as_driven
from road_envs.roads import realise_road
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle
from studies.plant_records import PLACES, TASKS, needed

BOARD = [load_task(name) for name in TASKS]


@pytest.mark.parametrize("task", BOARD, ids=TASKS)
def test_every_drive_of_the_board_is_kept(task, monkeypatch):
    monkeypatch.setattr(kept_drives, "simulate_on_plant", None)
    for condition in task.conditions:
        (drive,) = simulate_drives(task, task.test, condition)
        assert drive.record.length == 100.0
        assert np.nanmedian(drive.record.v) == pytest.approx(condition.speed_kmh / 3.6, rel=0.02)
        assert len(drive.calibration) == len(task.calibration)
        for given, run in zip(drive.calibration, task.calibration, strict=True):
            assert given.record.length == run.length
            assert (given.profile is None) == (run.survey_std is None)


def test_no_file_is_kept_that_no_task_needs():
    stems = {
        kept_path(
            condition.plant, condition.car, road.realise(np.random.default_rng(seed)).name, v, seed
        )
        for condition, road, v, seed, _ in needed()
    }
    assert stems == set(kept_path("x", "x", "x", 1.0, 1).parent.glob("*.parquet"))
    assert sum(path.stat().st_size for path in stems) < 3e6


def test_a_drive_is_driven_over_the_road_of_its_seed():
    # the front axle's hop of a bump comes at its place: heave follows the mean path's slope
    condition = BOARD[0].conditions[0]
    (drive,) = simulate_drives(BOARD[0], BOARD[0].test, condition)
    other = realise_road("iso_c", drive.seed + 1, 100.0)
    record, truth = drive.record, drive.truth
    heave = np.interp(truth.s, record.s, record.a.mean(axis=0))
    curvature = [np.gradient(np.gradient(z.mean(axis=0))) for z in (truth.z, other.height(truth.s))]
    lags = [np.abs(np.correlate(heave, c, "full")).max() / np.std(c) for c in curvature]
    assert lags[0] > 1.5 * lags[1]


@pytest.mark.costly
def test_what_is_not_kept_is_driven_by_the_plant_or_refused(monkeypatch):
    surface, sensors = realise_road("iso_c", 1, 30.0), load_instruments("paper")
    drive = ("mujoco", "bmw_320i", surface, 36.0, 1, sensors)
    if importlib.util.find_spec("mujoco"):
        record, truth = drive_of_plant(*drive)
        assert record.length == 30.0 and np.ptp(truth.z) > 0.0
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigError, match=r"is not kept: .*pip install 'road-envs\[plants\]'"):
        drive_of_plant(*drive)


@pytest.mark.parametrize("changed", ["road", "hump", "length", "instruments"])
def test_another_road_of_the_same_name_or_other_instruments_are_not_those_of_a_kept_drive(
    changed, monkeypatch
):
    (given,) = simulate_drives(BOARD[0], BOARD[0].test, BOARD[0].conditions[0])
    length = 90.0 if changed == "length" else 100.0
    surface = realise_road("iso_b", given.seed, length)
    if changed == "road":
        surface = dataclasses.replace(surface, z=1.1 * surface.z)
        monkeypatch.setattr(kept_drives, "realise_road", lambda *_: surface)  # as drawn today
    if changed == "hump":  # of a file with the name and, at some stations, the heights of the road
        hump = np.clip(0.03 - 0.015 * np.abs(surface.s - 50.0), 0.0, None)
        surface = dataclasses.replace(surface, z=surface.z + hump)
    sensors = load_instruments("phone" if changed == "instruments" else "paper")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigError, match="is not kept"):
        drive_of_plant("mujoco", "bmw_320i", surface, 90.0, given.seed, sensors)


def test_a_kept_drive_of_a_car_that_has_changed_is_not_taken_but_for_its_tolerances(monkeypatch):
    (given,) = simulate_drives(BOARD[0], BOARD[0].test, BOARD[0].conditions[0])
    surface, car = realise_road("iso_b", given.seed, 100.0), load_vehicle("bmw_320i")
    drive = ("mujoco", "bmw_320i", surface, 90.0, given.seed, load_instruments("paper"))
    kept, _ = drive_of_plant(*drive)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for change, is_kept in (({"tolerances": {}}, True), ({"m_b": 1.05 * car.m_b}, False)):
        now = dataclasses.replace(car, **change)
        monkeypatch.setattr(kept_drives, "load_vehicle", lambda name, now=now: now)
        if is_kept:
            np.testing.assert_array_equal(drive_of_plant(*drive)[0].a, kept.a)
        else:
            with pytest.raises(ConfigError, match="is not kept"):
                drive_of_plant(*drive)


def test_the_described_car_is_that_of_the_condition():
    told = BOARD[0]
    cars = [told.vehicle_of(condition) for condition in told.conditions]
    assert cars[0] == load_vehicle("bmw_320i")
    assert cars[-1] == as_driven(load_vehicle("defender_110_coils"))
    other = dataclasses.replace(told.conditions[0], car="van")
    altered = dataclasses.replace(told, conditions=(other, *told.conditions[1:]))
    assert altered.digest != told.digest
    assert kept_digest("mujoco") != kept_digest("commonroad")


def test_a_kept_drive_is_what_the_plant_makes():
    pytest.importorskip("vehiclemodels", reason="needs the extra 'plants'")
    from road_envs.plants.driving import simulate_on_plant

    told = BOARD[0]
    condition = told.conditions[4]
    (drive,) = simulate_drives(told, told.test, condition)
    surface = realise_road("iso_b", drive.seed, 100.0)
    record, truth = simulate_on_plant(
        condition.plant, surface, speed_kmh=90.0, seed=drive.seed, vehicle=condition.car
    )
    np.testing.assert_allclose(drive.record.a, record.a, atol=0.51 * 10.0**-PLACES)
    np.testing.assert_array_equal(drive.truth.z, truth.z)
