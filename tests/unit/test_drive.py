"""Tests of drives: chunks, copies and step size; delay of commands; effects of a switch."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vehicle_fixtures import CARS, DEFENDER, PLANTS, smooth_road

from road_envs.core.config import ConfigError
from road_envs.roads.surface import Surface
from road_envs.simulation.drive import (
    APRON_LENGTH,
    DriveSimulator,
    SimulationError,
    Trajectory,
    simulate,
)
from road_envs.simulation.rosenbrock import N_SIGNALS
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.suspension import DAMPING_HIGH, HELD_EXTENSION, VALVE_OPEN, encode_command

ROAD = smooth_road(length=30.0, height=0.015)
RIDE, HANDLING = encode_command("ride"), encode_command("handling")
every_car = pytest.mark.parametrize("name", CARS)


def make_simulator(
    name="defender", road=ROAD, speed=15.0, mode="ride", step=0.001
) -> DriveSimulator:
    return DriveSimulator(PLANTS[name], CARS[name], road, speed, mode, step)


def commands(*pairs) -> np.ndarray:
    """Return bytes (N,) from (byte, count) pairs."""
    return np.concatenate([np.full(count, byte, dtype=np.uint8) for byte, count in pairs])


MIXED = commands((RIDE, 300), (HANDLING, 500), (encode_command("soft_high"), 200), (RIDE, 700))


def assert_same(a: Trajectory, b: Trajectory) -> None:
    for field in ("t", "s", "v", "commands", "signals"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


def concatenate(parts) -> Trajectory:
    fields = ("t", "s", "v", "commands", "signals")
    return Trajectory(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields))


@settings(max_examples=20)
@given(st.lists(st.integers(0, MIXED.size), max_size=8))
def test_a_drive_in_chunks_equals_the_whole_drive_bitwise(cuts):
    whole, chunked = make_simulator(), make_simulator()
    parts = [chunked.advance(part) for part in np.split(MIXED, sorted(cuts))]
    assert_same(concatenate(parts), whole.advance(MIXED))
    np.testing.assert_array_equal(chunked.state, whole.state)
    np.testing.assert_array_equal(chunked.strut_state, whole.strut_state)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda d: pickle.loads(pickle.dumps(d))])
def test_a_copy_of_a_running_simulator_continues_bitwise_and_independently(duplicate):
    original = make_simulator()
    original.advance(MIXED[:310])  # commands are still on their way to the valves
    duplicated = duplicate(original)
    assert_same(duplicated.advance(MIXED[310:]), original.advance(MIXED[310:]))
    assert duplicated.steps == original.steps and duplicated.state is not original.state


def test_copies_cause_no_recompilation():
    from road_envs.simulation.rosenbrock import integrate as kernel

    make_simulator().advance(MIXED[:3])
    before = len(kernel.signatures)
    copy.deepcopy(make_simulator()).advance(MIXED[:3])
    pickle.loads(pickle.dumps(make_simulator())).advance(MIXED[:3])
    assert len(kernel.signatures) == before


def test_halving_the_step_hardly_changes_the_drive():
    coarse = make_simulator().advance(MIXED)
    fine = make_simulator(step=0.0005).advance(np.repeat(MIXED, 2))
    for signal, tolerance in (("state", 0.02), ("acceleration", 0.05), ("tyre_load", 0.02)):
        a, b = getattr(coarse, signal), getattr(fine, signal)[::2]
        error = np.sqrt(np.mean((a - b) ** 2, axis=0))
        assert (error <= tolerance * np.std(b, axis=0)).all()
    np.testing.assert_allclose(coarse.t, fine.t[::2], rtol=1e-12)


# --- whole drives ---------------------------------------------------------------------------------


@every_car
@pytest.mark.parametrize("mode", ["ride", "handling", {"front": "stiff_low", "rear": "soft_high"}])
def test_a_drive_over_flat_ground_stays_at_rest(name, mode):
    flat = Surface(np.zeros((2, 200)), 0.1)
    trajectory = simulate(CARS[name], flat, 20.0, mode)
    np.testing.assert_allclose(trajectory.acceleration, 0.0, atol=1e-9)
    assert np.ptp(trajectory.state, axis=0).max() < 1e-12
    loads = np.repeat(oracles.static_loads(CARS[name])[1], 2)
    np.testing.assert_allclose(trajectory.tyre_load, np.tile(loads, (trajectory.t.size, 1)))


def test_a_drive_starts_at_rest_on_an_apron_of_any_height_and_cross_fall():
    z = np.stack([np.full(100, -3.02), np.full(100, -3.1)])
    trajectory = simulate(DEFENDER, Surface(z, 0.1), 20.0)
    np.testing.assert_allclose(trajectory.acceleration, 0.0, atol=1e-8)
    assert (trajectory.tyre_load > 0.0).all()


def test_a_drive_begins_one_apron_before_the_road_and_ends_one_after_it():
    simulator = make_simulator()
    assert simulator.station == -APRON_LENGTH and simulator.steps_left > 0
    steps = simulator.steps_left
    trajectory = simulator.advance(np.full(steps, RIDE))
    assert simulator.steps_left == 0 and trajectory.t.size == steps
    assert simulator.station == pytest.approx(30.0 + DEFENDER.wheelbase + APRON_LENGTH, abs=0.016)
    np.testing.assert_allclose(trajectory.s, -APRON_LENGTH + 15.0 * trajectory.t, atol=1e-9)
    np.testing.assert_allclose(trajectory.t, 0.001 * np.arange(steps), rtol=1e-12)
    assert (trajectory.v == 15.0).all() and (trajectory.commands == RIDE).all()
    assert_same(simulate(DEFENDER, ROAD, 15.0), trajectory)


@every_car
def test_each_tyre_load_follows_from_the_road_at_its_own_station(name):
    car, trajectory = CARS[name], make_simulator(name).advance(MIXED)
    oracle, road = oracles.NonlinearCar(car), oracles.SplineRoad(ROAD.z, ROAD.ds)
    q, v = trajectory.state[:, :7], trajectory.state[:, 7:]
    y_t = np.array([a.y_t * side for a in car.axles for side in (1.0, -1.0)])
    for k in range(0, MIXED.size, 50):
        z_r, w_r = road.wheel_inputs(-APRON_LENGTH + 15.0 * 0.001 * k, car.wheelbase, 15.0)
        u = z_r - (q[k, [3, 3, 5, 5]] + y_t * q[k, [4, 4, 6, 6]])
        u_dot = w_r - (v[k, [3, 3, 5, 5]] + y_t * v[k, [4, 4, 6, 6]])
        secants = [oracle.tyre_coefficients(w, u[w], u_dot[w]) for w in range(4)]
        load = [k * (oracle.delta[w] + u[w]) + c * u_dot[w] for w, (k, c) in enumerate(secants)]
        np.testing.assert_allclose(trajectory.tyre_load[k], load, rtol=1e-9)
    assert np.abs(np.diff(trajectory.tyre_load[:, :2], axis=1)).max() > 500.0


@every_car
def test_the_signals_are_consistent_with_the_states(name):
    trajectory = make_simulator(name).advance(MIXED)
    car, q, h = CARS[name], trajectory.state, 0.001
    assert trajectory.signals.shape == (MIXED.size, N_SIGNALS)
    rates = (q[2:, :7] - q[:-2, :7]) / (2.0 * h)
    size = np.abs(q[:, 7:]).max(axis=0)
    np.testing.assert_allclose(rates / size, q[1:-1, 7:] / size, atol=0.02)
    turns = (q[2:, 7:] - q[:-2, 7:]) / (2.0 * h)
    error = np.sqrt(np.mean((turns - trajectory.acceleration[1:-1]) ** 2, axis=0))
    assert (error < 0.1 * trajectory.acceleration.std(axis=0)).all()
    paper = np.array([-1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0])
    extensions = oracles.NonlinearCar(car).extensions(*(paper[:, None] * q[:, :7].T))
    np.testing.assert_allclose(trajectory.extension, extensions.T, atol=1e-12)
    weight = oracles.G * (car.m_b + car.front.m + car.rear.m)
    a = trajectory.acceleration
    inertia = car.m_b * a[:, 0] + car.front.m * a[:, 3] + car.rear.m * a[:, 5]
    np.testing.assert_allclose(trajectory.tyre_load.sum(axis=1), weight + inertia, rtol=1e-9)


@given(st.floats(-3.0, 3.0), st.floats(-1.0, 1.0))
def test_the_acceleration_of_a_body_point_is_that_of_the_rigid_body(x, y):
    signals = np.zeros((1, N_SIGNALS))
    signals[0, 14:17] = 1.3, -0.4, 0.7
    result = Trajectory(*np.zeros((4, 1)), signals).vertical_acceleration(x, y)
    assert result[0] == pytest.approx(oracles.point_acceleration(1.3, -0.4, 0.7, x, y))


def test_the_ten_millimetre_option_starts_as_in_the_paper():
    """10 mm of tyre deflection carry too little load: the vehicle sinks to its equilibrium."""
    car = replace(DEFENDER, tyre_static_deflection=0.010)
    flat = Surface(np.zeros((2, 2000)), 0.1)
    trajectory = simulate(car, flat, 20.0)
    assert (trajectory.state[0] == 0.0).all()
    np.testing.assert_allclose(trajectory.tyre_load[0], 0.010 * 250e3)
    static = np.array(DEFENDER.tyre_deflections) - 0.010
    np.testing.assert_allclose(trajectory.state[-1, [3, 5]], -static, atol=1e-5)


# --- command delay --------------------------------------------------------------------------------


@every_car
@pytest.mark.parametrize("step", [0.001, 0.0005])
def test_a_command_has_no_effect_before_the_delay_of_the_valve(name, step):
    before, delay = round(0.3 / step), round(CARS[name].valve.delay / step)
    unswitched, switched = make_simulator(name, step=step), make_simulator(name, step=step)
    a = unswitched.advance(np.full(before + delay + 5, RIDE)).signals
    b = switched.advance(commands((RIDE, before), (HANDLING, delay + 5))).signals
    np.testing.assert_array_equal(a[: before + delay], b[: before + delay])
    assert (a[before + delay + 1] != b[before + delay + 1]).any()


@pytest.mark.parametrize(("mode", "target"), [("handling", [0.0, 1.0]), ("ride", [1.0, 0.0])])
def test_a_switch_is_95_percent_complete_after_50_milliseconds(mode, target):
    simulator = make_simulator(mode="ride" if mode == "handling" else "handling")
    simulator.advance(np.full(50, encode_command(mode)))
    np.testing.assert_allclose(
        simulator.strut_state[:, [VALVE_OPEN, DAMPING_HIGH]], np.tile(target, (4, 1)), atol=0.05
    )
    simulator.advance(np.full(250, encode_command(mode)))
    np.testing.assert_array_equal(
        simulator.strut_state[:, [VALVE_OPEN, DAMPING_HIGH]], np.tile(target, (4, 1))
    )


def test_struts_switch_independently():
    simulator = make_simulator()
    single = {"FL": "ride", "FR": "handling", "RL": "stiff_low", "RR": "soft_high"}
    simulator.advance(np.full(500, encode_command(single)))
    assert simulator.strut_state[:, VALVE_OPEN].tolist() == [1.0, 0.0, 0.0, 1.0]
    assert simulator.strut_state[:, DAMPING_HIGH].tolist() == [0.0, 1.0, 0.0, 1.0]


def test_axle_forces_are_continuous_when_the_struts_switch():
    """Halving the step halves every change from step to step, also during a switch."""
    largest = []
    for n in (1, 2, 4):
        trajectory = make_simulator(step=0.001 / n).advance(np.repeat(MIXED, n))
        front = trajectory.tyre_load[:, :2].sum(axis=1)
        front -= DEFENDER.front.m * (trajectory.acceleration[:, 3] + oracles.G)
        switching = (trajectory.t > 0.29) & (trajectory.t < 0.45)
        largest.append(np.abs(np.diff(front[switching])).max())
    np.testing.assert_allclose(largest[:-1] / np.array(largest[1:]), 2.0, rtol=0.1)


@every_car
def test_switching_under_deflection_shifts_the_ride_height_reversibly(name):
    """On a step up, closing the valves traps the struts in a compressed or extended state."""
    car = CARS[name]
    step_up = Surface(np.tile(np.clip(np.arange(6000) * 0.05 - 9.0, 0.0, 0.08), (2, 1)), 0.05)
    simulator = make_simulator(name, step_up, speed=10.0)
    before = simulator.advance(np.full(1480, RIDE)).extension[0]
    simulator.advance(np.full(10_000, HANDLING))
    closed = simulator.advance(np.full(1, HANDLING)).extension[0]
    held = simulator.strut_state[:, HELD_EXTENSION]
    assert np.abs(held).max() > 0.005
    ratio = oracles.static_loads(car)[0] / (car.strut.p_stat * car.strut.A)
    column = car.strut.x_1 * np.repeat(ratio, 2) ** (-1.0 / car.strut.n_p)
    np.testing.assert_allclose(closed - held, column - car.strut.x_1, atol=2e-5)
    assert np.abs(closed - before).max() > 0.004
    back = simulator.advance(np.full(10_000, RIDE)).extension[-1]
    np.testing.assert_allclose(back, before, atol=2e-5)
    assert (simulator.strut_state[:, HELD_EXTENSION] == 0.0).all()


# --- rejected input -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"speed": 0.0}, "speed must be positive and finite, got 0.0"),
        ({"speed": -3.0}, "speed must be positive"),
        ({"speed": float("nan")}, "speed must be positive"),
        ({"speed": float("inf")}, "speed must be positive"),
        ({"step": 0.0}, "step must be within"),
        ({"step": 0.02}, "step must be within"),
        ({"step": float("nan")}, "step must be within"),
        ({"mode": "sport"}, "unknown suspension mode 'sport'"),
        ({"road": Surface(np.zeros((2, 10)), 0.1, name="stub")}, "stub: 0.90 m of road is shorter"),
    ],
)
def test_an_impossible_drive_is_rejected_with_the_reason(options, reason):
    with pytest.raises(ConfigError, match=reason):
        make_simulator(**options)


@pytest.mark.parametrize("after", [0, 40])
def test_a_diverged_motion_raises_an_error_that_names_the_time(after):
    simulator = make_simulator()
    simulator.advance(np.full(after + 10, RIDE))
    simulator.state[3] = np.nan
    with pytest.raises(SimulationError, match=rf"no longer finite at t = 0\.0{after + 10} s"):
        simulator.advance(np.full(20, RIDE))


def test_a_plant_can_be_shared_by_several_drives():
    shared = build_plant(DEFENDER)
    before = [a.copy() for a in vars(shared).values()]
    for mode in ("ride", "handling"):
        DriveSimulator(shared, DEFENDER, ROAD, 15.0, mode).advance(MIXED)
    for a, b in zip(before, vars(shared).values(), strict=True):
        np.testing.assert_array_equal(a, b)
