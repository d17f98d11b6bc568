"""Drives of varied vehicles: convergence, SciPy, energy, linear model, adaptive steps."""

from dataclasses import replace
from functools import cache

import numpy as np
import oracles
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import eigh
from vehicle_fixtures import (
    CARS,
    VARIATIONS,
    VARIED,
    VARIED_FLEXIBLE,
    VARIED_MANOEUVRE_PLANTS,
    VARIED_PLANTS,
    WITHOUT_STOPS,
    ZEROS,
    compute_accelerations,
    lossless,
    run_integrator,
    smooth_road,
    strut_states,
    varied_plant,
    vectors,
    with_twist,
)

from road_envs.simulation.drive import DriveSimulator, Trajectory
from road_envs.simulation.rosenbrock import ACCELERATION, LOAD, TWIST
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.linear_model import frequency_response, linearise
from road_envs.vehicle.natural_modes import natural_modes
from road_envs.vehicle.parameters import TorsionalFrame, VehicleVariation
from road_envs.vehicle.suspension import (
    encode_command,
    settled_strut_state,
)
from studies.bench.adaptive_drive import integrate_adaptive, simulate_adaptive

CAR = CARS["unequal_axles"]
SIZES = {"varied": 7, "flexible": 8}
RIDE = settled_strut_state(encode_command("ride"))
GENTLE, ROUGH = smooth_road(height=0.007), smooth_road(height=0.03)
SPEED, S_0 = 12.0, 1.0
every_variation = pytest.mark.parametrize("name", VARIATIONS)
every_mode = pytest.mark.parametrize("mode", ["ride", "handling"])
twists = st.floats(-0.02, 0.02)


# --- motion ---------------------------------------------------------------------------------------


@cache
def reference(name, mode, surface, seconds, rtol=1e-9):
    """Return times (N,) and states (2 n, N) by LSODA on the compiled equations."""
    plant, strut_state = VARIED_PLANTS[name], settled_strut_state(encode_command(mode))
    road, n = oracles.SplineRoad(surface.z, surface.ds), SIZES[name]

    def rate(t, y):
        z_r, w_r = road.wheel_inputs(S_0 + SPEED * t, CAR.wheelbase, SPEED)
        return np.concatenate(
            [y[n:], compute_accelerations(plant, strut_state, y[:n], y[n:], z_r, w_r)]
        )

    t, y_0 = np.linspace(0.0, seconds, 51), equilibrium(plant, strut_state, ZEROS)
    actual = solve_ivp(
        rate, (0.0, seconds), y_0, t_eval=t, method="LSODA", rtol=rtol, atol=rtol * 1e-2
    )
    assert actual.success
    return t, actual.y


def driven(name, mode, surface, t, h):
    """Return the rates (n, N) of the same drive at times `t` with steps `h`, and the least load."""
    plant, strut_state = VARIED_PLANTS[name], settled_strut_state(encode_command(mode))
    y, every = equilibrium(plant, strut_state, ZEROS), round((t[1] - t[0]) / h)
    steps = every * (t.size - 1) + 1
    out = run_integrator(
        plant, y, h=h, steps=steps, surface=surface, speed=SPEED, s_0=S_0, strut_state=strut_state
    )
    rates = out[::every, 7:14]
    if plant.flexible:
        rates = np.column_stack([rates, out[::every, TWIST + 1]])
    return rates.T, out[:, LOAD : LOAD + 4].min()


def distance(actual, truth):
    """Return the largest relative RMS error over the coordinates."""
    return np.sqrt(np.mean((actual - truth) ** 2, axis=1) / np.mean(truth**2, axis=1)).max()


@every_variation
@every_mode
@pytest.mark.costly
def test_the_integrator_converges_with_order_two(name, mode):
    """Also with a flexible frame, whose coupling the matrix of the step leaves out."""
    t, truth = reference(name, mode, GENTLE, 1.0)
    h, error = 0.001 / 2.0 ** np.arange(5), []
    for step in h:
        actual, least = driven(name, mode, GENTLE, t, step)
        assert least > 0.0
        error.append(distance(actual, truth[SIZES[name] :]))
    assert np.polyfit(np.log(h), np.log(error), 1)[0] == pytest.approx(2.0, abs=0.05)
    assert error[0] < 5e-3 and error[-1] < 2e-5


