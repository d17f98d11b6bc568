"""Equations of motion against the paper's own notation, energy matrices and virtual work."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from vehicle_fixtures import (
    CARS,
    DEFENDER,
    MANOEUVRE_PLANTS,
    PLANTS,
    ZEROS,
    compute_accelerations,
    coordinates,
    lossless,
    rates,
    strut_states,
    vectors,
)

from road_envs.vehicle.equations import accelerations, build_plant
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.linear_model import jacobian
from road_envs.vehicle.suspension import encode_command, settled_strut_state

ORACLES = {name: oracles.NonlinearCar(car) for name, car in CARS.items()}
LOSSLESS = {name: build_plant(lossless(car)) for name, car in CARS.items()}
MODES = ("ride", "handling")
every_car = pytest.mark.parametrize("name", CARS)
every_mode = pytest.mark.parametrize("mode", MODES)


@every_car
@given(coordinates, rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_accelerations_match_the_papers_corrected_equations(name, q, v, strut_state, z_r, w_r):
    expected = ORACLES[name].accelerations(strut_state, q, v, z_r, w_r)
    actual = compute_accelerations(PLANTS[name], strut_state, q, v, z_r, w_r)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-7)


@every_car
@given(coordinates, rates, strut_states, vectors(2, 5.0))
def test_in_a_manoeuvre_the_body_is_an_inverted_pendulum(name, q, v, strut_state, a_xy):
    car = CARS[name]
    manoeuvre = car.h_cg - car.roll_centre, car.h_cg - car.pitch_centre, *a_xy
    expected = ORACLES[name].accelerations(strut_state, q, v, ZEROS, ZEROS, manoeuvre)
    actual = compute_accelerations(MANOEUVRE_PLANTS[name], strut_state, q, v, a_xy=a_xy)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-7)
    nominal = compute_accelerations(PLANTS[name], strut_state, q, v)
    np.testing.assert_array_equal(
        compute_accelerations(PLANTS[name], strut_state, q, v, a_xy=a_xy), nominal
    )


@given(coordinates, rates, strut_states, vectors(4, 0.15))
def test_accelerations_match_the_paper_with_its_tyre_deflection_of_10_mm(q, v, strut_state, z_r):
    car = replace(CARS["unequal_axles"], tyre_static_deflection=0.010)
    expected = oracles.NonlinearCar(car).accelerations(strut_state, q, v, z_r, ZEROS)
    actual = compute_accelerations(build_plant(car), strut_state, q, v, z_r)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-7)


FAR = vectors(7, 0.05, 0.05, 0.03, 0.05, 0.05, 0.05, 0.05)
far = st.tuples(FAR, st.just(settled_strut_state(encode_command("ride"))))
near = st.tuples(
    vectors(7, 0.008, 0.008, 0.004, 0.008), strut_states.map(lambda m: m * [0.2, 1, 1])
)


@every_car
@given(far | near, vectors(4, 0.1))
def test_conservative_forces_are_minus_the_gradient_of_the_energy(name, q_and_memory, z_r):
    oracle, rest, d = ORACLES[name], np.zeros(7), 1e-6
    q, strut_state = q_and_memory
    slope = np.array(
        [
            oracle.energy(strut_state, q + d * unit, rest, z_r)
            - oracle.energy(strut_state, q - d * unit, rest, z_r)
            for unit in np.eye(7)
        ]
    ) / (2.0 * d)
    M = PLANTS[name].constants[0]["M"]
    actual = M * compute_accelerations(PLANTS[name], strut_state, q, rest, z_r)
    np.testing.assert_allclose(actual, -slope, rtol=1e-5, atol=1.0)


@every_car
@given(coordinates, rates, strut_states)
def test_losses_never_add_energy_on_a_stationary_road(name, q, v, strut_state):
    losing, free = PLANTS[name], LOSSLESS[name]
    M = losing.constants[0]["M"]
    power = (
        M
        * v
        @ (
            compute_accelerations(losing, strut_state, q, v)
            - compute_accelerations(free, strut_state, q, v)
        )
    )
    assert power <= 1e-9


@every_car
@every_mode
def test_small_motions_match_stiffness_and_damping_from_energy(name, mode):
    car = CARS[name]
    free, strut_state = build_plant(lossless(car)), settled_strut_state(encode_command(mode))
    column = car.strut.x_1 + (car.strut.x_2 if mode == "ride" else 0.0)
    rate = car.strut.n_p * car.strut.p_stat * car.strut.A / column
    M, C, K, K_r, _ = oracles.linear_matrices(lossless(car), (rate, rate))
    rng = np.random.default_rng(0)
    at_rest = compute_accelerations(free, strut_state, np.zeros(7), np.zeros(7))
    for _ in range(20):
        q, v, z_r = (1e-7 * rng.standard_normal(n) for n in (7, 7, 4))
        expected = np.linalg.solve(M, K_r @ z_r - K @ q - C @ v)
        actual = compute_accelerations(free, strut_state, q, v, z_r) - at_rest
        np.testing.assert_allclose(actual, expected, atol=3e-5 * np.abs(expected).max())


@every_mode
def test_oracle_matrices_have_the_published_natural_frequencies(mode):
    rate = oracles.static_rate(mode)
    M, _, K, _, _ = oracles.linear_matrices(oracles.PAPER_CAR, (rate, rate))
    np.testing.assert_allclose(
        oracles.natural_frequencies(M, K), oracles.MODES_HZ[mode], atol=0.0005
    )


def frequencies(free, strut_state, state):
    """Return the undamped frequencies [Hz] of a plant without losses, from its Jacobian."""
    lower = jacobian(free, strut_state, state, ZEROS, ZEROS)[7:, :7]
    return np.sort(np.sqrt(np.linalg.eigvals(-lower).real)) / (2.0 * np.pi)


@every_mode
def test_the_equations_have_the_published_natural_frequencies(mode):
    """At the origin the gas has its nominal pressure and the published digits must be reproduced.

    At equilibrium the strut force follows from the weight: it is 0.1 % larger at the front and
    0.2 % smaller at the rear. The spring rate is proportional to the square of the force (the gas
    column shortens as well), the frequency to the root of the rate: hence the tolerance of 0.2 %.
    """
    free, strut_state = build_plant(lossless(DEFENDER)), settled_strut_state(encode_command(mode))
    at_origin = frequencies(free, strut_state, np.zeros(14))
    np.testing.assert_allclose(at_origin, oracles.MODES_HZ[mode], atol=0.0005)
    at_rest = frequencies(free, strut_state, equilibrium(free, strut_state, ZEROS))
    np.testing.assert_allclose(at_rest, oracles.MODES_HZ[mode], rtol=0.002)


@every_car
@pytest.mark.parametrize("plants", [PLANTS, MANOEUVRE_PLANTS], ids=["straight", "manoeuvre"])
@given(coordinates, rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_the_jacobian_matches_central_differences(name, plants, q, v, strut_state, z_r, w_r):
    """The error of the differences of 1e-6 is about 1e-4 of a row: 1e-6 times the curvature of the
    bump stops (6e7 N/m² where they begin) over twice the spring rate there."""
    plant, d = plants[name], 1e-6
    car = ORACLES[name]
    y_t = np.array([a.y_t * side for a in (car.car.front, car.car.rear) for side in (1, -1)])
    height, rate = (x[[3, 3, 5, 5]] + y_t * x[[4, 4, 6, 6]] for x in (q, v))
    spring, damper = car.k_t * (car.delta + z_r - height), car.c_t * (w_r - rate)
    # there is no derivative at contact, at lift-off and where the damper force becomes limited
    assume((np.abs([spring, spring + damper, spring - damper]) > 5.0).all())
    slope = np.empty((7, 14))
    for j, unit in enumerate(d * np.eye(14)):
        ahead = compute_accelerations(plant, strut_state, q + unit[:7], v + unit[7:], z_r, w_r)
        behind = compute_accelerations(plant, strut_state, q - unit[:7], v - unit[7:], z_r, w_r)
        slope[:, j] = (ahead - behind) / (2.0 * d)
    actual = jacobian(plant, strut_state, np.concatenate([q, v]), z_r, w_r)
    np.testing.assert_array_equal(actual[:7], np.eye(7, 14, 7))
    for part in (slice(0, 7), slice(7, 14)):
        size = np.abs(slope[:, part]).max(axis=1, keepdims=True)
        np.testing.assert_allclose(actual[7:, part] / size, slope[:, part] / size, atol=2e-4)


@every_car
@given(coordinates, rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_mirroring_left_and_right_inverts_all_roll_accelerations(name, q, v, strut_state, z_r, w_r):
    signs, swap = np.array([1, -1, 1, 1, -1, 1, -1]), [1, 0, 3, 2]
    actual = compute_accelerations(
        PLANTS[name], strut_state[swap], signs * q, signs * v, z_r[swap], w_r[swap]
    )
    expected = signs * compute_accelerations(PLANTS[name], strut_state, q, v, z_r, w_r)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)


@every_car
@given(coordinates, rates, st.sampled_from(MODES), vectors(2, 0.1), vectors(2, 1.0))
def test_symmetric_motion_gives_exactly_zero_roll_acceleration(name, q, v, mode, z_r, w_r):
    roll = [1, 4, 6]
    q[roll] = v[roll] = 0.0
    strut_state = settled_strut_state(encode_command(mode))
    actual = compute_accelerations(
        PLANTS[name], strut_state, q, v, np.repeat(z_r, 2), np.repeat(w_r, 2)
    )
    assert (actual[roll] == 0.0).all()


@every_car
def test_an_airborne_axle_is_accelerated_by_gravity_and_strut_forces(name):
    car, plant = CARS[name], PLANTS[name]
    strut_state, q = settled_strut_state(encode_command("ride")), np.zeros(7)
    actual = compute_accelerations(plant, strut_state, q, np.zeros(7), z_r=np.full(4, -1.0))
    struts = 2.0 * car.strut.p_stat * car.strut.A
    for i, axle in enumerate((car.front, car.rear)):
        assert actual[3 + 2 * i] == pytest.approx(-oracles.G - struts / axle.m)
    everything = car.m_b * actual[0] + car.front.m * actual[3] + car.rear.m * actual[5]
    assert everything == pytest.approx(-oracles.G * (car.m_b + car.front.m + car.rear.m))


@every_car
@every_mode
def test_in_equilibrium_tyre_loads_match_statics(name, mode):
    car, plant = CARS[name], PLANTS[name]
    state = equilibrium(plant, settled_strut_state(encode_command(mode)), ZEROS)
    actual = compute_accelerations(
        plant, settled_strut_state(encode_command(mode)), state[:7], state[7:]
    )
    np.testing.assert_allclose(actual, 0.0, atol=1e-9)
    assert (state[[1, 4, 6]] == 0.0).all() and (state[7:] == 0.0).all()
    assert state[[3, 5]] == pytest.approx([0.0, 0.0], abs=1e-12)
    tyres = [a.k_t * d for a, d in zip(car.axles, car.tyre_deflections, strict=True)]
    np.testing.assert_allclose(tyres, oracles.static_loads(car)[1], rtol=1e-12)
    total = oracles.G * (car.m_b + car.front.m + car.rear.m)
    assert 2.0 * sum(tyres) == pytest.approx(total, rel=1e-12)


def test_static_tyre_deflection_of_the_defender_is_21_5_mm():
    np.testing.assert_allclose(DEFENDER.tyre_deflections, 0.0215, atol=5e-5)


GROUNDS = {
    "warped": [0.02, -0.01, -0.015, 0.01],
    "sloping to the right": [0.1, -0.1, 0.1, -0.1],
    "uphill": [0.0, 0.0, -0.2, -0.2],
    "below the datum": [-2.0, -2.0, -2.0, -2.0],
    "1300 m above the sea": [1300.1, 1300.0, 1300.0, 1299.9],
}


@every_car
@every_mode
@pytest.mark.parametrize("ground", GROUNDS.values(), ids=GROUNDS.keys())
def test_an_equilibrium_is_found_on_any_plausible_ground(name, mode, ground):
    strut_state, plant, ground = (
        settled_strut_state(encode_command(mode)),
        PLANTS[name],
        np.array(ground),
    )
    state = equilibrium(plant, strut_state, ground)
    actual = compute_accelerations(plant, strut_state, state[:7], state[7:], ground)
    np.testing.assert_allclose(actual, 0.0, atol=1e-9 * (1.0 + np.abs(ground).max()))
    heaves, rolls = 0.5 * (ground[::2] + ground[1::2]), ground[::2] - ground[1::2]
    np.testing.assert_allclose(state[[3, 5]], heaves, atol=0.01)
    assert (np.sign(state[[4, 6]]) == np.sign(rolls)).all()


def test_a_missing_equilibrium_raises_arithmetic_error():
    strut_state = settled_strut_state(encode_command("ride"))
    with pytest.raises(ArithmeticError, match="no static equilibrium"):
        equilibrium(PLANTS["unequal_axles"], strut_state, np.array([np.nan, 0.0, 0.0, 0.0]))


@every_car
@given(coordinates, rates, strut_states)
def test_compiled_and_interpreted_equations_agree(name, q, v, strut_state):
    actual = compute_accelerations(PLANTS[name], strut_state, q, v)
    plain = replace(PLANTS[name], constants=PLANTS[name].constants.view(np.recarray))
    plain = compute_accelerations(plain, strut_state, q, v, kernel=accelerations.py_func)
    np.testing.assert_allclose(actual, plain, rtol=1e-12, atol=1e-9)
