"""The field car: what each grade draws, what its tyres feel, and its records."""

from dataclasses import fields, replace

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import CubicHermiteSpline
from vehicle_fixtures import DEFENDER, smooth_road

from road_envs import config
from road_envs.config import ConfigError, build, read_yaml
from road_envs.data.record import Record
from road_envs.data.recording import simulate_record, true_profile
from road_envs.roads.surface import Surface, enveloped
from road_envs.sensing.data_logger import DataLogger, load_instruments
from road_envs.sensing.sensor_faults import NO_FAULTS, SensorFaults
from road_envs.simulation.drive import APRON_LENGTH, DriveSimulator
from road_envs.simulation.rosenbrock import TWIST
from road_envs.vehicle.equations import build_plant, equilibrium
from road_envs.vehicle.parameters import NOMINAL
from road_envs.vehicle.perturbed_vehicle import (
    GRADES,
    PlantMismatch,
    load_plant_mismatch,
    perturb_vehicle,
)
from road_envs.vehicle.suspension import encode_command

ROAD, ROUGH = smooth_road(length=20.0, height=0.01), smooth_road(height=0.03)
PAPER, IDEAL = load_instruments("paper"), load_instruments("ideal")
BY = load_plant_mismatch()
DATA = read_yaml(config.find("field", "assumed"))
seeds = st.integers(0, 10**9)


def drive(grade="S0", seed=5, instruments=PAPER, road=ROAD, **options):
    return simulate_record(
        DEFENDER, road, speed_kmh=54.0, mode="ride", instruments=instruments, seed=seed,
        grade=grade, **options,
    )  # fmt: skip


def same(one: Record, other: Record) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Record))


# --- the individual -------------------------------------------------------------------------------


def relative(one):
    """Masses; inertias of an individual over the described ones."""
    parts = [(one.car, DEFENDER), (one.car.front, DEFENDER.front), (one.car.rear, DEFENDER.rear)]
    masses = [parts[0][0].m_b / DEFENDER.m_b, *(a.m / b.m for a, b in parts[1:])]
    inertias = [a.I_xx / b.I_xx for a, b in parts] + [one.car.I_yy / DEFENDER.I_yy]
    return np.array(masses), np.array(inertias)


def test_the_first_grade_is_the_training_car_and_nothing_else():
    one = perturb_vehicle(DEFENDER, "S0", 3)
    assert one.car is DEFENDER and one.variation is NOMINAL and one.faults is NO_FAULTS
    assert one.enveloped(ROAD) is ROAD and one.step == np.inf
    for a, b in zip(one.plant.arrays, build_plant(DEFENDER).arrays, strict=True):
        np.testing.assert_array_equal(a, b)


@given(seeds)
def test_what_is_manufactured_lies_within_the_stated_departures(seed):
    one = perturb_vehicle(DEFENDER, "S1", seed)
    masses, inertias = relative(one)
    for factors in (masses, inertias):
        assert ((np.abs(factors - 1.0) >= 0.03) & (np.abs(factors - 1.0) <= 0.10)).all()
    struts, by = one.variation, BY.manufacture
    for name in ("gas", "damper", "bushing"):
        factors, most = np.array(getattr(struts, name)), getattr(by, f"strut_{name}")
        assert (np.abs(factors - 1.0) <= most).all() and len(set(factors)) == 4
    friction = np.array(struts.friction)
    near = [np.abs(friction / common - 1.0) <= by.strut_friction + 1e-12 for common in (0.8, 1.2)]
    assert near[0].all() or near[1].all()
    kept = ("x", "y_s", "y_t", "k_t", "c_t")
    assert all(getattr(one.car.rear, k) == getattr(DEFENDER.rear, k) for k in kept)
    assert one.car.strut == DEFENDER.strut and one.step == BY.step
    assert one.faults is NO_FAULTS and one.variation.frame is None and one.contact_length == 0.0


@given(seeds)
def test_every_grade_has_the_individual_of_the_grade_before(seed):
    s1, s2, s3 = (perturb_vehicle(DEFENDER, grade, seed) for grade in GRADES[1:])
    assert s1.car == s2.car == s3.car and s2.variation == s3.variation
    for name in ("gas", "damper", "friction", "bushing"):
        assert getattr(s1.variation, name) == getattr(s2.variation, name)
    by = BY.structure
    assert s3.contact_length == by.contact_length and s3.variation.frame == by.frame
    assert s2.variation.roll_stiffness == by.roll_stiffness
    tyre = np.array(s2.variation.tyre)
    assert (np.abs(tyre - 1.0) <= by.tyre_pressure * by.tyre_pressure_effect).all()
    assert len(set(tyre)) == 4 and s2.variation.tyre_progression == by.tyre_progression
    assert s1.faults is s2.faults is NO_FAULTS
    wrong, most = s3.faults, BY.instruments
    for name, limit in (("ahead", most.place), ("left", most.place), ("tilt", most.tilt),
                        ("offset", most.offset)):  # fmt: skip
        assert 0.0 < np.abs(getattr(wrong, name)).max() <= limit
    assert 0.0 < np.abs(np.array(wrong.gain) - 1.0).max() <= most.gain
    assert 0.0 < abs(wrong.speed) <= most.speed
    assert (wrong.position_fix_length, wrong.jitter, wrong.dropout_rate, wrong.dropout_length) == (
        most.position_fix_length, most.jitter, most.dropout_rate, most.dropout_length,
    )  # fmt: skip