@pytest.mark.costly
def test_a_drive_on_a_rough_road_matches_scipy():
    """All deviations and lifted wheels; the reference shares no code: SciPy's splines and Radau."""
    plant, t = VARIED_PLANTS["flexible"], np.linspace(0.0, 0.5, 26)
    y_0 = equilibrium(plant, RIDE, ZEROS)
    road = oracles.SplineRoad(ROUGH.z, ROUGH.ds)
    s_0 = 5.0  # from here wheels soon lift off
    truth = oracles.trajectory(
        CAR, RIDE, road, SPEED, s_0, y_0, t, VARIED_FLEXIBLE, method="Radau", rtol=1e-5, atol=1e-8
    )
    y = y_0.copy()
    out = run_integrator(plant, y, h=0.0001, steps=5001, surface=ROUGH, speed=SPEED, s_0=s_0)
    assert (out[:, LOAD : LOAD + 4] == 0.0).any()
    actual = np.column_stack([out[::200, 7:14], out[::200, TWIST + 1]]).T
    assert distance(actual, truth[8:]) < 5e-4
    np.testing.assert_allclose(out[::200, TWIST], truth[7], atol=1e-3 * np.abs(truth[7]).max())


@every_variation
def test_without_losses_the_energy_error_has_the_integrators_order(name):
    variation = replace(
        VARIATIONS[name], frame=TorsionalFrame(f=11.0, zeta=0.0) if name == "flexible" else None
    )
    free = varied_plant(lossless(CAR), variation)
    oracle = oracles.NonlinearCar(lossless(CAR), variation)
    start, n = equilibrium(free, RIDE, ZEROS), SIZES[name]
    rest = oracle.energy(RIDE, start[:n], start[n:], ZEROS)
    start[n:] = [0.1, 0.1, 0.05, 0.2, 0.2, -0.2, 0.1, 0.15][:n]
    first, h, drift = oracle.energy(RIDE, start[:n], start[n:], ZEROS), [], []
    for k in range(4):
        h.append(0.001 / 2**k)
        y = start.copy()
        run_integrator(free, y, h=h[-1], steps=round(1.0 / h[-1]), strut_state=RIDE.copy())
        drift.append(abs(oracle.energy(RIDE, y[:n], y[n:], ZEROS) - first) / (first - rest))
    assert drift[0] < 1e-3
    assert np.polyfit(np.log(h), np.log(drift), 1)[0] > 1.9


@every_variation
@every_mode
def test_free_motion_never_gains_energy_and_decays(name, mode):
    strut_state, n = settled_strut_state(encode_command(mode)), SIZES[name]
    oracle, plant = oracles.NonlinearCar(CAR, VARIATIONS[name]), VARIED_PLANTS[name]
    rest, rng = equilibrium(plant, strut_state, ZEROS), np.random.default_rng(5)
    y = rest + np.concatenate([0.01 * rng.standard_normal(n), 0.3 * rng.standard_normal(n)])
    out = run_integrator(plant, y, h=0.0005, steps=3000, strut_state=strut_state)
    twist = out[:, TWIST:]
    q, v = np.hstack([out[:, :7], twist[:, :1]]), np.hstack([out[:, 7:14], twist[:, 1:2]])
    energy = [oracle.energy(strut_state, *at, ZEROS) for at in zip(q[::5], v[::5], strict=True)]
    span = energy[0] - oracle.energy(strut_state, rest[:n], rest[n:], ZEROS)
    assert np.diff(energy).max() < 2e-6 * span and energy[-1] - energy[0] < -0.9 * span


def test_the_free_frame_decays_with_its_frequency_and_damping_ratio():
    """On soft springs the body is nearly free: a decaying sine of f sqrt(1 - zeta²)."""
    frame = TorsionalFrame(f=13.0, zeta=0.04)
    strut = replace(lossless(WITHOUT_STOPS).strut, x_2=40.0)
    plant = varied_plant(
        replace(lossless(WITHOUT_STOPS), strut=strut), VehicleVariation(frame=frame)
    )
    y, h = equilibrium(plant, RIDE, ZEROS), 0.0002
    y[7] += 0.001
    out = run_integrator(plant, y, h=h, steps=5000)
    t, psi = h * np.arange(5000), out[:, TWIST]
    omega = 2.0 * np.pi * frame.f
    damped = omega * np.sqrt(1.0 - frame.zeta**2)
    decay = np.exp(-frame.zeta * omega * t)
    expected = decay * (np.cos(damped * t) + frame.zeta * omega / damped * np.sin(damped * t))
    np.testing.assert_allclose(psi, 0.001 * expected, atol=1e-5)
    differences = (out[2:, TWIST + 1] - out[:-2, TWIST + 1]) / (2.0 * h)
    np.testing.assert_allclose(
        out[1:-1, TWIST + 2], differences, atol=2e-3 * np.abs(differences).max()
    )


def test_a_stiff_frame_behaves_like_a_rigid_one():
    """A frame of 200 Hz gives the drive of the same car without a flexible frame."""
    stiff = varied_plant(CAR, replace(VARIED, frame=TorsionalFrame(f=200.0, zeta=0.05)))
    ends = []
    for plant in (stiff, VARIED_PLANTS["varied"]):
        y = equilibrium(plant, RIDE, ZEROS)
        out = run_integrator(plant, y, h=0.0005, steps=2000, surface=GENTLE, speed=SPEED, s_0=S_0)
        ends.append(out[:, ACCELERATION : ACCELERATION + 7])
    assert np.sqrt(np.mean((ends[0] - ends[1]) ** 2) / np.mean(ends[1] ** 2)) < 0.02


