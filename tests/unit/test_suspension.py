"""Force laws, accumulators and valves of a strut; the tyre; properties of the shipped curves."""

import numpy as np
import oracles
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from vehicle_fixtures import CARS, DEFENDER, PLANTS, VARIED, VARIED_PLANTS, strut_states

from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import (
    DAMPING_HIGH,
    HELD_EXTENSION,
    MODES,
    VALVE_OPEN,
    advance_valve,
    decode_commands,
    encode_command,
    settled_strut_state,
    strut_force,
    valves_settled,
)
from road_envs.vehicle.tyres import tyre_curvature, tyre_force

STRUT = DEFENDER.strut
V = np.linspace(0.0, 2.5, 501)[1:]
every_mode = pytest.mark.parametrize("mode", ["ride", "handling"])
every_car = pytest.mark.parametrize("name", CARS)
both_axles = pytest.mark.parametrize("w", [0, 1, 2, 3])


def force(strut_state, e, e_dot=0.0, w=0, name="defender"):
    return strut_force(PLANTS[name].buffers(strut_state), w, e, e_dot)


# --- the gas spring -------------------------------------------------------------------------------


@every_mode
@given(e=st.floats(-0.03, 0.02))
def test_with_bushing_and_stop_inactive_the_strut_force_is_equation_1(mode, e):
    expected = oracles.gas_force(oracles.X_STAT[mode], e)
    assert force(settled_strut_state(encode_command(mode)), e)[0] == pytest.approx(
        expected, rel=1e-14
    )


def test_static_spring_rates_are_16_7_and_83_6_kn_per_m():
    for mode, printed in (("ride", 16.7e3), ("handling", 83.6e3)):
        rate = force(settled_strut_state(encode_command(mode)), 0.0)[1]
        assert rate == pytest.approx(oracles.static_rate(mode), rel=1e-12)
        assert rate == pytest.approx(printed, abs=50.0)


@every_car
@both_axles
@given(strut_states, st.floats(-0.3, 0.3), st.floats(-4.0, 4.0))
@pytest.mark.costly
def test_a_strut_force_is_the_sum_of_its_five_components(name, w, strut_state, e, e_dot):
    oracle = oracles.NonlinearCar(CARS[name])
    moved = np.full(4, e), np.full(4, e_dot)
    F, k, _ = force(strut_state, e, e_dot, w, name)
    expected = oracle.strut_forces(strut_state, *moved)[w]
    assert F == pytest.approx(expected, rel=1e-9, abs=1e-6)
    assert k > 0.0


@given(strut_states, st.floats(-0.2, 0.2), st.floats(-3.0, 3.0))
def test_compiled_and_interpreted_strut_forces_agree(strut_state, e, e_dot):
    plant = PLANTS["unequal_axles"]
    plain = plant.buffers(strut_state)._replace(constants=plant.constants.view(np.recarray))
    expected = strut_force.py_func(plain, 2, e, e_dot)
    actual = force(strut_state, e, e_dot, 2, "unequal_axles")
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-9)


def test_below_its_shortest_column_the_gas_force_is_linear():
    strut_state = settled_strut_state(encode_command("handling"))
    least = STRUT.column_min - STRUT.x_1
    assert force(strut_state, least - 1e-9)[0] == pytest.approx(
        force(strut_state, least + 1e-9)[0], rel=1e-6
    )
    F, k, _ = force(strut_state, least)
    beyond = force(strut_state, least - 0.002)
    assert beyond[0] > F and np.isfinite(beyond[0])
    assert beyond[1] == pytest.approx(k, rel=1e-3)
    assert np.isfinite(force(strut_state, -1.0)[0])


# --- the second accumulator and the valves --------------------------------------------------------


def taken_up(strut_state, w, e, car):
    """Return e_2, the part of the extension in the second accumulator [m]."""
    return (
        strut_state[w, HELD_EXTENSION]
        + strut_state[w, VALVE_OPEN] * car.strut.x_2 / (car.strut.x_1 + car.strut.x_2) * e
    )


def operate(strut_state, path, stiff, high, car=DEFENDER, name="defender", h=0.001):
    """Move strut 0 through extensions `path` (N,), one per step; return e_2 after each step."""
    alpha = 1.0 - np.exp(-h / car.valve.lag)
    actual = np.empty(path.size)
    for n, e in enumerate(path):
        advance_valve(PLANTS[name].constants[0], strut_state, 0, e, (stiff, high), alpha, h)
        actual[n] = taken_up(strut_state, 0, e, car)
    return actual