def test_draws_fill_their_ranges_on_both_sides():
    cars = [perturb_vehicle(DEFENDER, "S3", seed) for seed in range(300)]
    masses = np.array([relative(one)[0][0] for one in cars])
    for side in (masses[masses > 1.0] - 1.0, 1.0 - masses[masses < 1.0]):
        assert 100 < side.size < 200 and side.min() < 0.035 and side.max() > 0.095
    speed = np.array([one.faults.speed for one in cars])
    assert speed.min() < -0.9 * BY.instruments.speed and speed.max() > 0.9 * BY.instruments.speed
    assert len({one.faults.seed for one in cars}) == 300


def test_a_seed_is_one_individual_and_its_sequence_is_left_as_it_was():
    once, again, other = (perturb_vehicle(DEFENDER, "S3", seed) for seed in (7, 7, 8))
    assert once == again and once != other
    sequence = np.random.SeedSequence([7, 1])
    one = perturb_vehicle(DEFENDER, "S3", sequence)
    assert sequence.n_children_spawned == 0 and one == perturb_vehicle(DEFENDER, "S3", sequence)
    assert one != perturb_vehicle(DEFENDER, "S3", np.random.SeedSequence([7, 2]))
    assert once == perturb_vehicle(DEFENDER, "S3", np.random.SeedSequence(7))
    children = np.random.SeedSequence(7).spawn(2)
    assert len({perturb_vehicle(DEFENDER, "S1", child).car.m_b for child in children}) == 2


NOTHING = replace(
    BY,
    step=0.001,
    manufacture=replace(
        BY.manufacture, mass=(0.0, 0.0), inertia=(0.0, 0.0), friction=(0.0, 0.0), strut_gas=0.0,
        strut_damper=0.0, strut_friction=0.0, strut_bushing=0.0,
    ),
    structure=replace(
        BY.structure, contact_length=0.0, tyre_progression=0.0, tyre_pressure=0.0,
        roll_stiffness=(0.0, 0.0), frame=None,
    ),
    instruments=replace(
        BY.instruments, place=0.0, tilt=0.0, gain=0.0, offset=0.0, speed=0.0, jitter=0.0, dropout_rate=0.0,
        position_fix_length=np.inf,
    ),
)  # fmt: skip


def test_without_departures_every_grade_is_the_training_car_to_the_bit():
    plain, _ = drive()
    for grade in GRADES:
        assert same(drive(grade, plant_mismatch=NOTHING)[0], plain), grade


# --- what the tyres feel --------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0.2, 1.0, 2.5, 4.0, 5.0, 8.0])
def test_a_sine_is_enveloped_by_the_sinc_of_its_patch(n):
    ds, L = 0.002, 0.2
    s = ds * np.arange(4001)
    z = 0.01 * np.stack([np.sin(2.0 * np.pi * n * s), np.cos(2.0 * np.pi * n * s)])
    felt = enveloped(Surface(z, ds), L)
    gain = np.sinc(n * L)
    inside = slice(200, -200)
    np.testing.assert_allclose(felt.height(s)[:, inside], gain * z[:, inside], atol=2e-8)
    if n == 5.0:  # a patch as long as the wave feels nothing
        assert np.abs(felt.height(s)[:, inside]).max() < 1e-7


@pytest.mark.parametrize("ds", [0.01, 0.07, 0.5])
@pytest.mark.parametrize("L", [0.03, 0.18])
def test_the_felt_height_is_the_mean_of_the_cubic_over_the_patch(ds, L):
    """By SciPy's spline and quadrature, from cells finer than the patch to coarser ones."""
    rng = np.random.default_rng(2)
    road = Surface(rng.standard_normal((2, 40)), ds, start=3.0)
    felt, cubic = enveloped(road, L), oracles.SplineRoad(road.z, ds, 3.0)
    assert felt.ds == ds and felt.start <= 3.0 - 0.5 * L - ds < felt.start + ds + 1e-9
    assert felt.end >= road.end + 0.5 * L + ds > felt.end - ds - 1e-9
    for k in range(0, felt.z.shape[1], 3):
        begin, end = felt.s[k] - 0.5 * L, felt.s[k] + 0.5 * L
        low, high = 3.0 - ds, road.end + ds
        ends = np.clip([begin, end], low, high)
        knots = [s for s in (3.0, road.end, *road.s) if ends[0] < s < ends[1]]
        before, behind = max(min(end, low) - begin, 0.0), max(end - max(begin, high), 0.0)
        for side in range(2):
            area, _ = quad(lambda s, side=side: cubic.z(s)[side], *ends, points=knots or None)
            # before the first and behind the last sample the road is level
            area += before * road.z[side, 0] + behind * road.z[side, -1]
            assert felt.z[side, k] == pytest.approx(area / L, abs=1e-7)