@given(st.floats(-3.0, 3.0), st.floats(-1.0, 1.0))
def test_a_body_point_moves_with_its_half_of_the_frame(x, y):
    signals = np.zeros((1, 32))
    signals[0, 14:17], signals[0, TWIST + 2] = (1.3, -0.4, 0.7), 0.9
    actual = Trajectory(*np.zeros((4, 1)), signals).vertical_acceleration(x, y)
    half = -0.4 + (0.45 if x > 0.0 else -0.45 if x < 0.0 else 0.0)
    assert actual[0] == pytest.approx(oracles.point_acceleration(1.3, half, 0.7, x, y), abs=1e-12)


# --- linear model, derivatives, adaptive steps ----------------------------------------------------


@every_variation
@given(vectors(7, 0.03, 0.03, 0.02, 0.06, 0.02, 0.06, 0.02), vectors(7, 0.7), twists, strut_states)
def test_about_any_state_the_linear_model_matches_differences(name, q, v, psi, strut_state):
    plant, places = VARIED_MANOEUVRE_PLANTS[name], {"RF": (1.1, -0.5), "LR": (-2.0, 0.6)}
    q, v = with_twist(name, q, v, psi, 0.1)
    state, z_r, n = np.concatenate([q, v]), np.array([0.0, 0.01, -0.15, 0.0]), q.size
    model = linearise(plant, strut_state, places, state, z_r, 0.1 * z_r)

    def motion_and_sensors(x, u):
        a = compute_accelerations(plant, strut_state, x[:n], x[n:], z_r + u[:4], 0.1 * z_r + u[4:])
        body = np.append(a, 0.0)[:8]
        rows = [
            oracles.point_acceleration(body[0], body[1] + np.sign(x) * 0.5 * body[7], body[2], x, y)
            for x, y in places.values()
        ]
        return np.append(a, rows)

    rng, eps = np.random.default_rng(0), 1e-7
    for _ in range(2):
        dx, du = rng.standard_normal(2 * n), rng.standard_normal(8)
        there, back = (motion_and_sensors(state + s * dx, s * du) for s in (eps, -eps))
        slope = (there - back) / (2.0 * eps)
        actual = np.append(model.A[n:] @ dx + model.B[n:] @ du, model.C @ dx + model.D @ du)
        np.testing.assert_allclose(actual, slope, atol=1e-3 * np.abs(slope).max())


@every_mode
def test_a_flexible_frame_adds_a_torsion_mode(mode):
    model = linearise(VARIED_PLANTS["flexible"], mode, {"RF": (1.0, -0.5)})
    assert model.A.shape == (16, 16) and model.B.shape == (16, 8) and model.M.size == 8
    assert model.states[7] == "psi" and model.states[15] == "psi_dot"
    actual = natural_modes(model)
    K = -model.M[:, None] * model.A[8:, :8]
    expected = np.sqrt(eigh(0.5 * (K + K.T), np.diag(model.M), eigvals_only=True)) / (2.0 * np.pi)
    np.testing.assert_allclose(actual.f, expected, rtol=1e-9)
    at = actual.names.index("frame torsion")
    assert len(set(actual.names)) == 8
    assert VARIED_FLEXIBLE.frame.f < actual.f[at] < 1.4 * VARIED_FLEXIBLE.frame.f
    assert model.M[7] * actual.shapes[7, at] ** 2 > 0.5
    assert np.isfinite(frequency_response(model, 10.0, f=np.array([1.0, 11.0]))).all()


def test_adaptive_and_fine_fixed_steps_give_the_same_drive():
    t, drive = (
        0.01 * np.arange(150),
        DriveSimulator(VARIED_PLANTS["varied"], CAR, ROUGH, SPEED, "ride", 0.0001),
    )
    actual = integrate_adaptive(drive, t, 1e-7, 1e-9).trajectory
    expected = drive.advance(np.full(14901, encode_command("ride"), dtype=np.uint8))
    for name in ("state", "acceleration", "tyre_load"):
        a, b = getattr(actual, name), getattr(expected, name)[::100]
        assert np.sqrt(np.mean((a - b) ** 2)) < 2e-3 * np.sqrt(np.mean(b**2)), name
    nominal = simulate_adaptive(CAR, ROUGH, SPEED, rtol=1e-4).trajectory
    assert np.abs(nominal.acceleration[:100] - actual.acceleration[:100]).max() > 0.1


def test_a_flexible_frame_is_rejected_where_it_is_not_supported():
    plant = VARIED_PLANTS["flexible"]
    with pytest.raises(ValueError, match="adaptive steps support neither a flexible frame"):
        integrate_adaptive(DriveSimulator(plant, CAR, ROUGH, SPEED), np.array([0.0, 1.0]))