@every_car
@pytest.mark.parametrize("stiff", [False, True])
def test_the_second_accumulator_follows_its_ode_through_a_switch(name, stiff):
    car, h = CARS[name], 2e-5
    t = h * np.arange(round(0.25 / h))
    ratio = car.strut.x_2 / (car.strut.x_1 + car.strut.x_2)
    e = lambda t: 0.03 * np.sin(20.0 * t + 0.7)  # noqa: E731
    e_dot = lambda t: 0.6 * np.cos(20.0 * t + 0.7)  # noqa: E731
    strut_state = settled_strut_state(encode_command("ride" if stiff else "handling"))
    e_2_0 = taken_up(strut_state, 0, e(0.0), car)
    actual = operate(strut_state, e(t), stiff, False, car, name, h)
    expected = oracles.second_accumulator(
        e, e_dot, stiff, t, u_0=float(stiff), e_2_0=e_2_0, ratio=ratio,
        lag=car.valve.lag, equalisation=car.valve.equalisation,
    )  # fmt: skip
    np.testing.assert_allclose(actual, expected, atol=0.004 * np.abs(expected).max())


def test_a_closed_valve_traps_the_gas_behind_it():
    strut_state = settled_strut_state(encode_command("ride"))
    operate(strut_state, np.full(300, 0.02), True, True)
    assert strut_state[0, VALVE_OPEN] == 0.0 and valves_settled(strut_state, 0, (True, True))
    before = taken_up(strut_state, 0, 0.02, DEFENDER)
    after = operate(strut_state, 0.03 * np.sin(np.arange(200.0)), True, True)
    assert (after == before).all()
    assert before == pytest.approx(0.02 * STRUT.x_2 / 0.255, rel=1e-12)


@every_car
def test_pressures_equalise_behind_an_open_valve_of_any_speed(name):
    """The valve of the car with unequal axles opens much faster than the pressures equalise."""
    car, e = CARS[name], 0.025
    strut_state = settled_strut_state(encode_command("handling"))
    while not valves_settled(strut_state, 0, (False, False)):
        operate(strut_state, np.full(1, e), False, False, car, name)
    first = car.strut.x_1 / (car.strut.x_1 + e - taken_up(strut_state, 0, e, car))
    second = car.strut.x_2 / (car.strut.x_2 + taken_up(strut_state, 0, e, car))
    assert first == pytest.approx(second, rel=1e-10)
    assert strut_state[0] == pytest.approx([0.0, 1.0, 0.0], abs=0.0)


@given(strut_states, st.floats(-0.03, 0.03), st.booleans(), st.booleans(), st.floats(1e-5, 0.1))
def test_valve_motion_at_equal_pressures_leaves_the_gas_force_unchanged(
    strut_state, e, stiff, high, h
):
    """At equal pressures there is no flow at any position and motion of the valve."""
    strut_state[0, HELD_EXTENSION] = (1.0 - strut_state[0, VALVE_OPEN]) * e * STRUT.x_2 / 0.255
    before = force(strut_state, e)[0]
    operate(strut_state, np.full(3, e), stiff, high, h=h)
    assert force(strut_state, e)[0] == pytest.approx(before, rel=1e-12)


