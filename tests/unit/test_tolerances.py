"""Vehicle parameters as a vector in units of their tolerances."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_fixtures import DEFENDER

from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.sensing.perturbed_vehicle import load_plant_mismatch, perturb_vehicle
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.linear_model import gaussian_damping
from road_envs.vehicle.parameters import BendingMode, Tolerance, TorsionalFrame, load_vehicle
from road_envs.vehicle.tolerances import parameter_space, scale_parameters

SPACE, FLEXIBLE = parameter_space(DEFENDER), parameter_space(DEFENDER, structure=True)


@pytest.mark.parametrize("space", [SPACE, FLEXIBLE], ids=["given", "structure"])
def test_a_vector_and_its_vehicle_correspond(space):
    x = np.random.default_rng(1).standard_normal(space.size)
    np.testing.assert_allclose(space.to_vector(space.from_vector(x)), x, atol=1e-12)
    assert space.from_vector(np.zeros(space.size)) == space.car


def test_each_component_changes_its_parameter_by_its_tolerance_and_nothing_else():
    for i, name in enumerate(SPACE.names):
        unit = np.eye(SPACE.size)[i]
        ratio = np.exp(SPACE.std[i])
        assert SPACE.from_vector(unit) == scale_parameters(DEFENDER, {name: ratio})
        np.testing.assert_allclose(SPACE.to_vector(SPACE.from_vector(unit)), unit, atol=1e-12)


def test_a_scaled_parameter_acts_on_its_own_wheel_mass_or_curve():
    car = scale_parameters(
        DEFENDER, {"front.m": 1.1, "variation.tyre.RL": 0.9, "variation.damper.FR": 1.2}
    )
    nominal, changed = build_plant(DEFENDER).constants[0], build_plant(car).constants[0]
    np.testing.assert_allclose(changed["M"] / nominal["M"], [1, 1, 1, 1.1, 1, 1, 1])
    np.testing.assert_allclose(changed["k_t"] / nominal["k_t"], [1, 1, 0.9, 1])
    c = gaussian_damping(car, "ride", 1.0) / gaussian_damping(DEFENDER, "ride", 1.0)
    assert c[1] > 1.1 and np.allclose(c[[0, 2, 3]], 1.0)
    rough = scale_parameters(DEFENDER, {"strut.friction": 2.0})
    for mode in ("ride", "handling"):
        forces = (np.array(getattr(one.strut.friction, mode).F) for one in (rough, DEFENDER))
        np.testing.assert_allclose(*np.array([[1.0], [2.0]]) * np.array(list(forces)))


def test_drawn_vehicles_have_the_stated_deviations():
    rng = np.random.default_rng(2)
    x = np.array([SPACE.to_vector(SPACE.draw(rng)) for _ in range(150)])
    np.testing.assert_allclose(x.std(axis=0), 1.0, atol=0.25)
    np.testing.assert_allclose(x.mean(axis=0), 0.0, atol=0.35)


def test_the_tolerances_are_those_of_the_test_vehicles():
    mismatch = replace(load_plant_mismatch(), step=0.001)
    cars = [perturb_vehicle(DEFENDER, "S1", seed, mismatch).car for seed in range(150)]
    varied = [i for i, name in enumerate(SPACE.names) if "tyre" not in name]
    common = SPACE.names.index("strut.friction")  # drawn per strut, about a common factor
    x = np.array([SPACE.to_vector(car) for car in cars])
    friction = [i for i, name in enumerate(SPACE.names) if "variation.friction" in name]
    scale = np.log([1.2, 0.8]) / SPACE.std[friction[0]]
    nearest = np.abs(x[:, friction, None] - scale).argmin(axis=2)
    x[:, friction] -= scale[nearest]
    spread = np.sqrt(np.mean(x[:, [i for i in varied if i != common]] ** 2, axis=0))
    assert (spread > 0.75).all() and (spread < 1.25).all()


def test_structure_adds_what_the_description_leaves_out():
    car = FLEXIBLE.car
    assert car.variation.frame == TorsionalFrame(f=12.0, zeta=0.08)
    assert car.variation.bending == BendingMode(f=25.0, zeta=0.045, length=4.4)
    assert car.variation.roll_stiffness == (3000.0, 3000.0)
    assert car.variation.tyre_progression == 3.0
    added = set(FLEXIBLE.names) - set(SPACE.names)
    assert added == {
        *("variation.frame.f", "variation.frame.zeta", "variation.tyre_progression"),
        "variation.contact_length",
        *(f"variation.bending.{name}" for name in ("f", "zeta", "length")),
        *("variation.roll_stiffness.front", "variation.roll_stiffness.rear"),
    }
    assert parameter_space(FLEXIBLE.car).names == FLEXIBLE.names
    assert SPACE.car is DEFENDER


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("m_c", "unknown parameter 'm_c' of a tolerance"),
        ("variation.damper.XY", "unknown parameter 'variation.damper.XY'"),
        ("name", "'name' of a tolerance is neither a number nor a force curve"),
        ("front", "'front' of a tolerance is neither a number nor a force curve"),
        ("variation.tyre_progression", "no value to refer to: give"),
        (None, "names no tolerances"),
    ],
)
def test_an_invalid_tolerance_is_named_in_one_sentence(name, reason):
    given = {} if name is None else {name: Tolerance(relative=0.1, source="assumed")}
    with pytest.raises(ConfigError, match=reason):
        parameter_space(replace(DEFENDER, tolerances=given))


def test_a_vehicles_file_without_tolerances_is_the_same_vehicle(tmp_path):
    text = config.find("vehicles", "land_rover_defender_110").read_text(encoding="utf-8")
    (tmp_path / "car.yaml").write_text(text.partition("\ntolerances:")[0], encoding="utf-8")
    assert replace(DEFENDER, tolerances={}) == load_vehicle(tmp_path / "car.yaml")


def test_a_vector_beyond_the_range_of_a_value_is_no_vehicle():
    space = parameter_space(load_vehicle("bmw_320i"))
    x = np.zeros(space.size)
    x[space.names.index("side.swing_arm.front")] = -10.0
    with pytest.raises(ArithmeticError, match=r"a fitted vehicle is none: .*swing_arm"):
        space.from_vector(x)


def test_a_vector_whose_tyres_would_pull_at_first_contact_is_no_vehicle():
    x = np.zeros(FLEXIBLE.size)
    i = FLEXIBLE.names.index("variation.tyre_progression")
    value, limit = FLEXIBLE.car.variation.tyre_progression, 1.0 / max(DEFENDER.tyre_deflections)
    x[i] = np.log(0.99 * limit / value) / FLEXIBLE.std[i]
    assert FLEXIBLE.from_vector(x).variation.tyre_progression == pytest.approx(0.99 * limit)
    x[i] = np.log(1.01 * limit / value) / FLEXIBLE.std[i]
    with pytest.raises(ArithmeticError, match="a fitted vehicle is none: tyre_progression"):
        FLEXIBLE.from_vector(x)


@pytest.mark.parametrize("name", config.names("vehicles"))
def test_every_shipped_vehicle_says_what_its_frame_may_be(name):
    car = parameter_space(load_vehicle(name), structure=True).car
    assert car.variation.frame is not None
    assert car.variation.bending is not None
    assert car.variation.bending.length < 2.2 * car.wheelbase