def test_level_and_sloping_roads_are_felt_as_they_are_at_any_height():
    s = 0.1 * np.arange(200)
    z = np.stack([np.full(s.size, 1300.0), 1300.0 + 0.05 * s])
    felt = enveloped(Surface(z, 0.1), 0.25)
    np.testing.assert_allclose(felt.height(s)[:, 3:-3], z[:, 3:-3], atol=1e-9)
    assert felt.notes == ("as felt over 250 mm of contact",)


@pytest.mark.parametrize("length", [0.0, -0.1, float("nan"), float("inf")])
def test_a_patch_without_a_length_is_refused(length):
    with pytest.raises(ValueError, match="contact length must be positive"):
        enveloped(ROAD, length)


# --- records --------------------------------------------------------------------------------------


def test_the_first_grade_records_what_the_car_and_its_instruments_give_to_the_bit():
    record, profile = drive(seed=9)
    one = DriveSimulator(build_plant(DEFENDER), DEFENDER, ROAD, 15.0)
    motion = one.advance(np.full(one.steps_left, encode_command("ride"), dtype=np.uint8))
    expected = DataLogger(PAPER, DEFENDER, 0.001, np.random.default_rng(9)).sample(motion)
    np.testing.assert_array_equal(record.a, expected)
    np.testing.assert_allclose(record.s, motion.s, atol=1e-12)
    assert (record.v == 15.0).all()
    np.testing.assert_array_equal(profile.z, true_profile(ROAD).z)


def test_a_graded_record_is_that_of_its_parts():
    """The individual's plant over the road it feels, in finer steps, through faulty instruments."""
    by = replace(BY, instruments=replace(BY.instruments, dropout_rate=0.05))
    record, profile = drive("S3", seed=11, plant_mismatch=by)
    one = perturb_vehicle(DEFENDER, "S3", 11, by)
    car = DriveSimulator(
        one.plant, one.car, enveloped(ROAD, BY.structure.contact_length), 15.0, step=0.0005
    )
    motion = car.advance(np.full(car.steps_left, encode_command("ride"), dtype=np.uint8))
    logger = DataLogger(PAPER, one.car, 0.0005, np.random.default_rng(11), one.faults)
    expected = np.concatenate([logger.sample(motion), logger.flush()], axis=1)
    np.testing.assert_array_equal(record.a, expected)
    assert record.a.shape[1] == motion.t[::2].size and np.isnan(record.a).any()
    assert record.fs == pytest.approx(1000.0) and record.length == 20.0
    np.testing.assert_allclose(record.v, 15.0 * (1.0 + one.faults.speed))
    s = -APRON_LENGTH + logger.odometer(15.0 * record.t)
    np.testing.assert_allclose(record.s, s, atol=1e-12)
    np.testing.assert_array_equal(
        profile.z, true_profile(ROAD).z
    )  # of the road, not of what is felt


def test_each_grade_departs_further_and_differently():
    records = {grade: drive(grade, instruments=IDEAL)[0] for grade in GRADES}
    s0, s1, s2 = (records[grade].a for grade in GRADES[:3])
    n = min(a.shape[1] for a in (s0, s1, s2))
    for one, other in ((s0, s1), (s1, s2)):
        away = np.std(one[:, :n] - other[:, :n]) / np.std(s0)
        assert 0.02 < away < 2.0
    assert not np.isnan(s2).any()
    assert same(drive("S2")[0], drive("S2")[0])
    assert not same(drive("S2", seed=1)[0], drive("S2", seed=2)[0])


def test_the_finer_of_the_asked_and_the_field_cars_step_is_taken():
    coarse, asked = (drive("S1", instruments=IDEAL, step=h)[0] for h in (0.001, 0.0005))
    assert same(coarse, asked)
    assert not same(asked, drive("S1", instruments=IDEAL, step=0.00025)[0])
    with pytest.raises(ConfigError, match="whole number of integrator steps"):
        drive("S1", plant_mismatch=replace(BY, step=0.0003))


