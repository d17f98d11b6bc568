"""Perturbed vehicles: what each grade draws, and records."""

from dataclasses import fields, replace

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from vehicle_fixtures import DEFENDER, smooth_road

from road_envs.core import config
from road_envs.core.config import ConfigError, build, read_yaml
from road_envs.drives.recording import simulate_record, true_profile
from road_envs.records.record import Record
from road_envs.roads.surface import Surface, enveloped
from road_envs.sensing.data_logger import DataLogger, load_instruments
from road_envs.sensing.perturbed_vehicle import (
    GRADES,
    PlantMismatch,
    load_plant_mismatch,
    perturb_vehicle,
)
from road_envs.sensing.sensor_faults import NO_FAULTS, SensorFaults
from road_envs.simulation.drive import APRON_LENGTH, DriveSimulator
from road_envs.simulation.rosenbrock import TWIST
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import encode_command

ROAD, ROUGH = smooth_road(length=20.0, height=0.01), smooth_road(height=0.03)
PAPER, IDEAL = load_instruments("paper"), load_instruments("ideal")
ASSUMED = load_plant_mismatch()
DATA = read_yaml(config.find("field", "assumed"))
seeds = st.integers(0, 10**9)


def recorded_drive(grade="S0", seed=5, instruments=PAPER, road=ROAD, **options):
    return simulate_record(
        road, vehicle=DEFENDER, speed_kmh=54.0, mode="ride", instruments=instruments, seed=seed,
        grade=grade, **options,
    )  # fmt: skip


def equal_records(a: Record, b: Record) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Record))


# --- random deviations ----------------------------------------------------------------------------


def relative(vehicle):
    """Return masses and inertias of a perturbed vehicle relative to the nominal ones."""
    parts = [
        (vehicle.car, DEFENDER),
        (vehicle.car.front, DEFENDER.front),
        (vehicle.car.rear, DEFENDER.rear),
    ]
    masses = [parts[0][0].m_b / DEFENDER.m_b, *(a.m / b.m for a, b in parts[1:])]
    inertias = [a.I_xx / b.I_xx for a, b in parts] + [vehicle.car.I_yy / DEFENDER.I_yy]
    return np.array(masses), np.array(inertias)


def test_grade_s0_is_the_nominal_vehicle():
    vehicle = perturb_vehicle(DEFENDER, "S0", 3)
    assert vehicle.car is DEFENDER and vehicle.faults is NO_FAULTS
    assert vehicle.car.variation.contact_length == 0.0 and vehicle.step == np.inf
    for name, array in vars(build_plant(DEFENDER)).items():
        np.testing.assert_array_equal(getattr(vehicle.plant, name), array)


@given(seeds)
def test_manufacturing_deviations_stay_within_their_limits(seed):
    vehicle = perturb_vehicle(DEFENDER, "S1", seed)
    masses, inertias = relative(vehicle)
    for factors in (masses, inertias):
        assert ((np.abs(factors - 1.0) >= 0.03) & (np.abs(factors - 1.0) <= 0.10)).all()
    struts, mismatch = vehicle.car.variation, ASSUMED.manufacture
    for name in ("gas", "damper", "bushing"):
        factors, limits = np.array(getattr(struts, name)), getattr(mismatch, f"strut_{name}")
        assert (np.abs(factors - 1.0) <= limits).all() and len(set(factors)) == 4
    friction = np.array(struts.friction)
    near = [
        np.abs(friction / common - 1.0) <= mismatch.strut_friction + 1e-12 for common in (0.8, 1.2)
    ]
    assert near[0].all() or near[1].all()
    unchanged = ("x", "y_s", "y_t", "k_t", "c_t")
    assert all(getattr(vehicle.car.rear, k) == getattr(DEFENDER.rear, k) for k in unchanged)
    assert vehicle.car.strut == DEFENDER.strut and vehicle.step == ASSUMED.step
    assert (
        vehicle.faults is NO_FAULTS
        and vehicle.car.variation.frame is vehicle.car.variation.bending is None
        and vehicle.car.variation.contact_length == 0.0
    )


