"""Passive struts and independent wheels, against a vehicle written in the heights of its wheels."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from oracles_wheels import FourWheels, four_wheel_frequencies, quarter_car_frequencies
from vehicle_fixtures import DEFENDER, compute_accelerations, varied_plant

from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.roads.surface import Surface
from road_envs.sensing.perturbed_vehicle import perturb_vehicle
from road_envs.simulation.drive import APRON_LENGTH, simulate
from road_envs.vehicle.axles import IndependentWheels
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.linear_model import linearise, strut_forces
from road_envs.vehicle.natural_modes import natural_modes
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.struts import CoilSpring, _AirSpring
from road_envs.vehicle.suspension import encode_command, settled_strut_state
from road_envs.vehicle.tolerances import parameter_space

PASSIVE = [n for n in config.names("vehicles") if load_vehicle(n).is_passive]
BMW = load_vehicle("bmw_320i").sliding
AIR = _AirSpring(kind="air", A=0.012, x=0.16, n_p=1.3)
P_0 = 101325.0


def with_springs(car, front, rear):
    """Return the car with other springs."""
    strut = car.strut
    return replace(
        car,
        strut=replace(
            strut,
            front=replace(strut.front, spring=front),
            rear=replace(strut.rear, spring=rear),
        ),
    )


def without_losses(car):
    """Return the car with neither dampers nor friction nor tyre damping."""
    none = Curve(x=(-1.0, 1.0), F=(0.0, 0.0))
    struts = [replace(s, damper=none, friction=none) for s in (car.strut.front, car.strut.rear)]
    return replace(
        car,
        strut=replace(car.strut, front=struts[0], rear=struts[1]),
        front=replace(car.front, c_t=0.0),
        rear=replace(car.rear, c_t=0.0),
    )


def coil(load, k):
    """Return the force of a linear spring over extension."""
    return lambda e: load - k * e


def air(load, A, x, n):
    """Return the force of an air spring over extension, by the polytropic law of its pressure."""
    p = load / A + P_0
    return lambda e: A * (p * (x / (x + e)) ** n - P_0)


@pytest.mark.parametrize("name", PASSIVE)
def test_a_passive_car_rests_at_its_static_lengths(name):
    car = load_vehicle(name).sliding
    z = np.zeros(7)
    out = compute_accelerations(build_plant(car), settled_strut_state(0), z, z)
    assert np.abs(out).max() < 1e-9


def test_a_symmetric_car_of_independent_wheels_is_a_quarter_car():
    car = without_losses(BMW)
    axle = replace(car.front, x=1.3, k_roll=0.0)
    strut = replace(car.strut, rear=car.strut.front)
    m_b = 1000.0
    car = replace(
        car, m_b=m_b, I_yy=m_b * 1.3**2, I_xx=m_b * axle.y_t**2,
        front=axle, rear=replace(axle, x=-1.3), strut=strut,
    )  # fmt: skip
    low, high = quarter_car_frequencies(0.25 * m_b, 0.5 * axle.m, 24445.0, axle.k_t)
    f = natural_modes(linearise(car, "passive", {})).f
    # the wheels' warp, front against rear, does not move the body
    warp = np.sqrt((24445.0 + axle.k_t) / (0.5 * axle.m)) / (2.0 * np.pi)
    np.testing.assert_allclose(f, [low] * 3 + [warp] + [high] * 3, rtol=1e-9)


def test_natural_frequencies_are_those_of_four_wheels_with_bars():
    car = without_losses(BMW)
    f = natural_modes(linearise(car, "passive", {})).f
    np.testing.assert_allclose(f, four_wheel_frequencies(car, (24445.0, 19629.0)), rtol=1e-9)
    rollless = replace(
        car, front=replace(car.front, k_roll=0.0), rear=replace(car.rear, k_roll=0.0)
    )
    assert natural_modes(linearise(rollless, "passive", {})).f.max() < f.max()


@pytest.mark.parametrize("springs", ["coil", "air"])
@pytest.mark.costly
def test_a_drive_is_that_of_four_wheels(springs):
    loads = BMW.strut_loads
    if springs == "coil":
        car, laws = BMW, [coil(loads[0], 24445.0), coil(loads[1], 19629.0)]
    else:
        car = with_springs(BMW, AIR, CoilSpring(k=19629.0))
        laws = [air(loads[0], 0.012, 0.16, 1.3), coil(loads[1], 19629.0)]
    ds, v, h = 0.02, 8.0, 2.5e-4
    s = ds * np.arange(round(8.0 / ds) + 1)
    bump = np.where((s > 1.0) & (s < 2.6), 0.5 - 0.5 * np.cos(2.0 * np.pi * (s - 1.0) / 1.6), 0.0)
    surface = Surface(np.array([0.05, 0.03])[:, None] * bump, ds)
    motion = simulate(car, surface, v, "passive", h)

    def road(t):
        front = v * t - APRON_LENGTH
        z, w = np.zeros(4), np.zeros(4)
        for k, at in enumerate((front, front, front - car.wheelbase, front - car.wheelbase)):
            if 1.0 < at < 2.6:
                phase, height = 2.0 * np.pi * (at - 1.0) / 1.6, (0.05, 0.03)[k % 2]
                z[k] = height * (0.5 - 0.5 * np.cos(phase))
                w[k] = v * height * 0.5 * np.sin(phase) * 2.0 * np.pi / 1.6
        return z, w

    part = slice(0, round(1.4 / h), 40)  # the rear wheels leave the bump at 1.2 s
    theirs = FourWheels(car, laws).drive(road, motion.t[part])
    ours = motion.state[part].T
    wheels = np.array(
        [
            ours[a] + sign * y * ours[a + 1]
            for a, y in ((3, car.front.y_t), (5, car.rear.y_t))
            for sign in (1, -1)
        ]
    )
    for mine, oracle in ((ours[:3], theirs[:3]), (wheels, theirs[3:7])):
        error = np.abs(mine - oracle).max(axis=1) / np.abs(oracle).max(axis=1)
        assert error.max() < 1e-4, error


def test_the_rate_of_an_air_spring_is_n_p_a_over_its_column():
    load, e = 3000.0, np.array([-0.05, -1e-6, 0.0, 1e-6, 0.06])
    F, slope = AIR.force(e, load)
    assert F[2] == pytest.approx(load)
    assert -slope[2] == pytest.approx(1.3 * (load + P_0 * 0.012) / 0.16)
    np.testing.assert_allclose(F, air(load, 0.012, 0.16, 1.3)(e), rtol=1e-12)
    np.testing.assert_allclose(slope[2], (F[3] - F[1]) / 2e-6, rtol=1e-6)
    beyond, at_limit = AIR.force(np.array([-0.14, -0.128]), load)[0]
    assert beyond - at_limit == pytest.approx(-AIR.force(np.array([-0.128]), load)[1][0] * 0.012)


def test_a_motion_ratio_acts_once_on_forces_and_once_on_lengths():
    r, strut = 0.6, BMW.strut
    front = replace(strut.front, motion_ratio=r, bushing=Curve(x=(-0.2, 0.2), F=(-100.0, 100.0)))
    car = replace(BMW, strut=replace(strut, front=front))
    e, e_dot = np.full((4, 1), -0.03), np.full((4, 1), 0.4)
    F = strut_forces(car, "passive", e, e_dot)[:, 0]
    spring = car.strut_loads[0] + 24445.0 * 0.03 * r * r
    losses = front.damper(np.array(r * 0.4))[0] + front.friction(np.array(r * 0.4))[0]
    assert F[0] == pytest.approx(spring - r * losses + r * r * 500.0 * 0.03, rel=1e-4)
    assert F[2] == pytest.approx(
        BMW.strut_loads[1] + 19629.0 * 0.03 - strut.rear.damper(np.array(0.4))[0] - 50.0, rel=1e-3
    )


def test_a_variation_scales_spring_damper_and_friction_of_each_wheel():
    variation = replace(
        BMW.variation, gas=(1.1, 1.0, 1.0, 0.9), damper=(1.0, 1.2, 1.0, 1.0),
        friction=(1.0, 1.0, 1.5, 1.0),
    )  # fmt: skip
    e, still, moving = np.full((4, 1), 0.02), np.zeros((4, 1)), np.full((4, 1), 1.0)
    nominal, one = build_plant(BMW), varied_plant(BMW, variation)
    plants = nominal, one
    spring = [strut_forces(p, "passive", e, still)[:, 0] for p in plants]
    np.testing.assert_allclose(spring[1] / spring[0], [1.1, 1.0, 1.0, 0.9], rtol=1e-9)
    rebound = [
        s - strut_forces(p, "passive", e, moving)[:, 0]
        for s, p in zip(spring, (nominal, one), strict=True)
    ]
    np.testing.assert_allclose(
        rebound[1] - rebound[0], [0.0, 0.2 * 1625.0, 0.5 * 50.0, 0.0], atol=1e-6
    )


def test_every_command_leaves_a_passive_strut_as_it_is():
    plant, rng = build_plant(BMW), np.random.default_rng(1)
    q, v = 0.02 * rng.standard_normal(7), rng.standard_normal(7)
    first = compute_accelerations(plant, settled_strut_state(0), q, v)
    for byte in (0xFF, 0x0F, 0xA5):
        np.testing.assert_array_equal(
            compute_accelerations(plant, settled_strut_state(byte), q, v), first
        )


def test_a_passive_car_has_the_mode_passive_and_no_other():
    assert encode_command(None, BMW) == encode_command("passive", BMW) == 0
    assert encode_command({"front": "passive", "rear": "passive"}, BMW) == 0
    message = "the car bmw_320i has passive struts: mode passive, not 'ride'"
    for mode in ("ride", {"front": "passive", "rear": "ride"}):
        with pytest.raises(ConfigError, match=message):
            encode_command(mode, BMW)
    with pytest.raises(
        ConfigError, match=r"has 4S4 struts: mode ride, handling, soft_high, .*, not 'passive'"
    ):
        encode_command("passive", DEFENDER)
    with pytest.raises(ConfigError, match=message):
        linearise(BMW, "ride", {})


RANGES = {"bounce": (1.0, 2.0), "pitch": (1.0, 2.0), "roll": (1.0, 2.5), "hop": (9.0, 15.0)}
"""Frequencies [Hz] of passenger cars (Gillespie 1992, chapter 5: body about 1 to 1.5 Hz, axles 10
to 15 Hz); those of heavy solid axles are lower, 7 to 11 Hz."""


TRAMPS = ("defender_110_coils",)
"""Cars with the masses, tyres and axles of the paper's, whose axles roll at 15 Hz."""


