"""Linear model against energy matrices, SciPy, tabulated modes and wheelbase notches."""

from dataclasses import replace
from functools import cache

import numpy as np
import oracles
import pytest
from hypothesis import given
from scipy import integrate, signal, stats
from scipy.optimize import brentq
from vehicle_fixtures import (
    CARS,
    DEFENDER,
    MANOEUVRE_PLANTS,
    PLANTS,
    ZEROS,
    compute_accelerations,
    strut_states,
    vectors,
)

from road_envs.sensing.data_logger import load_instruments
from road_envs.vehicle.equations import DOF
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.linear_model import (
    _wheel_response,
    frequency_response,
    gaussian_damping,
    linearise,
)
from road_envs.vehicle.natural_modes import NATURAL_MODE_NAMES, natural_modes
from road_envs.vehicle.struts import _ModeCurves
from road_envs.vehicle.suspension import encode_command, settled_strut_state

MODES = ("ride", "handling")
BODY = {"heave": (0.0, 0.0)}
PLACES = {"RF": (1.1, -0.5), "LR": (-2.0, 0.6), "RR": (-2.0, -0.6)}
SPLIT = {"front": "ride", "rear": "handling"}
every_car = pytest.mark.parametrize("name", CARS)
every_mode = pytest.mark.parametrize("mode", MODES)


def strut_at_rest(strut, stop, mode, load):
    """Return the spring rate [N/m] of a strut that carries `load` [N], and its damping [N s/m]."""
    column = strut.x_1 + strut.x_2 * (mode == "ride")
    stops = oracles.CubicCurve(strut.bushing), oracles.CubicCurve(stop)

    def gas(e):
        return strut.p_stat * strut.A * (column / (column + e)) ** strut.n_p

    e = brentq(lambda e: gas(e) - sum(s(e) for s in stops) - load, -0.04, 0.1, xtol=1e-14)
    k = strut.n_p * gas(e) / (column + e) + sum(s.slope(e) for s in stops)
    losses = getattr(strut.damper, mode), getattr(strut.friction, mode)
    return float(k), sum(float(oracles.CubicCurve(c).slope(0.0)) for c in losses)


def energy_matrices(name, mode, c_s=None):
    """Return the oracle's matrices at equilibrium; `c_s` (front, rear) replaces the slopes."""
    car, loads = CARS[name], oracles.static_loads(CARS[name])[0]
    both = (mode["front"], mode["rear"]) if isinstance(mode, dict) else (mode, mode)
    stops = car.strut.bump_stop.front, car.strut.bump_stop.rear
    at_rest = [strut_at_rest(car.strut, *each) for each in zip(stops, both, loads, strict=True)]
    k_s, slopes = np.array(at_rest).T
    return oracles.linear_matrices(car, k_s, slopes if c_s is None else c_s)


