"""Tests of the integrator: formula, order 2, L-stability, energy, and comparison with SciPy."""

from functools import cache

import numpy as np
import oracles
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from vehicle_fixtures import (
    CARS,
    FLAT_SURFACE,
    MANOEUVRE_PLANTS,
    PLANTS,
    VARIATIONS,
    VARIED_MANOEUVRE_PLANTS,
    ZEROS,
    compute_accelerations,
    lossless,
    run_integrator,
    smooth_road,
    vectors,
)

from road_envs.roads.surface import Surface
from road_envs.simulation.rosenbrock import ACCELERATION, EXTENSION, LOAD, TWIST
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.linear_model import jacobian
from road_envs.vehicle.suspension import encode_command, settled_strut_state

MODES = ("ride", "handling")
ROLL = [1, 4, 6, 8, 11, 13]
GENTLE, ROUGH = smooth_road(height=0.007), smooth_road(height=0.03)
SPEED, S_0 = 12.0, 1.0
every_car = pytest.mark.parametrize("name", CARS)
every_mode = pytest.mark.parametrize("mode", MODES)


def road_under(surface, name, s, speed=SPEED):
    """Return heights and rates (4,) under the wheels, by the road oracle."""
    car = CARS.get(name, CARS["unequal_axles"])
    return oracles.SplineRoad(surface.z, surface.ds).wheel_inputs(s, car.wheelbase, speed)