@pytest.mark.parametrize("name", PASSIVE)
def test_shipped_cars_have_the_frequencies_and_damping_of_their_kind(name):
    car = load_vehicle(name).sliding
    damping = np.array([5000.0] * 4)  # plays no part in undamped frequencies
    modes = natural_modes(linearise(car, "passive", {}, damping=damping))
    for mode, f in zip(modes.names, modes.f, strict=True):
        kind = mode if mode in RANGES else "hop"
        low, high = RANGES[kind]
        axle = car.front if mode.startswith("front") else car.rear
        if kind == "hop" and not isinstance(axle, IndependentWheels):
            low, high = (12.0, 16.0) if mode.endswith("roll") and name in TRAMPS else (7.0, 11.0)
        assert low <= f <= high, (mode, f)
    for load, strut in zip(car.strut_loads, (car.strut.front, car.strut.rear), strict=True):
        critical = 2.0 * np.sqrt(strut.spring.k * load / 9.81)
        v = 0.2
        mean = 0.5 * (strut.damper(np.array(v))[0] - strut.damper(np.array(-v))[0]) / v
        assert 0.2 <= mean / critical <= 0.8, mean / critical


def test_a_manufactured_car_has_the_inertia_that_follows_from_its_wheels():
    for seed in (1, 2):
        one = perturb_vehicle(BMW, "S3", seed).car
        for axle, nominal in zip(one.axles, BMW.axles, strict=True):
            assert axle.I_xx == pytest.approx(axle.m * axle.y_t**2) and axle.m != nominal.m
        assert one.variation.frame is not None and np.isfinite(build_plant(one).velocity).all()
    with pytest.raises(ConfigError, match=r"bmw_320i: unknown parameter 'front\.I_xx'"):
        parameter_space(replace(BMW, tolerances={"front.I_xx": BMW.tolerances["m_b"]}))


