"""Tests of drives with error control, against the published pair and SciPy."""

from functools import cache

import numpy as np
import oracles
import pytest
from scipy.integrate import solve_ivp
from speeds import speed_ramp
from vehicle_fixtures import CARS, PLANTS, VARIED_PLANTS, smooth_road

from road_envs.roads import load_road
from road_envs.simulation import rosenbrock
from road_envs.simulation.drive import DriveSimulator, SimulationError, simulate
from road_envs.vehicle.equations import Motion
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.linear_model import jacobian
from road_envs.vehicle.suspension import encode_command, settled_strut_state
from road_envs.vehicle.tyres import tyre_force
from studies.bench import adaptive_drive
from studies.bench.adaptive_drive import integrate_adaptive, simulate_adaptive

GENTLE, ROUGH = smooth_road(height=0.007), smooth_road(height=0.03)
SPEED = 12.0
MIXED = {"FL": "ride", "FR": "handling", "RL": "soft_high", "RR": "stiff_low"}
every_car = pytest.mark.parametrize("name", CARS)
every_mode = pytest.mark.parametrize("mode", ["ride", "handling"])


def make_simulator(name, mode, surface=GENTLE, step=0.001):
    plant = {**PLANTS, **VARIED_PLANTS}[name]
    return DriveSimulator(plant, CARS.get(name, CARS["unequal_axles"]), surface, SPEED, mode, step)


def equations(simulator):
    """Return functions of time for a drive: rate (14,), Jacobian (14, 14) and road (8,)."""
    vehicle = simulator.plant.buffers(simulator.strut_state)
    constants, surface = vehicle.constants[0], simulator.surface.buffers

    def road(t):
        under = np.empty(8)
        rosenbrock.sample_road(constants, surface, simulator.start + SPEED * t, SPEED, under)
        return under

    def rate(t, y):
        out, s = np.empty(14), simulator.start + SPEED * t
        adaptive_drive.state_rate(vehicle, surface, s, SPEED, y, out)
        return out

    def J(t, y):
        under = road(t)
        return jacobian(simulator.plant, simulator.strut_state, y, under[:4], under[4:])

    return rate, J, road