@pytest.mark.parametrize("name", [*CARS, *VARIATIONS])
@every_mode
@settings(max_examples=40)
@given(
    vectors(14, 0.02, 0.02, 0.01, 0.02, 0.02, 0.02, 0.02, 0.5, 0.4, 0.3, 1.0, 0.5, 1.0, 0.5),
    st.sampled_from([0.0002, 0.001, 0.004, 0.01]),
    st.floats(5.0, 30.0),
    st.floats(-0.01, 0.01),
)
@pytest.mark.costly
def test_one_step_equals_the_published_formula(name, mode, y, h, s, psi):
    """dw/dt, the road's second derivative, is a difference over the half step.

    The matrix of a flexible vehicle contains the twist's own spring and damper but no coupling.
    """
    plant, strut_state = (
        {**MANOEUVRE_PLANTS, **VARIED_MANOEUVRE_PLANTS}[name],
        settled_strut_state(encode_command(mode)),
    )
    if plant.flexible:
        y = np.concatenate([y[:7], [psi], y[7:], [20.0 * psi]])
    n, p = y.size // 2, plant.constants[0]
    a_xy = np.array([[-3.0, 2.0], [-3.5, 2.6], [0.0, 0.0]])  # a_x, a_y at 0, h/2 and, unused, h

    def world(t):
        z_r, w_r = road_under(ROUGH, name, s + SPEED * t)
        return np.concatenate([z_r, w_r, a_xy[round(2.0 * t / h)]])

    def rate(y, x):
        return np.concatenate(
            [y[n:], compute_accelerations(plant, strut_state, y[:n], y[n:], x[:4], x[4:8], x[8:])]
        )

    def matrix(x):
        J = jacobian(plant, strut_state, y, x[:4], x[4:8])
        if plant.flexible:
            J[[8, 9, 10, 11, 12, 13, 14], 7] = J[[8, 9, 10, 11, 12, 13, 14], 15] = 0.0
            J[15] = 0.0
            J[15, [7, 15]] = [-p["frame_rate"], -p["frame_damping"]] / p["frame_inertia"]
        return J

    start, middle = world(0.0), world(0.5 * h)
    change = np.concatenate([start[4:8], (middle - start)[4:] / (0.5 * h)])
    options = {"h": h, "steps": 1, "surface": ROUGH, "speed": SPEED, "s_0": s, "a_xy": a_xy}
    result = y.copy()
    out = run_integrator(plant, result, mode=mode, **options)
    d = 1e-5
    before, now, after = (rate(y, start + x * change) for x in (-d, 0.0, d))
    # the finite difference must not cross a kink, as where a tyre's damper has its limit
    assume(np.allclose(after - now, now - before, rtol=1e-3, atol=1e-6))
    expected, _, _ = oracles.ode23s_step(
        lambda t, y: rate(y, world(t)),
        lambda t, y: matrix(start),
        lambda t, y: (after - before) / (2.0 * d),
        0.0,
        y,
        h,
    )
    np.testing.assert_array_equal(out[0, :14], np.delete(y, [7, 15]) if plant.flexible else y)
    accelerations = out[0, [*range(ACCELERATION, ACCELERATION + 7), TWIST + 2][:n]]
    np.testing.assert_allclose(accelerations, now[n:], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(out[0, TWIST : TWIST + 2], y[[7, 15]] if plant.flexible else [])
    np.testing.assert_allclose(result, expected, rtol=1e-7, atol=1e-9)


@cache
def reference(name, mode, surface, seconds, rtol=1e-9):
    """Return times (N,) and states (14, N) of a drive, by LSODA on the compiled equations."""
    plant, strut_state = PLANTS[name], settled_strut_state(encode_command(mode))
    road, wheelbase = oracles.SplineRoad(surface.z, surface.ds), CARS[name].wheelbase

    def rate(t, y):
        z_r, w_r = road.wheel_inputs(S_0 + SPEED * t, wheelbase, SPEED)
        return np.concatenate(
            [y[7:], compute_accelerations(plant, strut_state, y[:7], y[7:], z_r, w_r)]
        )

    t, y_0 = np.linspace(0.0, seconds, 51), equilibrium(plant, strut_state, ZEROS)
    result = solve_ivp(
        rate, (0.0, seconds), y_0, t_eval=t, method="LSODA", rtol=rtol, atol=rtol * 1e-2
    )
    assert result.success
    return t, result.y


def simulate_states(name, mode, surface, t, h):
    """Return states (14, N) of the same drive at `t` in steps of `h`, and the least tyre load."""
    plant, strut_state = PLANTS[name], settled_strut_state(encode_command(mode))
    y, every = equilibrium(plant, strut_state, ZEROS), round((t[1] - t[0]) / h)
    steps = every * (t.size - 1) + 1
    out = run_integrator(
        plant, y, h=h, steps=steps, surface=surface, speed=SPEED, s_0=S_0, strut_state=strut_state
    )
    return out[::every, :14].T, out[:, LOAD:].min()


def relative_error(states, truth):
    """Return the RMS error of the rates relative to their RMS, of the worst degree of freedom."""
    error = np.sqrt(np.mean((states[7:] - truth[7:]) ** 2, axis=1))
    return (error / np.sqrt(np.mean(truth[7:] ** 2, axis=1))).max()


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("unequal_axles", "ride"),
        ("defender", "handling"),
        pytest.param("unequal_axles", "handling", marks=pytest.mark.slow),
        pytest.param("defender", "ride", marks=pytest.mark.slow),
    ],
)
@pytest.mark.costly
def test_the_method_has_order_two_on_the_nonlinear_vehicle_over_a_road(name, mode):
    t, truth = reference(name, mode, GENTLE, 1.0)
    h = 0.001 / 2.0 ** np.arange(5)
    error = []
    for step in h:
        states, least = simulate_states(name, mode, GENTLE, t, step)
        assert least > 0.0  # the order holds for smooth right-hand sides only
        error.append(relative_error(states, truth))
    slope = np.polyfit(np.log(h), np.log(error), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.05)
    assert error[0] < 1e-3 and error[-1] < 4e-6


@pytest.mark.parametrize(("name", "mode"), [("unequal_axles", "ride"), ("defender", "handling")])
@pytest.mark.costly
def test_a_drive_with_wheel_lift_off_matches_the_reference(name, mode):
    t, truth = reference(name, mode, ROUGH, 1.0, rtol=1e-8)
    states, least = simulate_states(name, mode, ROUGH, t, 0.00025)
    assert least == 0.0
    assert relative_error(states, truth) < 1e-4


