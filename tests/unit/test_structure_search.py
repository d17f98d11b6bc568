"""Bending and twist of a body: found by the spectrum of its sensors, and not where it is stiff."""

from dataclasses import replace

import pytest

from estimators.wiener.structure_search import with_bending, with_twist
from road_envs.drives.logger_tables.description import PLACES
from road_envs.drives.recording import simulate_record
from road_envs.records.accelerometers import Accelerometer
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import BendingMode, TorsionalFrame, load_vehicle

ONE = {"PHONE": PLACES["dashboard"]}
SIDES = {
    "L": Accelerometer(axle="front", ahead=-0.12, y=0.55),
    "R": Accelerometer(axle="front", ahead=-0.12, y=-0.55),
}


def drive(layout, length=180.0, **modes):
    car = load_vehicle("saloon")
    flexible = replace(car, variation=replace(car.variation, **modes))
    phones = replace(load_instruments("phone"), accelerometers=layout)
    record, _ = simulate_record(
        "iso_b", speed_kmh=80.0, vehicle=flexible, instruments=phones, length=length, seed=141
    )
    return record, car


@pytest.mark.parametrize("f", [17.0, 24.0])
def test_the_bending_of_a_body_is_found_at_its_frequency(f):
    record, car = drive(ONE, bending=BendingMode(f=f, zeta=0.045, length=4.4))
    found = with_bending(record, car, "phone")
    assert found.variation.bending.f == pytest.approx(f, rel=0.05)


def test_a_stiff_body_or_a_short_drive_or_one_that_is_described_so_does_not_bend():
    mode = BendingMode(f=20.0, zeta=0.045, length=4.4)
    record, car = drive(ONE)
    assert with_bending(record, car, "phone") is car
    known = replace(car, variation=replace(car.variation, bending=mode))
    assert with_bending(record, known, "phone") is known
    short, car = drive(ONE, length=60.0, bending=mode)
    assert with_bending(short, car, "phone") is car


@pytest.mark.parametrize("layout", [SIDES, load_instruments("phone").accelerometers])
@pytest.mark.parametrize("f", [8.5, 17.0])
@pytest.mark.costly
def test_the_twist_of_a_frame_is_found_by_sensors_on_both_sides(layout, f):
    record, car = drive(layout, frame=TorsionalFrame(f=f, zeta=0.06))
    found = with_twist(record, car, "phone")
    assert found.variation.frame.f == pytest.approx(f, rel=0.12)
    assert found.tolerances["variation.frame.f"].relative == 0.1


def test_no_frame_twists_that_is_stiff_or_described_or_not_felt():
    mode = TorsionalFrame(f=12.0, zeta=0.06)
    record, car = drive(SIDES, bending=BendingMode(f=18.0, zeta=0.045, length=4.4))
    assert with_twist(record, car, "phone") is car
    known = replace(car, variation=replace(car.variation, frame=mode))
    assert with_twist(record, known, "phone") is known
    record, car = drive(ONE, frame=mode)
    assert with_twist(record, car, "phone") is car