@pytest.mark.parametrize("name", [*CARS, "varied"])
@every_mode
@pytest.mark.parametrize("h", [0.0005, 0.004])
def test_the_compiled_step_and_its_error_equal_the_published_pair(name, mode, h):
    simulator, t = make_simulator(name, mode), 1.1
    rate, J, road = equations(simulator)
    rng = np.random.default_rng(2)
    y = equilibrium(simulator.plant, simulator.strut_state, road(t)[:4])
    y += np.concatenate([0.004 * rng.standard_normal(7), 0.2 * rng.standard_normal(7)])
    p = simulator.plant.constants[0]
    # df/dt through the tyres: the road's rate and its change over half a step
    now, later = road(t), road(t + 0.5 * h)
    height, rise = (x[[3, 3, 5, 5]] + p["y_t"] * x[[4, 4, 6, 6]] for x in (y[:7], y[7:]))
    u, u_dot = now[:4] - height, now[4:] - rise
    slopes = np.array([tyre_force(p, w, u[w], u_dot[w]) for w in range(4)])
    force = slopes[:, 1] * now[4:] + slopes[:, 2] * (later[4:] - now[4:]) / (0.5 * h)
    T, (f_l, f_r, r_l, r_r) = np.zeros(14), force
    T[10:] = f_l + f_r, p["y_t"][0] * (f_l - f_r), r_l + r_r, p["y_t"][2] * (r_l - r_r)
    T[7:] /= p["M"]
    expected, difference, between = oracles.ode23s_step(rate, J, lambda t, y: T, t, y, h)

    vehicle = simulator.plant.buffers(simulator.strut_state)
    work, before = rosenbrock.step_workspace(np.empty(rosenbrock.WORKSPACE_ROWS)), np.empty(29)
    result, error, under = y.copy(), np.empty(14), np.concatenate([now, later, road(t + h)])
    inputs = rosenbrock.StepInputs(under[:16], np.zeros(4), h, 0.0)
    rosenbrock.step(vehicle, Motion(result[:7], result[7:]), inputs, work, before)
    assert before[25:].min() > 0.0
    adaptive_drive.step_error(vehicle, before, result, under, h, work, error)
    np.testing.assert_allclose(result, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(error, difference, rtol=1e-6, atol=1e-11)
    assert np.abs(error).max() > 1e-8
    for x in (0.0, 0.3, 1.0):
        dense = np.empty(14)
        adaptive_drive.dense_output(before, work, h, x, dense)
        np.testing.assert_allclose(dense, between(x), rtol=1e-9, atol=1e-12)


def test_the_step_size_factor_is_a_limited_cube_root_of_the_error():
    factor = adaptive_drive.step_size_factor
    assert [factor(x) for x in (1.0, 0.125, 8.0)] == pytest.approx([0.8, 1.6, 0.4])
    assert factor(0.0) == factor(1e-9) == 5.0
    assert factor(1e9) == factor(np.nan) == factor(np.inf) == 0.2


@every_car
@every_mode
def test_without_error_control_the_drive_equals_the_fixed_step_drive(name, mode):
    simulator = make_simulator(name, mode, ROUGH, 0.0005)
    t = 0.0005 * np.arange(4000)
    result = integrate_adaptive(simulator, t, rtol=1e6, atol=1e6, max_step=0.0005)
    assert result.steps in (3999, 4000) and result.rejections == 0
    expected = simulator.advance(np.full(t.size, encode_command(mode), dtype=np.uint8))
    np.testing.assert_allclose(result.trajectory.state, expected.state, rtol=1e-7, atol=1e-9)


@cache
def reference(name, mode):
    """Return times (N,) and states (N, 14) of a drive over GENTLE, by SciPy's Radau."""
    simulator, t = make_simulator(name, mode), np.linspace(0.0, 1.0, 51)
    rate, J, _ = equations(simulator)
    result = solve_ivp(
        rate, (0.0, 1.0), simulator.state, method="Radau", t_eval=t, jac=J, rtol=1e-8, atol=1e-11
    )
    assert result.success
    return t, result.y.T


def relative_error(states, truth):
    """Return the RMS error of the rates, relative to their RMS."""
    return np.sqrt(np.mean((states - truth)[:, 7:] ** 2) / np.mean(truth[:, 7:] ** 2))


@pytest.mark.parametrize(("name", "mode"), [("unequal_axles", "ride"), ("defender", "handling")])
@pytest.mark.costly
def test_the_drive_converges_to_scipys_radau_with_the_tolerance(name, mode):
    t, truth = reference(name, mode)
    rtol = 10.0 ** -np.arange(4.0, 9.0)
    error = [
        relative_error(
            integrate_adaptive(make_simulator(name, mode), t, each, 1e-2 * each).trajectory.state,
            truth,
        )
        for each in rtol
    ]
    assert error[0] < 3e-3 and error[-1] < 1e-5
    assert np.polyfit(np.log(rtol), np.log(error), 1)[0] == pytest.approx(2.0 / 3.0, abs=0.1)


@every_car
@pytest.mark.parametrize("mode", ["ride", MIXED], ids=str)
def test_every_signal_matches_the_drive_in_small_fixed_steps(name, mode):
    car = CARS[name]
    result = simulate_adaptive(car, ROUGH, SPEED, mode, rtol=1e-7, atol=1e-9, step=0.01)
    expected = simulate(car, ROUGH, SPEED, mode, step=0.0001)
    few = result.trajectory
    every = slice(0, 100 * few.t.size, 100)
    np.testing.assert_allclose(few.t, expected.t[every], atol=1e-9)
    np.testing.assert_allclose(few.s, expected.s[every], atol=1e-9)
    np.testing.assert_array_equal(few.commands, expected.commands[every])
    np.testing.assert_array_equal(few.v, expected.v[every])
    for name in ("state", "acceleration", "extension", "tyre_load"):
        a, b = getattr(few, name), getattr(expected, name)[every]
        assert np.sqrt(np.mean((a - b) ** 2)) < 2e-3 * np.sqrt(np.mean(b**2)), name


def test_steps_have_the_maximum_length_on_level_ground_and_shorten_at_a_bump():
    car, bump = CARS["defender"], load_road("bump_small").realise(np.random.default_rng(0))
    simulator = DriveSimulator(PLANTS["defender"], car, bump, SPEED, "ride")
    before = integrate_adaptive(simulator, np.array([0.0, 1.2]), 1e-3, 1e-6)
    assert before.steps == 120 and before.rejections == 0
    whole = integrate_adaptive(simulator, np.array([0.0, 1.7]), 1e-3, 1e-6)
    assert whole.steps > 300 and whole.rejections > 10


def test_an_isolated_bump_is_missed_by_one_long_step():
    car, bump = CARS["defender"], load_road("bump_small").realise(np.random.default_rng(0))
    t = np.linspace(0.0, 1.7, 200)
    simulator = DriveSimulator(PLANTS["defender"], car, bump, SPEED, "ride")
    coarse = integrate_adaptive(simulator, t, max_step=10.0).trajectory
    fine = integrate_adaptive(simulator, t).trajectory
    assert np.abs(coarse.acceleration[:, 0]).max() < 1e-6
    assert np.abs(fine.acceleration[:, 0]).max() > 2.0


def test_the_given_simulator_is_left_unchanged():
    simulator, t = make_simulator("defender", "ride"), np.linspace(0.0, 1.0, 5)
    first = integrate_adaptive(simulator, t).trajectory.signals
    assert simulator.steps == 0
    np.testing.assert_array_equal(integrate_adaptive(simulator, t).trajectory.signals, first)
    np.testing.assert_array_equal(
        simulator.strut_state, settled_strut_state(encode_command("ride"))
    )


@pytest.mark.parametrize(
    ("t", "options", "message"),
    [
        ([0.0, 1.0], {"rtol": 0.0}, "rtol, atol and max_step must be positive"),
        ([0.0, 1.0], {"atol": np.nan}, "rtol, atol and max_step must be positive"),
        ([0.0, 1.0], {"max_step": -1.0}, "rtol, atol and max_step must be positive"),
        ([1.0, 0.5], {}, "ascend"),
        ([-1.0, 0.5], {}, "ascend"),
        ([0.0, np.nan], {}, "ascend"),
    ],
)
def test_invalid_input_is_rejected(t, options, message):
    with pytest.raises(ValueError, match=message):
        integrate_adaptive(make_simulator("defender", "ride"), np.array(t), **options)


def test_a_started_simulator_or_a_changing_speed_is_rejected():
    started = make_simulator("defender", "ride")
    started.advance(np.zeros(3, dtype=np.uint8))
    faster = DriveSimulator(
        PLANTS["defender"], CARS["defender"], GENTLE, speed_ramp(5.0, 9.0, 2.0), "ride"
    )
    for simulator in (started, faster):
        with pytest.raises(ValueError, match="one speed"):
            integrate_adaptive(simulator, np.array([0.0, 1.0]))


def test_a_nan_state_raises_a_simulation_error():
    simulator = make_simulator("defender", "ride")
    simulator.state[3] = np.nan
    with pytest.raises(SimulationError, match=r"no step meets the tolerance at 0\.000000 s"):
        integrate_adaptive(simulator, np.array([0.0, 1.0]))