def test_damping_follows_the_first_order_lag_of_the_valve():
    strut_state = settled_strut_state(encode_command("ride"))
    low, high = (
        force(strut_state, 0.0, 0.5)[0],
        force(settled_strut_state(encode_command("soft_high")), 0.0, 0.5)[0],
    )
    for n in range(1, 40):
        operate(strut_state, np.zeros(1), False, True)
        expected = low + (high - low) * (1.0 - np.exp(-0.001 * n / DEFENDER.valve.lag))
        assert force(strut_state, 0.0, 0.5)[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("mode", MODES)
def test_valves_settle_from_every_mode_to_every_other(mode):
    stiff, high = MODES[mode]
    for other in MODES:
        strut_state = settled_strut_state(encode_command(other))
        assert valves_settled(strut_state, 0, MODES[other])
        operate(strut_state, np.zeros(400), stiff, high)
        np.testing.assert_array_equal(strut_state[0], settled_strut_state(encode_command(mode))[0])


# --- commands -------------------------------------------------------------------------------------


def test_a_command_can_address_vehicle_axle_or_strut():
    stiff, high = decode_commands(np.array([encode_command("stiff_low")]))
    assert stiff.all() and not high.any()
    stiff, high = decode_commands(np.array([encode_command({"front": "ride", "rear": "handling"})]))
    assert stiff[0].tolist() == high[0].tolist() == [False, False, True, True]
    single = {"FL": "ride", "FR": "soft_high", "RL": "stiff_low", "RR": "handling"}
    stiff, high = decode_commands(np.array([encode_command(single)]))
    assert stiff[0].tolist() == [False, False, True, True]
    assert high[0].tolist() == [False, True, False, True]


@given(st.lists(st.integers(0, 255), min_size=1, max_size=9))
def test_command_bytes_decode_to_valve_flags_and_settled_states(bytes_):
    stiff, high = decode_commands(np.array(bytes_))
    for byte, s, d in zip(bytes_, stiff, high, strict=True):
        assert byte == sum((int(s[w]) << w) | (int(d[w]) << (4 + w)) for w in range(4))
        strut_state = settled_strut_state(byte)
        assert (strut_state[:, VALVE_OPEN] == ~s).all() and (
            strut_state[:, DAMPING_HIGH] == d
        ).all()


@pytest.mark.parametrize(
    ("mode", "reason"),
    [
        ("comfort", "unknown suspension mode 'comfort'; known: handling, passive, ride"),
        ("handlng", "did you mean 'handling'"),
        ({"front": "ride"}, "front and rear"),
        ({"front": "ride", "rear": "soft"}, "unknown suspension mode 'soft'"),
        (3, "unknown suspension mode 3"),
    ],
)
def test_an_unknown_mode_raises_config_error(mode, reason):
    with pytest.raises(ConfigError, match=reason):
        encode_command(mode)


# --- the tyre -------------------------------------------------------------------------------------


TYRES = {**PLANTS, "varied": VARIED_PLANTS["varied"]}
every_tyre = pytest.mark.parametrize("name", TYRES)
wheels = st.integers(0, 3)
compressions, rates = st.floats(-0.4, 0.2), st.floats(-5.0, 5.0)


def tyre(name, w, u, u_dot):
    """Return load, stiffness and damping of a tyre, and the load of its spring alone."""
    p = TYRES[name].constants[0]
    return *tyre_force(p, w, u, u_dot), tyre_force(p, w, u, 0.0)[0]


@every_tyre
@given(wheels, compressions, rates)
def test_a_tyre_load_is_spring_plus_limited_damper_and_never_negative(name, w, u, u_dot):
    """The damper opposes the motion and its force never exceeds that of the spring."""
    variation = {"varied": VARIED}.get(name, oracles.NOMINAL)
    oracle = oracles.NonlinearCar(CARS.get(name, CARS["unequal_axles"]), variation)
    k, c = oracle.tyre_coefficients(w, u, u_dot)
    T, _, damping, spring = tyre(name, w, u, u_dot)
    assert T == pytest.approx(k * (u + oracle.delta[w]) + c * u_dot, rel=1e-9, abs=1e-6)
    assert damping == c
    assert 0.0 <= T <= 2.0 * spring
    assert (T - spring) * u_dot >= 0.0


@every_tyre
@given(wheels, st.floats(1e-9, 0.3), rates)
def test_an_airborne_tyre_has_no_load_and_contact_starts_without_a_jump(name, w, above, u_dot):
    contact = -TYRES[name].constants[0]["delta"][w // 2]
    assert tyre(name, w, contact - above, u_dot) == (0.0, 0.0, 0.0, 0.0)
    load = tyre(name, w, contact + 1e-9, u_dot)[0]
    assert 0.0 <= load < 1e-3  # a damper without a limit would cause a jump of the load


@every_tyre
@given(wheels, compressions, rates)
def test_tyre_stiffness_damping_and_curvature_match_differences(name, w, u, u_dot):
    delta, c_t = (TYRES[name].constants[0][key] for key in ("delta", "c_t"))
    _, k, c, spring = tyre(name, w, u, u_dot)
    kinks = np.array([delta[w // 2] + u, spring + c_t[w] * u_dot, spring - c_t[w] * u_dot])
    assume((np.abs(kinks) > [1e-4, 1.0, 1.0]).all())
    d = 1e-6
    by_u = (tyre(name, w, u + d, u_dot)[0] - tyre(name, w, u - d, u_dot)[0]) / (2.0 * d)
    by_rate = (tyre(name, w, u, u_dot + d)[0] - tyre(name, w, u, u_dot - d)[0]) / (2.0 * d)
    assert (k, c) == (pytest.approx(by_u, rel=1e-6), pytest.approx(by_rate, rel=1e-6, abs=1e-6))
    bend = (tyre(name, w, u + d, u_dot)[1] - tyre(name, w, u - d, u_dot)[1]) / (2.0 * d)
    actual = tyre_curvature(TYRES[name].constants[0], w, u, u_dot)
    assert actual == pytest.approx(bend, rel=1e-4, abs=1e-3)


def test_a_tyre_load_on_a_nan_height_is_not_finite():
    for u in (np.nan, np.inf):
        assert not np.isfinite(tyre_force(PLANTS["defender"].constants[0], 0, u, 0.0)[0])


# --- properties of the shipped curves -------------------------------------------------------------


def test_handling_damping_exceeds_ride_damping_at_every_velocity():
    for v in (V, -V):
        low, high = STRUT.damper.ride(v)[0], STRUT.damper.handling(v)[0]
        assert (np.sign(v) * low > 0.0).all() and (np.abs(high) > 1.5 * np.abs(low)).all()


def test_dampers_are_digressive_and_stronger_in_rebound():
    for curve, bump, rebound in (
        (STRUT.damper.ride, 1200.0, 2600.0),
        (STRUT.damper.handling, 3500.0, 6500.0),
    ):
        assert (curve(V)[0] > -curve(-V)[0]).all()
        for v, slope in ((-0.1, bump), (0.1, rebound)):
            assert curve(np.array(v))[0] / v == pytest.approx(slope, rel=0.01)
            assert curve(10.0 * np.array(v))[0] / (10.0 * v) < 0.7 * slope


@every_mode
def test_friction_peaks_at_2_cm_per_s_and_falls_beyond(mode):
    friction, damper = getattr(STRUT.friction, mode), getattr(STRUT.damper, mode)
    v = np.linspace(0.0, 1.0, 10001)
    for sign in (1.0, -1.0):
        F = sign * friction(sign * v)[0]
        assert v[np.argmax(F)] == pytest.approx(0.02, abs=1e-4)
        assert F.max() == pytest.approx(1.5 * F[-1], rel=0.02)
        assert (np.diff(F[v > 0.021]) <= 1e-9).all()
    assert friction(V)[0].max() < 0.5 * damper(V)[0].max()
    assert np.abs(friction(np.array([1.0]))[0]) < np.abs(damper(np.array([1.0]))[0])


def test_friction_is_greater_in_handling():
    assert (STRUT.friction.handling(V)[0] > STRUT.friction.ride(V)[0]).all()
    levels = [getattr(STRUT.friction, m)(np.array(1.0))[0] for m in ("ride", "handling")]
    assert levels == pytest.approx([150.0, 250.0])


def test_the_bushing_is_soft_within_its_range_and_exponential_beyond():
    F = STRUT.bushing(np.linspace(-0.1, 0.05, 301))[0]
    assert np.abs(F).max() <= 60.0
    for beyond in (np.linspace(0.065, 0.11, 4), np.linspace(-0.115, -0.16, 4)):
        growth = np.abs(STRUT.bushing(beyond)[0])
        ratios = growth[1:] / growth[:-1]
        assert (ratios > 2.0).all() and ratios.max() / ratios.min() < 1.6


def test_the_rear_struts_have_more_working_space_than_the_front():
    front, rear = STRUT.bump_stop.front, STRUT.bump_stop.rear
    e = np.linspace(-0.2, 0.2, 801)
    for stop in (front, rear):
        F = stop(e)[0]
        assert (np.diff(F) >= 0.0).all() and F[0] < -20e3 and F[-1] > 20e3
    free = [e[np.abs(stop(e)[0]) < 1.0] for stop in (front, rear)]
    assert free[1].min() < free[0].min() - 0.01 and free[1].max() > free[0].max() + 0.01


def test_bushing_and_stop_forces_oppose_the_extension():
    for curve in (STRUT.bushing, STRUT.bump_stop.front, STRUT.bump_stop.rear):
        x = np.array(curve.x)
        assert (np.sign(x) * curve.F >= 0.0).all()


def test_the_shipped_valve_reaches_95_percent_within_50_ms():
    valve = config.load(VehicleParameters, "vehicles", "land_rover_defender_110").valve
    assert 1.0 - np.exp(-(0.050 - valve.delay) / valve.lag) >= 0.95
    assert 0.040 <= valve.delay + 3.0 * valve.lag <= 0.100
