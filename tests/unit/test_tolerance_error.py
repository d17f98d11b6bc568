"""What the tolerances of a vehicle leave open of a road's roughness."""

from dataclasses import replace

import pytest

from estimators.roughness.tolerance_error import roughness_std
from leaderboard.drive_report.mean_path import golden_weight
from road_envs.drives.logger_tables.description import PLACES
from road_envs.drives.recording import simulate_record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import Tolerance, load_vehicle

PHONE = replace(load_instruments("phone"), accelerometers={"PHONE": PLACES["dashboard"]})


def record_of(road, speed_kmh):
    record, _ = simulate_record(
        road, speed_kmh=speed_kmh, vehicle="bmw_320i", instruments=PHONE, length=150.0, seed=5
    )
    return record


@pytest.mark.costly
def test_friction_leaves_more_open_on_smooth_roads_and_a_known_car_nothing():
    car = load_vehicle("bmw_320i")
    slow, fast = record_of("iso_a", 50.0), record_of("iso_c", 70.0)
    smooth, rough = (roughness_std(record, car, "phone", golden_weight) for record in (slow, fast))
    assert smooth > 1.4 * rough > 0.05
    assert roughness_std(slow, replace(car, tolerances={}), "phone", golden_weight) == 0.0


@pytest.mark.costly
def test_a_tenth_of_a_tolerance_leaves_a_tenth_of_the_error():
    car, record = load_vehicle("bmw_320i"), record_of("iso_c", 70.0)
    mass = [{"m_b": Tolerance(relative=x, source="a test")} for x in (0.1, 0.01)]
    wide, narrow = (
        roughness_std(record, replace(car, tolerances=x), "phone", golden_weight) for x in mass
    )
    assert 0.02 < wide < 0.12
    assert narrow == pytest.approx(0.1 * wide, rel=0.1)