@given(seeds)
def test_every_grade_keeps_the_deviations_of_the_previous_grade(seed):
    s1, s2, s3, s4 = (perturb_vehicle(DEFENDER, grade, seed) for grade in GRADES[1:])
    assert s2.car == s3.car == s4.car.sliding and s3.faults == s4.faults
    assert s1.car == replace(s2.car, variation=s1.car.variation)
    for name in ("gas", "damper", "friction", "bushing"):
        assert getattr(s1.car.variation, name) == getattr(s2.car.variation, name)
    mismatch = ASSUMED.structure
    assert s3.car.variation.contact_length == mismatch.contact_length
    assert s1.car.variation.bending is None
    for name in ("frame", "bending"):
        mode, limits = getattr(s3.car.variation, name), getattr(mismatch, name)
        assert limits.f[0] <= mode.f <= limits.f[1]
        assert limits.zeta[0] <= mode.zeta <= limits.zeta[1]
    assert s2.car.variation.roll_stiffness == mismatch.roll_stiffness
    tyre = np.array(s2.car.variation.tyre)
    assert (np.abs(tyre - 1.0) <= mismatch.tyre_pressure * mismatch.tyre_pressure_effect).all()
    assert len(set(tyre)) == 4 and s2.car.variation.tyre_progression == mismatch.tyre_progression
    assert s1.faults is s2.faults is NO_FAULTS
    faults, limits = s3.faults, ASSUMED.instruments
    for name, limit in (("dx", limits.place), ("dy", limits.place), ("tilt", limits.tilt),
                        ("offset", limits.offset)):  # fmt: skip
        assert 0.0 < np.abs(getattr(faults, name)).max() <= limit
    assert 0.0 < np.abs(np.array(faults.gain) - 1.0).max() <= limits.gain
    assert 0.0 < abs(faults.speed) <= limits.speed
    for name in ("position_fix_length", "jitter", "dropout_rate", "dropout_length"):
        assert getattr(faults, name) == getattr(limits, name)


@given(seeds)
def test_position_noise_is_added_on_request_alone_and_changes_nothing_else(seed):
    plain, noisy = (perturb_vehicle(DEFENDER, "S3", seed, position_noise=x) for x in (False, True))
    low, high = ASSUMED.instruments.position_noise
    assert plain.faults.position_noise == 0.0 and low <= noisy.faults.position_noise <= high
    assert noisy.faults.position_correlation_time == ASSUMED.instruments.position_correlation_time
    assert replace(noisy.faults, position_noise=0.0) == plain.faults and noisy.car == plain.car
    with pytest.raises(ConfigError, match="position noise needs the position fixes of grade S3"):
        perturb_vehicle(DEFENDER, "S2", seed, position_noise=True)


@given(seeds)
def test_the_tyres_of_grade_s4_hold_the_body_sideways_within_published_ranges(seed):
    car, limits = perturb_vehicle(DEFENDER, "S4", seed).car, ASSUMED.side
    side = car.side
    assert side is not None and limits is not None
    low, high = limits.solid_roll_centre
    assert all(low <= h <= high for h in side.roll_centre)
    ratios = np.array(side.C_alpha) / car.tyre_loads
    assert (limits.C_alpha[0] <= ratios).all() and (ratios <= limits.C_alpha[1]).all()
    assert all(limits.relaxation[0] <= x <= limits.relaxation[1] for x in side.relaxation)
    assert abs(car.I_yy - car.I_xx) < side.I_zz < car.I_yy + car.I_xx


def test_grade_s4_scatters_the_side_motion_that_a_file_has():
    described = load_vehicle("bmw_320i")
    cars = [perturb_vehicle(described, "S4", seed).car for seed in range(200)]
    for name in ("I_zz", "roll_centre", "C_alpha", "relaxation", "swing_arm"):
        own = np.array([getattr(car.side, name) for car in cars])
        ratio = own / np.array(getattr(described.side, name))
        assert 0.7 <= ratio.min() < 0.73 and 1.27 < ratio.max() <= 1.3


