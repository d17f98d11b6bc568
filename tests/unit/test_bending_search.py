"""The bending of a body: found by the spectrum of one sensor, and not where bodies are stiff."""

from dataclasses import replace

import pytest

from estimators.wiener.bending_search import with_bending
from road_envs.drives.places import PLACES
from road_envs.drives.recording import simulate_record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import BendingMode, load_vehicle

PHONE = replace(load_instruments("phone"), accelerometers={"PHONE": PLACES["dashboard"]})


def drive(bending, length=180.0):
    car = load_vehicle("saloon")
    bent = replace(car, variation=replace(car.variation, bending=bending))
    record, _ = simulate_record(
        "iso_b", speed_kmh=80.0, vehicle=bent, instruments=PHONE, length=length, seed=141
    )
    return record, car


@pytest.mark.parametrize("f", [17.0, 24.0])
def test_the_bending_of_a_body_is_found_at_its_frequency(f):
    record, car = drive(BendingMode(f=f, zeta=0.045, length=4.4))
    found = with_bending(record, car, "phone")
    assert found.variation.bending.f == pytest.approx(f, rel=0.05)


def test_a_stiff_body_or_a_short_drive_or_one_that_is_described_so_does_not_bend():
    mode = BendingMode(f=20.0, zeta=0.045, length=4.4)
    record, car = drive(None)
    assert with_bending(record, car, "phone") is car
    known = replace(car, variation=replace(car.variation, bending=mode))
    assert with_bending(record, known, "phone") is known
    short, car = drive(mode, length=60.0)
    assert with_bending(short, car, "phone") is car