@pytest.mark.parametrize(("name", "mode"), [("unequal_axles", "handling"), ("defender", "ride")])
@pytest.mark.costly
def test_a_drive_matches_scipy_on_the_papers_equations(name, mode):
    """The oracle shares no code: the paper's equations, SciPy's curves, splines and Radau."""
    plant, strut_state = PLANTS[name], settled_strut_state(encode_command(mode))
    y_0, t = equilibrium(plant, strut_state, ZEROS), np.linspace(0.0, 0.4, 21)
    road = oracles.SplineRoad(GENTLE.z, GENTLE.ds)
    truth = oracles.trajectory(
        CARS[name], strut_state, road, SPEED, S_0, y_0, t, method="Radau", rtol=1e-5, atol=1e-9
    )
    states, _ = simulate_states(name, mode, GENTLE, t, 0.0001)
    assert relative_error(states, truth) < 5e-5


@pytest.mark.parametrize("f", [0.5, 1.5, 4.0, 9.0, 16.0, 30.0])
@pytest.mark.parametrize(("name", "mode"), [("unequal_axles", "ride"), ("defender", "handling")])
def test_small_motions_have_the_frequency_response_of_the_energy_matrices(name, mode, f):
    """Sine of 0.1 micrometre under the left wheels, so small that friction is linear damping."""
    car, plant, strut_state = CARS[name], PLANTS[name], settled_strut_state(encode_command(mode))
    start = equilibrium(plant, strut_state, ZEROS)
    column = car.strut.x_1 + (car.strut.x_2 if mode == "ride" else 0.0)
    # the static force determines the gas column and so the spring rate
    ratio = oracles.static_loads(car)[0] / (car.strut.p_stat * car.strut.A)
    k_s = car.strut.n_p / column * car.strut.p_stat * car.strut.A * ratio ** (1 + 1 / car.strut.n_p)
    curves = getattr(car.strut.damper, mode), getattr(car.strut.friction, mode)
    c_s = sum(float(oracles.CubicCurve(c).slope(0.0)) for c in curves)
    matrices = oracles.linear_matrices(car, k_s, (c_s, c_s))
    speed, wavelength, amplitude = 10.0, 10.0 / f, 1e-7
    ds = wavelength / 400
    s = ds * np.arange(round((10.0 * speed + 6.0) / ds))
    z = np.stack([amplitude * np.sin(2.0 * np.pi * s / wavelength), 0.0 * s])
    out = run_integrator(
        plant, start.copy(), h=0.0005, steps=19000, surface=Surface(z, ds), speed=speed,
        s_0=car.wheelbase, strut_state=strut_state,
    )  # fmt: skip
    last = slice(-round(round(2.0 * f) / f / 0.0005), None)
    phase = 2.0 * np.pi * f * 0.0005 * np.arange(19000)[last]
    wave = np.exp(-1j * phase)
    result = 2.0 * np.mean(out[last, ACCELERATION : ACCELERATION + 7] * wave[:, None], axis=0)
    behind = np.exp(-2j * np.pi * f * car.wheelbase / speed)
    lead = np.exp(2j * np.pi * f * car.wheelbase / speed)
    expected = oracles.response(matrices, f, -1j * amplitude * lead * np.array([1, 0, behind, 0]))
    np.testing.assert_allclose(result, expected, atol=0.01 * np.abs(expected).max())


@every_car
@every_mode
def test_damped_motion_on_level_ground_never_gains_energy(name, mode):
    oracle, strut_state = (
        oracles.NonlinearCar(CARS[name]),
        settled_strut_state(encode_command(mode)),
    )
    rng = np.random.default_rng(5)
    for _ in range(4):
        y = np.concatenate([0.01 * rng.standard_normal(7), 0.3 * rng.standard_normal(7)])
        out = run_integrator(PLANTS[name], y, h=0.0005, steps=1500, strut_state=strut_state)
        energy = [oracle.energy(strut_state, x[:7], x[7:14], ZEROS) for x in out[::5]]
        at_rest = equilibrium(PLANTS[name], strut_state, ZEROS)
        span = energy[0] - oracle.energy(strut_state, at_rest[:7], at_rest[7:], ZEROS)
        assert span > 0.0
        assert np.diff(energy).max() < 1e-6 * span
        assert energy[-1] - energy[0] < -0.9 * span