def test_draws_cover_their_ranges_in_both_directions():
    cars = [perturb_vehicle(DEFENDER, "S3", seed) for seed in range(300)]
    masses = np.array([relative(vehicle)[0][0] for vehicle in cars])
    for side in (masses[masses > 1.0] - 1.0, 1.0 - masses[masses < 1.0]):
        assert 100 < side.size < 200 and side.min() < 0.035 and side.max() > 0.095
    speed = np.array([vehicle.faults.speed for vehicle in cars])
    assert (
        speed.min() < -0.9 * ASSUMED.instruments.speed
        and speed.max() > 0.9 * ASSUMED.instruments.speed
    )
    assert len({vehicle.faults.seed for vehicle in cars}) == 300
    for found, limits in (
        ([vehicle.car.variation.frame for vehicle in cars], ASSUMED.structure.frame),
        ([vehicle.car.variation.bending for vehicle in cars], ASSUMED.structure.bending),
    ):
        f = np.log([mode.f for mode in found])
        low, high = np.log(limits.f)
        assert f.min() < low + 0.03 and f.max() > high - 0.03  # uniform in the logarithm
        assert f.mean() == pytest.approx(0.5 * (low + high), abs=0.06)


def test_a_seed_is_reproducible_and_its_sequence_is_not_modified():
    once, again, other = (perturb_vehicle(DEFENDER, "S3", seed) for seed in (7, 7, 8))
    assert once == again and once != other
    sequence = np.random.SeedSequence([7, 1])
    vehicle = perturb_vehicle(DEFENDER, "S3", sequence)
    assert sequence.n_children_spawned == 0 and vehicle == perturb_vehicle(DEFENDER, "S3", sequence)
    assert vehicle != perturb_vehicle(DEFENDER, "S3", np.random.SeedSequence([7, 2]))
    assert once == perturb_vehicle(DEFENDER, "S3", np.random.SeedSequence(7))
    children = np.random.SeedSequence(7).spawn(2)
    assert len({perturb_vehicle(DEFENDER, "S1", child).car.m_b for child in children}) == 2


ZERO_MISMATCH = replace(
    ASSUMED,
    step=0.001,
    manufacture=replace(
        ASSUMED.manufacture, mass=(0.0, 0.0), inertia=(0.0, 0.0), friction=(0.0, 0.0),
        strut_gas=0.0, strut_damper=0.0, strut_friction=0.0, strut_bushing=0.0,
    ),
    structure=replace(
        ASSUMED.structure, contact_length=0.0, tyre_progression=0.0, tyre_pressure=0.0,
        roll_stiffness=(0.0, 0.0), frame=None, bending=None,
    ),
    instruments=replace(
        ASSUMED.instruments, place=0.0, tilt=0.0, gain=0.0, offset=0.0, speed=0.0, jitter=0.0,
        dropout_rate=0.0, position_fix_length=np.inf,
    ),
    side=None,
)  # fmt: skip


def test_with_zero_mismatch_every_grade_equals_the_nominal_vehicle():
    plain, _ = recorded_drive()
    for grade in GRADES:
        assert equal_records(recorded_drive(grade, plant_mismatch=ZERO_MISMATCH)[0], plain), grade


# --- records --------------------------------------------------------------------------------------


def test_a_record_of_s0_equals_simulator_and_data_logger():
    record, profile = recorded_drive(seed=9)
    drive = DriveSimulator(build_plant(DEFENDER), DEFENDER, ROAD, 15.0)
    motion = drive.advance(np.full(drive.steps_left, encode_command("ride"), dtype=np.uint8))
    expected = DataLogger(PAPER, DEFENDER, 0.001, np.random.default_rng(9)).sample(motion)
    np.testing.assert_array_equal(record.a, expected)
    np.testing.assert_allclose(record.s, motion.s, atol=1e-12)
    assert (record.v == 15.0).all()
    np.testing.assert_array_equal(profile.z, true_profile(ROAD).z)