def test_a_symmetric_road_rolls_no_training_car_and_every_field_car():
    road = Surface(np.stack([ROAD.z[0], ROAD.z[0]]), ROAD.ds)
    for grade, still in zip(GRADES, (True, False, False, False), strict=True):
        one = perturb_vehicle(DEFENDER, grade, 4)
        car = DriveSimulator(one.plant, one.car, one.enveloped(road), 15.0)
        motion = car.advance(np.full(car.steps_left, encode_command("ride"), dtype=np.uint8))
        assert (motion.state[:, [1, 4, 6]] == 0.0).all() == still


def test_the_whole_field_car_drives_as_scipy_and_an_independent_right_hand_side_say():
    """Radau, the paper's letters with the deviations, and the mean height by SciPy's spline."""
    one, L = perturb_vehicle(DEFENDER, "S3", 21), BY.structure.contact_length
    half = 0.5 * L
    s = ROUGH.ds * np.arange(-20, ROUGH.z.shape[1] + 20)
    wide = np.pad(ROUGH.z, ((0, 0), (40, 40)), mode="edge")
    slope = np.gradient(wide, ROUGH.ds, axis=1)
    stations = ROUGH.ds * (np.arange(wide.shape[1]) - 40)
    area = CubicHermiteSpline(stations, wide, slope, axis=1).antiderivative()
    road = oracles.SplineRoad((area(s + half) - area(s - half)) / L, ROUGH.ds, float(s[0]))
    mode = {"front": "ride", "rear": "handling"}
    car = DriveSimulator(one.plant, one.car, one.enveloped(ROUGH), 12.0, mode, step=0.0001)
    y_0, strut_state, t = car.state.copy(), car.strut_state.copy(), np.linspace(0.0, 0.8, 41)
    heights = road.wheel_inputs(car.start, DEFENDER.wheelbase, 0.0)[0]
    np.testing.assert_allclose(equilibrium(one.plant, strut_state, heights), y_0, atol=1e-9)
    expected = oracles.trajectory(
        one.car, strut_state, road, 12.0, -APRON_LENGTH, y_0, t, one.variation, method="Radau",
        rtol=1e-5, atol=1e-8,
    )  # fmt: skip
    motion = car.advance(np.full(8001, encode_command(mode), dtype=np.uint8))
    rates = np.column_stack([motion.state[::200, 7:], motion.twist[::200, 1]]).T
    error = np.sqrt(np.mean((rates - expected[8:]) ** 2, axis=1))
    assert (error < 2e-3 * np.sqrt(np.mean(expected[8:] ** 2, axis=1))).all()
    assert motion.signals.shape[1] == 32 and np.abs(motion.signals[:, TWIST]).max() > 1e-4


# --- configuration --------------------------------------------------------------------------------


@pytest.mark.parametrize("grade", ["S4", "s1", "", None, 1])
def test_a_grade_that_is_none_is_refused_with_those_there_are(grade):
    with pytest.raises(ConfigError, match=r"unknown grade .*known: S0, S1, S2, S3"):
        perturb_vehicle(DEFENDER, grade, 1)
    with pytest.raises(ConfigError, match="unknown grade"):
        drive(grade)


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        ("manufacture.mass", [0.1, 0.03], "mass must be within [0, 1), the least first"),
        ("manufacture.strut_gas", 1.0, "strut_gas must be within [0, 1)"),
        ("manufacture.tyre", 0.1, "tyre: unknown key; known: friction, inertia, mass"),
        ("structure.contact_length", -0.1, "contact_length must not be negative, got -0.1"),
        ("structure.tyre_pressure_effect", 20.0, "tyre_pressure times tyre_pressure_effect"),
        ("structure.frame.f", 0.0, "f must be positive and finite, got 0.0"),
        ("instruments.dropout_rate", 0.5, "dropout_rate must be below half of the samples"),
        (
            "instruments.dropout_length",
            2.5,
            "dropout_length: input should be a valid integer, got 2.5",
        ),
        ("instruments.offset", -1.0, "offset must not be negative"),
        ("step", 0.1, "step must be within (0, 0.01] s, got 0.1"),
    ],
)
def test_a_fault_in_deviations_is_one_sentence_that_names_it(path, value, says):
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
    assert str(caught.value).startswith("field.yaml: ") and says in str(caught.value)
    assert "\n" not in str(caught.value)


@settings(max_examples=20)
@given(seeds)
def test_every_individual_finds_its_rest_and_carries_its_weight(seed):
    one = perturb_vehicle(DEFENDER, "S3", seed)
    for mode in ("ride", "handling"):
        car = DriveSimulator(one.plant, one.car, one.enveloped(ROAD), 15.0, mode)
        loads = car.advance(np.full(1, encode_command(mode), dtype=np.uint8)).tyre_load[0]
        weight = oracles.G * (one.car.m_b + one.car.front.m + one.car.rear.m)
        assert loads.sum() == pytest.approx(weight, rel=1e-8) and (loads > 0.0).all()
    assert isinstance(one.faults, SensorFaults)