@every_car
@every_mode
def test_without_damping_energy_is_conserved_to_the_order_of_the_method(name, mode):
    car, free = lossless(CARS[name]), build_plant(lossless(CARS[name]))
    oracle, strut_state = oracles.NonlinearCar(car), settled_strut_state(encode_command(mode))
    start = equilibrium(free, strut_state, ZEROS)
    rest = oracle.energy(strut_state, start[:7], start[7:], ZEROS)
    start[7:] = 0.1, 0.1, 0.05, 0.2, 0.2, -0.2, 0.1
    h, drift = 0.001 / 2.0 ** np.arange(4), []
    for step in h:
        y = start.copy()
        run_integrator(free, y, h=step, steps=round(1.0 / step), strut_state=strut_state)
        first = oracle.energy(strut_state, start[:7], start[7:], ZEROS)
        drift.append(abs(oracle.energy(strut_state, y[:7], y[7:], ZEROS) - first) / (first - rest))
    assert drift[0] < 2e-4
    assert np.polyfit(np.log(h), np.log(drift), 1)[0] > 1.9


def decay_towards_rest(name, mode, size, h, steps):
    """Return the largest deviation of the state from rest in each step, relative to the first."""
    plant, strut_state = PLANTS[name], settled_strut_state(encode_command(mode))
    rest = equilibrium(plant, strut_state, ZEROS)
    y = rest + size * np.random.default_rng(1).standard_normal(14)
    out = run_integrator(plant, y, h=h, steps=steps, strut_state=strut_state)
    deviation = np.abs(out[:, :14] - rest).max(axis=1)
    return deviation / deviation[0]


@every_car
@every_mode
@pytest.mark.parametrize("h", [0.05, 0.5, 5.0, 50.0])
def test_small_motions_decay_for_any_step_size(name, mode, h):
    """L-stability: friction has a time constant of 1 ms, and axle roll a frequency of 15 Hz."""
    deviation = decay_towards_rest(name, mode, 1e-8, h, 400)
    assert deviation.max() < 100.0  # at 16 Hz a heave of 1 mm is a rate of 100 mm/s
    assert deviation[-1] < 1e-3
    if h >= 5.0:
        assert deviation[10] < 1e-3


@every_car
@every_mode
@pytest.mark.parametrize("h", [0.01, 0.02])
def test_large_motions_decay_in_steps_longer_than_the_fastest_mode(name, mode, h):
    deviation = decay_towards_rest(name, mode, 0.01, h, 1000)
    assert deviation.max() < 100.0 and deviation[-1] < 1e-3


@every_car
@every_mode
def test_a_symmetric_road_causes_exactly_no_roll(name, mode):
    z = np.stack([ROUGH.z[0], ROUGH.z[0]])
    plant, strut_state = PLANTS[name], settled_strut_state(encode_command(mode))
    y = equilibrium(plant, strut_state, ZEROS)
    out = run_integrator(
        plant,
        y,
        h=0.001,
        steps=3000,
        surface=Surface(z, ROUGH.ds),
        speed=SPEED,
        strut_state=strut_state,
    )
    assert np.abs(out[:, 0]).max() > 0.01
    assert (out[:, ROLL] == 0.0).all() and (y[ROLL] == 0.0).all()
    for left in (EXTENSION, EXTENSION + 2, LOAD, LOAD + 2):
        np.testing.assert_array_equal(out[:, left], out[:, left + 1])


@every_car
@every_mode
def test_a_vehicle_at_rest_on_level_ground_stays_at_rest(name, mode):
    plant, strut_state = PLANTS[name], settled_strut_state(encode_command(mode))
    rest = equilibrium(plant, strut_state, ZEROS)
    y = rest.copy()
    out = run_integrator(
        plant, y, h=0.001, steps=5000, surface=FLAT_SURFACE, strut_state=strut_state
    )
    np.testing.assert_allclose(y, rest, atol=1e-12)
    np.testing.assert_allclose(out[:, ACCELERATION : ACCELERATION + 7], 0.0, atol=1e-9)