def test_a_record_of_s3_equals_simulator_and_faulty_data_logger():
    """The perturbed plant on the enveloped road, with finer steps and sensor faults."""
    mismatch = replace(ASSUMED, instruments=replace(ASSUMED.instruments, dropout_rate=0.05))
    record, profile = recorded_drive("S3", seed=11, plant_mismatch=mismatch)
    vehicle = perturb_vehicle(DEFENDER, "S3", 11, mismatch)
    point = replace(vehicle.car, variation=replace(vehicle.car.variation, contact_length=0.0))
    road = enveloped(ROAD, ASSUMED.structure.contact_length)
    car = DriveSimulator(vehicle.plant, point, road, 15.0, step=0.0005)
    motion = car.advance(np.full(car.steps_left, encode_command("ride"), dtype=np.uint8))
    logger = DataLogger(PAPER, vehicle.car, 0.0005, np.random.default_rng(11), vehicle.faults)
    expected = np.concatenate([logger.sample(motion), logger.flush()], axis=1)
    np.testing.assert_array_equal(record.a, expected)
    assert record.a.shape[1] == motion.t[::2].size and np.isnan(record.a).any()
    assert record.fs == pytest.approx(1000.0) and record.length == 20.0
    np.testing.assert_allclose(record.v, 15.0 * (1.0 + vehicle.faults.speed))
    s = -APRON_LENGTH + logger.odometer(15.0 * record.t)
    np.testing.assert_allclose(record.s, s, atol=1e-12)
    np.testing.assert_array_equal(profile.z, true_profile(ROAD).z)  # the truth is not enveloped


def test_each_grade_changes_the_record():
    records = {grade: recorded_drive(grade, instruments=IDEAL)[0] for grade in GRADES}
    s0, s1, s2 = (records[grade].a for grade in GRADES[:3])
    n = min(a.shape[1] for a in (s0, s1, s2))
    for a, b in ((s0, s1), (s1, s2)):
        difference = np.std(a[:, :n] - b[:, :n]) / np.std(s0)
        assert 0.02 < difference < 2.0
    assert not np.isnan(s2).any()
    assert equal_records(recorded_drive("S2")[0], recorded_drive("S2")[0])
    assert not equal_records(recorded_drive("S2", seed=1)[0], recorded_drive("S2", seed=2)[0])


def test_the_finer_of_requested_and_vehicle_step_is_used():
    coarse, requested = (
        recorded_drive("S1", instruments=IDEAL, step=h)[0] for h in (0.001, 0.0005)
    )
    assert equal_records(coarse, requested)
    assert not equal_records(requested, recorded_drive("S1", instruments=IDEAL, step=0.00025)[0])
    with pytest.raises(ConfigError, match="whole number of integrator steps"):
        recorded_drive("S1", plant_mismatch=replace(ASSUMED, step=0.0003))


def test_a_symmetric_road_rolls_every_vehicle_but_the_nominal_one():
    road = Surface(np.stack([ROAD.z[0], ROAD.z[0]]), ROAD.ds)
    for grade, still in zip(GRADES, (True, False, False, False, False), strict=True):
        vehicle = perturb_vehicle(DEFENDER, grade, 4)
        car = DriveSimulator(vehicle.plant, vehicle.car, road, 15.0)
        motion = car.advance(np.full(car.steps_left, encode_command("ride"), dtype=np.uint8))
        assert (motion.state[:, [1, 4, 6]] == 0.0).all() == still


