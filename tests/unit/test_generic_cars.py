"""Generic cars: their natural frequencies when scaled, their tolerances, and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from estimators import estimate
from road_envs import simulate_record
from road_envs.core.config import ConfigError
from road_envs.vehicle.generic_cars import CLASSES, fitted_vehicle, with_class_tolerances
from road_envs.vehicle.linear_model import linearise
from road_envs.vehicle.natural_modes import natural_modes
from road_envs.vehicle.parameters import load_vehicle, write_vehicle
from road_envs.vehicle.tolerances import parameter_space

OWN = (1500.0, 2.7, 1.55)


def frequencies(car):
    """Return the natural frequencies (7,) [Hz] of a car that slides, struts as springs."""
    return np.sort(natural_modes(linearise(car.sliding, "passive", {})).f)


@pytest.mark.parametrize("name", CLASSES)
def test_a_scaled_car_has_the_frequencies_of_its_class(name):
    base, car = load_vehicle(name), fitted_vehicle("mine", name, *OWN)
    assert car.m_b + car.front.m + car.rear.m == pytest.approx(OWN[0])
    assert car.wheelbase == pytest.approx(OWN[1])
    assert car.front.y_t + car.rear.y_t == pytest.approx(OWN[2])
    np.testing.assert_allclose(frequencies(car), frequencies(base), rtol=2e-3)


@pytest.mark.parametrize("name", CLASSES)
def test_every_car_within_the_tolerances_can_be_built(name):
    space, rng = parameter_space(load_vehicle(name)), np.random.default_rng(1)
    for _ in range(20):
        hop = frequencies(space.draw(rng))
        assert 0.7 < hop[0] < 2.5
        assert 7.0 < hop[-1] < 25.0


def test_a_file_without_tolerances_gets_those_of_its_class(tmp_path):
    described = load_vehicle("bmw_320i")
    assert described.tolerances_of == ""
    bare = replace(described, tolerances={})
    path = tmp_path / "car.yaml"
    write_vehicle(path, bare)
    car = load_vehicle(path)
    assert car.tolerances_of in CLASSES
    assert car.tolerances == load_vehicle(car.tolerances_of).tolerances
    assert parameter_space(car).size > 20
    # without side motion it cannot be uncertain in it; without an anti-roll bar in that
    plain = replace(bare.sliding, rear=replace(bare.rear, k_roll=0.0))
    lent = with_class_tolerances(plain)
    assert not [path for path in lent.tolerances if path.startswith("side") or "rear.k_r" in path]
    assert with_class_tolerances(described) is described
    paper = replace(load_vehicle("land_rover_defender_110"), tolerances={})
    assert with_class_tolerances(paper) is paper


def test_a_written_car_is_read_back(tmp_path):
    car, path = fitted_vehicle("mine", "saloon", *OWN), tmp_path / "mine.yaml"
    write_vehicle(path, car, "A car.")
    assert load_vehicle(path) == car


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (("lorry", 1500.0, 2.7, 1.55), "compact, saloon, suv, van"),
        (("saloon", 15.0, 2.7, 1.55), r"mass of 15 kg is that of no saloon: 960 to 2720 kg"),
        (("saloon", 1500.0, 270.0, 1.55), r"wheelbase of 270 m .*2\.1 to 3\.78 m"),
        (("saloon", 1500.0, 2.7, 0.75), r"track of 0\.75 m .*choose another class"),
    ],
)
def test_what_no_car_of_the_class_has_is_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        fitted_vehicle("mine", *values)


def test_a_forward_control_van_is_a_van():
    own = load_vehicle("volkswagen_vanagon")
    mass, track = own.m_b + own.front.m + own.rear.m, own.front.y_t + own.rear.y_t
    assert fitted_vehicle("mine", "van", mass, own.wheelbase, track).wheelbase == own.wheelbase


@pytest.mark.costly
def test_an_estimate_says_that_side_motion_is_missing_where_a_car_has_none():
    car, paper = load_vehicle("bmw_320i"), load_vehicle("land_rover_defender_110")
    for described, said in ((car, False), (car.sliding, True), (paper, False)):
        record, _ = simulate_record("iso_c", speed_kmh=36.0, vehicle=described, length=20.0)
        notes = estimate("wiener", record, described).notes
        assert any("no side motion" in note for note in notes) == said


def test_an_estimate_says_that_tolerances_are_lent():
    bare = with_class_tolerances(replace(load_vehicle("bmw_320i"), tolerances={}))
    record, _ = simulate_record("iso_c", speed_kmh=36.0, vehicle=bare, length=20.0)
    notes = estimate("wiener", record, bare).notes
    assert any(f"those of the class {bare.tolerances_of} are assumed" in note for note in notes)