@every_car
@pytest.mark.parametrize("mode", ["ride", "handling", SPLIT], ids=["ride", "handling", "split"])
def test_at_equilibrium_the_model_matches_the_energy_matrices(name, mode):
    model = linearise(PLANTS[name], mode, PLACES)
    M, C, K, K_r, C_r = energy_matrices(name, mode)
    np.testing.assert_array_equal(model.A[:7], np.eye(7, 14, 7))
    np.testing.assert_array_equal(model.B[:7], 0.0)
    expected = np.linalg.solve(M, np.hstack([-K, -C]))
    np.testing.assert_allclose(model.A[7:], expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(model.B[7:], np.linalg.solve(M, np.hstack([K_r, C_r])), rtol=1e-12)
    for row, (x, y) in zip(model.C, PLACES.values(), strict=True):
        body = [oracles.point_acceleration(*model.A[7:10, j], x, y) for j in range(14)]
        np.testing.assert_allclose(row, body, atol=1e-9)


@every_car
@given(vectors(7, 0.03, 0.03, 0.02, 0.06, 0.02, 0.06, 0.02), vectors(7, 0.7), strut_states)
def test_about_any_state_the_model_matches_differences(name, q, v, strut_state):
    """Derivatives by state and by road, including a lifted wheel and manoeuvre moments."""
    plant, state, z_r = (
        MANOEUVRE_PLANTS[name],
        np.concatenate([q, v]),
        np.array([0.0, 0.01, -0.15, 0.0]),
    )
    model = linearise(plant, strut_state, PLACES, state, z_r, 0.1 * z_r)

    def motion_and_sensors(x, u):
        a = compute_accelerations(plant, strut_state, x[:7], x[7:], z_r + u[:4], 0.1 * z_r + u[4:])
        return np.append(a, [oracles.point_acceleration(*a[:3], *at) for at in PLACES.values()])

    rng, eps = np.random.default_rng(0), 1e-7
    for _ in range(2):
        dx, du = rng.standard_normal(14), rng.standard_normal(8)
        there, back = (motion_and_sensors(state + s * dx, s * du) for s in (eps, -eps))
        slope = (there - back) / (2.0 * eps)
        actual = np.append(model.A[7:] @ dx + model.B[7:] @ du, model.C @ dx + model.D @ du)
        np.testing.assert_allclose(actual, slope, atol=1e-3 * np.abs(slope).max())


@every_car
@every_mode
@pytest.mark.parametrize("f", [0.4, 1.0, 8.0, 16.0])
@pytest.mark.costly
def test_the_frequency_response_matches_a_scipy_simulation(name, mode, f):
    damping = gaussian_damping(CARS[name], mode, 0.2)
    model, omega = linearise(PLANTS[name], mode, PLACES, damping=damping), 2.0 * np.pi * f
    step = min(0.002, 0.008 / f)
    response, t = _wheel_response(model, np.array([f]))[0], step * np.arange(round(25.0 / step))
    last = slice(t.size - round(5.0 / step), None)  # whole periods
    for wheel in (0, 3):
        u = np.zeros((t.size, 8))
        u[:, wheel], u[:, 4 + wheel] = np.cos(omega * t), -omega * np.sin(omega * t)
        _, a, _ = signal.lsim((model.A, model.B, model.C, model.D), u, t)
        actual = 2.0 * np.mean(a[last] * np.exp(-1j * omega * t[last, None]), axis=0)
        expected = response[:, wheel]
        np.testing.assert_allclose(actual, expected, atol=1e-3 * np.abs(expected).max())


@every_car
@every_mode
def test_rear_wheels_respond_with_the_wheelbase_delay(name, mode):
    car, v, f = CARS[name], 11.0, np.array([0.3, 1.0, 2.7, 8.0, 15.0, 40.0])
    c_s = gaussian_damping(car, mode, 0.2)
    model = linearise(car, mode, PLACES, damping=c_s)
    actual = frequency_response(model, v, f=f)
    np.testing.assert_array_equal(actual, frequency_response(model, v, n=f / v))
    matrices = energy_matrices(name, mode, c_s[[0, 2]])
    for k, each in enumerate(f):
        behind = np.exp(-2j * np.pi * each * car.wheelbase / v)
        for side in range(2):
            road = np.zeros(4, dtype=complex)
            road[[side, 2 + side]] = 1.0, behind
            a = oracles.response(matrices, each, road)
            expected = [a[0] - x * a[2] + y * a[1] for x, y in PLACES.values()]
            np.testing.assert_allclose(actual[k, :, side], expected, rtol=1e-6)


@cache
def equal_axles_car():
    """Return the Defender with equal axles: its centre of mass is midway between them."""
    half = 0.5 * DEFENDER.wheelbase
    return replace(
        DEFENDER,
        front=replace(DEFENDER.front, x=half),
        rear=replace(DEFENDER.rear, x=-half),
    )


def roll_by_difference(car, mode, n):
    """Return the gain [rad/s² per m] of body roll for wheel paths in antiphase."""
    model = linearise(car, mode, {"left": (0.0, 0.5), "right": (0.0, -0.5)})
    H = frequency_response(model, 6.0, n=n)
    return np.abs((H[:, 0] - H[:, 1]) @ [0.5, -0.5])


@every_mode
def test_equal_axles_cancel_roll_at_odd_multiples_of_1_over_2l(mode):
    car = equal_axles_car()
    notches = (2.0 * np.arange(5) + 1.0) / (2.0 * car.wheelbase)
    np.testing.assert_allclose(notches, [0.179, 0.537, 0.895, 1.253, 1.611], atol=6e-4)
    between = np.arange(1, 6) / car.wheelbase
    seen, unseen = (roll_by_difference(car, mode, n) for n in (between, notches))
    assert (unseen < 1e-9 * seen).all()
    near = roll_by_difference(DEFENDER, mode, notches)  # the axles' lever arms differ by 4 mm
    assert (near < 3e-3 * roll_by_difference(DEFENDER, mode, between)).all()


def test_unequal_modes_of_the_axles_remove_the_roll_cancellation():
    notches = (2.0 * np.arange(5) + 1.0) / (2.0 * equal_axles_car().wheelbase)
    between = np.arange(1, 6) / equal_axles_car().wheelbase
    seen = roll_by_difference(equal_axles_car(), SPLIT, notches)
    assert (seen > 0.05 * roll_by_difference(equal_axles_car(), SPLIT, between)).all()


# --- natural modes --------------------------------------------------------------------------------


@every_mode
def test_the_defender_has_the_tabulated_natural_modes(mode):
    actual = natural_modes(linearise(DEFENDER, mode, BODY))
    np.testing.assert_allclose(actual.f, oracles.MODES_HZ[mode], atol=1.5e-3)
    kinds = ("roll", "bounce", "pitch", *("axle hop",) * 2, *("axle roll",) * 2)
    assert all(kind in name for kind, name in zip(kinds, actual.names, strict=True))
    assert sorted(actual.names) == sorted(NATURAL_MODE_NAMES[:7])


@every_car
@every_mode
def test_natural_modes_match_the_energy_matrices_and_their_names(name, mode):
    actual = natural_modes(linearise(PLANTS[name], mode, BODY))
    M, C, K, _, _ = energy_matrices(name, mode)
    np.testing.assert_allclose(actual.f, oracles.natural_frequencies(M, K), rtol=1e-6)
    omega, phi = 2.0 * np.pi * actual.f, actual.shapes
    np.testing.assert_allclose(phi.T @ M @ phi, np.eye(7), atol=1e-12)
    np.testing.assert_allclose(phi.T @ K @ phi, np.diag(omega**2), atol=1e-4 * omega[-1] ** 2)
    np.testing.assert_allclose(2.0 * actual.zeta * omega, np.diag(phi.T @ C @ phi), rtol=1e-5)
    carrier = {"bounce": "z_b", "roll": "phi", "pitch": "theta"}
    carrier |= {"front axle hop": "z_af", "front axle roll": "phi_af"}
    carrier |= {"rear axle hop": "z_ar", "rear axle roll": "phi_ar"}
    for column, mode_name in enumerate(actual.names):
        at = DOF.index(carrier[mode_name])
        assert phi[at, column] > 0.0 and M[at, at] * phi[at, column] ** 2 > 0.45


def test_poles_of_a_lightly_damped_car_match_modal_damping_ratios():
    tyres = {"c_t": 60.0}
    car = replace(
        CARS["unequal_axles"],
        front=replace(CARS["unequal_axles"].front, **tyres),
        rear=replace(CARS["unequal_axles"].rear, **tyres),
    )
    model = linearise(car, "ride", BODY, damping=np.full(4, 40.0))
    actual, poles = natural_modes(model), np.linalg.eigvals(model.A)
    poles = poles[poles.imag > 0.0]
    poles = poles[np.argsort(np.abs(poles))]
    np.testing.assert_allclose(np.abs(poles) / (2.0 * np.pi), actual.f, rtol=1e-4)
    np.testing.assert_allclose(-poles.real / np.abs(poles), actual.zeta, rtol=5e-3)


def test_a_high_centre_of_mass_lowers_the_roll_frequency():
    straight, manoeuvre = (
        natural_modes(linearise(plant["defender"], "ride", BODY))
        for plant in (PLANTS, MANOEUVRE_PLANTS)
    )
    square = [m.f[m.names.index("roll")] ** 2 for m in (straight, manoeuvre)]
    lever = DEFENDER.m_b * oracles.G * (DEFENDER.h_cg - DEFENDER.roll_centre)
    less = (square[0] - square[1]) * (2.0 * np.pi) ** 2 * DEFENDER.I_xx
    assert less == pytest.approx(lever, rel=0.05)  # tolerance: the axles roll as well


def test_an_airborne_vehicle_has_no_natural_modes():
    model = linearise(PLANTS["unequal_axles"], "ride", BODY, np.zeros(14), np.full(4, -1.0))
    with pytest.raises(ArithmeticError, match="not positive definite"):
        natural_modes(model)


# --- damping on a road ----------------------------------------------------------------------------


@every_car
@every_mode
@pytest.mark.parametrize("rate", [0.005, 0.05, 0.3])
def test_gaussian_damping_is_the_least_squares_damper_for_a_normal_rate(name, mode, rate):
    car = CARS[name]
    curves = [
        oracles.CubicCurve(getattr(law, mode)) for law in (car.strut.damper, car.strut.friction)
    ]

    def force_times_rate(x):
        return sum(float(c(rate * x)) for c in curves) * x * stats.norm.pdf(x)

    points = [0.02 / rate * k for k in (-5, -1, 0, 1, 5) if abs(0.02 / rate * k) < 8.0]
    mean, _ = integrate.quad(force_times_rate, -8.0, 8.0, points=points, limit=200)
    np.testing.assert_allclose(gaussian_damping(car, mode, rate), mean / rate, rtol=1e-4)


def test_gaussian_damping_of_a_linear_damper_is_its_constant():
    nothing, line = Curve(x=(-3.0, 3.0), F=(0.0, 0.0)), Curve(x=(-3.0, 3.0), F=(-6000.0, 6000.0))
    strut = replace(
        DEFENDER.strut,
        damper=_ModeCurves(ride=nothing, handling=line),
        friction=_ModeCurves(ride=nothing, handling=nothing),
    )
    actual = gaussian_damping(replace(DEFENDER, strut=strut), SPLIT, np.array([0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_allclose(actual, [0.0, 0.0, 2000.0, 2000.0], rtol=1e-6, atol=1e-9)


def test_given_damping_replaces_the_strut_slopes_in_the_model():
    target = np.array([1000.0, 2000.0, 3000.0, 4000.0])
    with_it = linearise(PLANTS["unequal_axles"], "ride", BODY, damping=target)
    without = linearise(PLANTS["unequal_axles"], "ride", BODY, damping=np.zeros(4))
    difference = -with_it.M[:, None] * (with_it.A - without.A)[7:, 7:]
    car, signs = CARS["unequal_axles"], np.array([1.0, -1.0, 1.0, -1.0])
    expected = np.zeros((7, 7))
    for w, axle in enumerate((car.front, car.front, car.rear, car.rear)):
        strut = np.zeros(7)
        strut[:3] = 1.0, signs[w] * axle.y_s, -axle.x
        strut[3 + 2 * (w // 2) : 5 + 2 * (w // 2)] = -1.0, -signs[w] * axle.y_s
        expected += target[w] * np.outer(strut, strut)
    np.testing.assert_allclose(difference, expected, atol=1e-6)


# --- names and errors -----------------------------------------------------------------------------


def test_states_inputs_and_sensors_have_names():
    instruments, car = load_instruments("paper"), DEFENDER
    model = linearise(car, "ride", instruments.locations(car))
    assert model.sensors == ("RF", "LR", "RR") and model.wheelbase == car.wheelbase
    assert len(model.states) == model.A.shape[0] == 14
    assert len(model.inputs) == model.B.shape[1] == 8
    assert model.states[13] == "phi_ar_dot" and model.inputs[6] == "w_RL"


def test_parameters_and_plant_give_the_same_model():
    ground = np.array([0.02, -0.01, -0.015, 0.01])
    by_car = linearise(CARS["unequal_axles"], "ride", BODY, z_r=ground)
    strut_state = settled_strut_state(encode_command("ride"))
    state = equilibrium(PLANTS["unequal_axles"], strut_state, ground)
    by_plant = linearise(PLANTS["unequal_axles"], strut_state, BODY, state, ground, ZEROS)
    np.testing.assert_array_equal(by_car.A, by_plant.A)
    np.testing.assert_array_equal(by_car.D, by_plant.D)


def test_invalid_arguments_raise_errors():
    model = linearise(DEFENDER, "ride", BODY)
    with pytest.raises(ValueError, match="not both or neither"):
        frequency_response(model, 10.0)
    with pytest.raises(ValueError, match="not both or neither"):
        frequency_response(model, 10.0, f=np.ones(2), n=np.ones(2))
    with pytest.raises(ValueError, match="speed must be positive"):
        frequency_response(model, 0.0, f=np.ones(2))
    with pytest.raises(ValueError, match="must be positive"):
        gaussian_damping(DEFENDER, "ride", 0.0)
    with pytest.raises(ValueError, match="state must be of shape"):
        linearise(DEFENDER, "ride", BODY, np.zeros(7))
    with pytest.raises(ArithmeticError, match="no static equilibrium"):
        linearise(DEFENDER, "ride", BODY, z_r=np.array([np.nan, 0.0, 0.0, 0.0]))
