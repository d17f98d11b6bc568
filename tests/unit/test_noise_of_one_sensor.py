"""One sensor does not tell noise from road: the descent ends at the noise of the instrument."""

from dataclasses import replace

import pytest

from estimators.map_smoother.gauss_newton import GaussNewton, minimize
from estimators.map_smoother.preparation import SolverSettings
from estimators.map_smoother.windows import whole_objective
from road_envs.drives.logger_tables.description import PLACES
from road_envs.drives.recording import simulate_record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle

LENGTH = 200.0
HUMPS = [
    {"shape": "half_sine", "at": 60.0, "length": 3.7, "height": 0.06},
    {"shape": "half_sine", "at": 140.0, "length": 0.9, "height": 0.06},
]
ROAD = {
    "kind": "superposed",
    "roads": [
        {"kind": "iso8608", "road_class": "A", "length": LENGTH},
        {"kind": "defects", "length": LENGTH, "defects": HUMPS},
    ],
}


def one_phone():
    phones = replace(load_instruments("phone"), accelerometers={"PHONE": PLACES["dashboard"]})
    car, settings = load_vehicle("jeep_cherokee"), SolverSettings(instruments="phone")
    record, _ = simulate_record(ROAD, speed_kmh=100.0, vehicle=car, instruments=phones, seed=102)
    objective = whole_objective(settings.prepare(record, car)[0], settings.road_prior)
    return minimize(objective, GaussNewton(settings.huber))


@pytest.mark.costly
def test_the_record_of_one_sensor_is_explained_to_its_noise_behind_humps_on_a_smooth_road():
    solution = one_phone()
    (one,) = solution.linearization.passes
    # 1.4 to 2.3 by the kernels of the linear algebra: descents from level end apart
    assert (one.source.information * one.residual**2).mean() < 2.5**2
    assert solution.linearization.objective.is_underdetermined


def test_three_sensors_tell_noise_from_two_wheel_paths():
    drive, _ = SolverSettings(instruments="phone").prepare(
        simulate_record("iso_b", speed_kmh=50.0, instruments="phone", length=20.0)[0],
        load_vehicle("land_rover_defender_110"),
    )
    objective = whole_objective(drive, SolverSettings().road_prior)
    assert not objective.is_underdetermined