@pytest.mark.costly
def test_a_perturbed_drive_matches_scipy_with_independent_equations():
    """Reference: Radau with the paper's equations, and enveloping by SciPy's spline."""
    vehicle, L = perturb_vehicle(DEFENDER, "S3", 21), ASSUMED.structure.contact_length
    half = 0.5 * L
    s = ROUGH.ds * np.arange(-20, ROUGH.z.shape[1] + 20)
    wide = np.pad(ROUGH.z, ((0, 0), (40, 40)), mode="edge")
    slope = np.gradient(wide, ROUGH.ds, axis=1)
    stations = ROUGH.ds * (np.arange(wide.shape[1]) - 40)
    area = CubicHermiteSpline(stations, wide, slope, axis=1).antiderivative()
    road = oracles.SplineRoad((area(s + half) - area(s - half)) / L, ROUGH.ds, float(s[0]))
    mode = {"front": "ride", "rear": "handling"}
    car = DriveSimulator(vehicle.plant, vehicle.car, ROUGH, 12.0, mode, step=0.0001)
    y_0, strut_state, t = car.state.copy(), car.strut_state.copy(), np.linspace(0.0, 0.8, 41)
    heights = road.wheel_inputs(car.start, DEFENDER.wheelbase, 0.0)[0]
    np.testing.assert_allclose(equilibrium(vehicle.plant, strut_state, heights), y_0, atol=1e-9)
    expected = oracles.trajectory(
        vehicle.car, strut_state, road, 12.0, -APRON_LENGTH, y_0, t, vehicle.car.variation,
        method="Radau", rtol=1e-5, atol=1e-8,
    )  # fmt: skip
    motion = car.advance(np.full(8001, encode_command(mode), dtype=np.uint8))
    rates = np.column_stack([motion.state[::200, 7:], motion.twist[::200, 1]]).T
    error = np.sqrt(np.mean((rates - expected[8:]) ** 2, axis=1))
    assert (error < 2e-3 * np.sqrt(np.mean(expected[8:] ** 2, axis=1))).all()
    assert motion.signals.shape[1] == 32 and np.abs(motion.signals[:, TWIST]).max() > 1e-4


# --- configuration --------------------------------------------------------------------------------


@pytest.mark.parametrize("grade", ["S9", "s1", "", None, 1])
def test_an_unknown_grade_raises_config_error_with_the_known_ones(grade):
    with pytest.raises(ConfigError, match=r"unknown grade .*known: S0, S1, S2, S3"):
        perturb_vehicle(DEFENDER, grade, 1)
    with pytest.raises(ConfigError, match="unknown grade"):
        recorded_drive(grade)


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        ("manufacture.mass", [0.1, 0.03], "mass: must be the smallest and the largest value"),
        ("manufacture.strut_gas", 1.0, "strut_gas: must be below 1, got 1.0"),
        ("manufacture.tyre", 0.1, "tyre: unknown key; known: friction, inertia, mass"),
        ("structure.contact_length", -0.1, "contact_length: must not be negative, got -0.1 m"),
        ("structure.tyre_pressure_effect", 20.0, "tyre_pressure times tyre_pressure_effect"),
        ("structure.frame.f", [0.0, 9.0], "frame.f.0: must be positive, got 0.0 Hz"),
        ("structure.bending.f", [30.0, 20.0], "bending.f: must be the smallest and the largest"),
        ("instruments.dropout_rate", 0.5, "dropout_rate: must be below 0.5"),
        (
            "instruments.dropout_length",
            2.5,
            "dropout_length: must be a whole number, got 2.5",
        ),
        ("instruments.offset", -1.0, "offset: must not be negative"),
        ("step", 0.1, "step: must be at most 0.01, got 0.1 s"),
    ],
)
def test_an_invalid_mismatch_setting_is_named_in_one_sentence(path, value, reason):
    data = {k: dict(v) if isinstance(v, dict) else v for k, v in DATA.items()}
    owner, *rest = path.split(".")
    if not rest:
        data[owner] = value
    elif len(rest) == 1:
        data[owner][rest[0]] = value
    else:
        data[owner][rest[0]] = {**data[owner][rest[0]], rest[1]: value}
    with pytest.raises(ConfigError) as caught:
        build(PlantMismatch, data, "field.yaml")
    assert str(caught.value).startswith("field.yaml: ") and reason in str(caught.value)
    assert "\n" not in str(caught.value)


@settings(max_examples=20)
@given(seeds)
def test_every_perturbed_vehicle_has_an_equilibrium_with_its_weight(seed):
    vehicle = perturb_vehicle(DEFENDER, "S3", seed)
    for mode in ("ride", "handling"):
        car = DriveSimulator(vehicle.plant, vehicle.car, ROAD, 15.0, mode)
        loads = car.advance(np.full(1, encode_command(mode), dtype=np.uint8)).tyre_load[0]
        weight = oracles.G * (vehicle.car.m_b + vehicle.car.front.m + vehicle.car.rear.m)
        assert loads.sum() == pytest.approx(weight, rel=1e-8) and (loads > 0.0).all()
    assert isinstance(vehicle.faults, SensorFaults)