def test_the_inertia_of_independent_wheels_is_that_of_the_published_car():
    for name, published in (
        ("bmw_320i", (30.673, 29.670)),
        ("volkswagen_vanagon", (50.277, 48.349)),
    ):
        car = load_vehicle(name)  # IXUF, IXUR of DOT HS 807 956 in kg m²
        assert [a.I_xx for a in car.axles] == pytest.approx(published, rel=1e-3)


DATA, DEFENDER_DATA = (
    config.read_yaml(config.find("vehicles", name))
    for name in ("bmw_320i", "land_rover_defender_110")
)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("front.I_xx", 30.0, "front.I_xx: unknown key"),
        ("front.kind", None, "front: unknown kind 'None'; known: solid, independent"),
        ("front.kind", "rigid", "front: unknown kind 'rigid'; known: solid, independent"),
        ("front.m", -1.0, "front.m: must be positive, got -1.0 kg (unsprung mass, both wheels"),
        ("strut.kind", "active", "strut: unknown kind 'active'; known: 4s4, passive"),
        ("strut.rear", 1.0, "strut.rear: must be a mapping of keys to values, got 1.0"),
        ("strut.rear.spring.kind", "air", "strut.rear.spring.k: unknown key; known: A, kind, n_p"),
        ("strut.rear.spring.k", 0.0, "strut.rear.spring.k: must be positive, got 0.0 N/m (rate)"),
        ("valve", DEFENDER_DATA["valve"], "passive struts have no valve"),
    ],
)
def test_an_invalid_passive_car_is_refused_in_one_sentence(path, value, message):
    data = copy.deepcopy(DATA)
    *parents, last = path.split(".")
    owner = data
    for key in parents:
        owner = owner[key]
    owner[last] = value
    with pytest.raises(ConfigError) as caught:
        config.build(VehicleParameters, data, "car.yaml")
    assert str(caught.value).startswith("car.yaml: ") and "\n" not in str(caught.value)
    assert message in str(caught.value)


def test_switched_struts_need_a_valve():
    data = {key: value for key, value in DEFENDER_DATA.items() if key != "valve"}
    with pytest.raises(ConfigError, match="4S4 struts need the key valve"):
        config.build(VehicleParameters, data, "car.yaml")
