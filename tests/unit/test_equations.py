"""The equations of motion against the paper's own letters, energy matrices and virtual work."""

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

from road_envs.vehicle.equations import Plant, accelerations, build_plant, equilibrium, jacobian
from road_envs.vehicle.suspension import encode_command, settled_strut_state

ORACLES = {name: oracles.NonlinearCar(car) for name, car in CARS.items()}
FREE = {name: build_plant(lossless(car)) for name, car in CARS.items()}
MODES = ("ride", "handling")
every_car = pytest.mark.parametrize("name", CARS)
every_mode = pytest.mark.parametrize("mode", MODES)


@every_car
@given(coordinates, rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_the_car_moves_as_the_papers_equations_say(name, q, v, strut_state, z_r, w_r):
    expected = ORACLES[name].accelerations(strut_state, q, v, z_r, w_r)
    found = compute_accelerations(PLANTS[name], strut_state, q, v, z_r, w_r)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)


@every_car
@given(coordinates, rates, strut_states, vectors(2, 5.0))
def test_in_a_manoeuvre_the_body_leans_as_an_inverted_pendulum(name, q, v, strut_state, a_xy):
    car = CARS[name]
    lean = car.h_cg - car.roll_centre, car.h_cg - car.pitch_centre, *a_xy
    expected = ORACLES[name].accelerations(strut_state, q, v, ZEROS, ZEROS, lean)
    found = compute_accelerations(MANOEUVRE_PLANTS[name], strut_state, q, v, a_xy=a_xy)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)
    upright = compute_accelerations(PLANTS[name], strut_state, q, v)
    np.testing.assert_array_equal(
        compute_accelerations(PLANTS[name], strut_state, q, v, a_xy=a_xy), upright
    )


@given(coordinates, rates, strut_states, vectors(4, 0.15))
def test_the_ten_millimetre_option_moves_as_the_papers_equations_say(q, v, strut_state, z_r):
    car = replace(CARS["unequal_axles"], tyre_static_deflection=0.010)
    expected = oracles.NonlinearCar(car).accelerations(strut_state, q, v, z_r, ZEROS)
    found = compute_accelerations(build_plant(car), strut_state, q, v, z_r)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)


FAR = vectors(7, 0.05, 0.05, 0.03, 0.05, 0.05, 0.05, 0.05)
far = st.tuples(FAR, st.just(settled_strut_state(encode_command("ride"))))
near = st.tuples(
    vectors(7, 0.008, 0.008, 0.004, 0.008), strut_states.map(lambda m: m * [0.2, 1, 1])
)


@every_car
@given(far | near, vectors(4, 0.1))
def test_forces_are_the_slope_of_the_energy(name, q_and_memory, z_r):
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
    found = M * compute_accelerations(PLANTS[name], strut_state, q, rest, z_r)
    np.testing.assert_allclose(found, -slope, rtol=1e-5, atol=1.0)


@every_car
@given(coordinates, rates, strut_states)
def test_nothing_in_the_car_adds_energy_on_a_still_road(name, q, v, strut_state):
    losing, free = PLANTS[name], FREE[name]
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
def test_small_motions_follow_the_energy_matrices(name, mode):
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
        found = compute_accelerations(free, strut_state, q, v, z_r) - at_rest
        np.testing.assert_allclose(found, expected, atol=3e-5 * np.abs(expected).max())


@every_mode
def test_the_energy_matrices_have_the_printed_frequencies(mode):
    rate = oracles.static_rate(mode)
    M, _, K, _, _ = oracles.linear_matrices(oracles.PAPER_CAR, (rate, rate))
    np.testing.assert_allclose(
        oracles.natural_frequencies(M, K), oracles.MODES_HZ[mode], atol=0.0005
    )


def frequencies(free, strut_state, state):
    """Undamped frequencies [Hz] of a plant without losses, from its Jacobian."""
    lower = jacobian(free, strut_state, state, ZEROS, ZEROS)[7:, :7]
    return np.sort(np.sqrt(np.linalg.eigvals(-lower).real)) / (2.0 * np.pi)


@every_mode
def test_the_car_has_the_printed_frequencies(mode):
    """At the origin, where the gas has its nominal pressure, to the digits printed.

    At rest the body's weight and not the nominal pressure decides the force in a strut, which is
    0.1 % more in front and 0.2 % less behind. The rate goes with the square of the force (the gas
    column shortens as well), the frequency with its root: so 0.2 % here.
    """
    free, strut_state = build_plant(lossless(DEFENDER)), settled_strut_state(encode_command(mode))
    at_origin = frequencies(free, strut_state, np.zeros(14))
    np.testing.assert_allclose(at_origin, oracles.MODES_HZ[mode], atol=0.0005)
    at_rest = frequencies(free, strut_state, equilibrium(free, strut_state, ZEROS))
    np.testing.assert_allclose(at_rest, oracles.MODES_HZ[mode], rtol=0.002)


@every_car
@pytest.mark.parametrize("plants", [PLANTS, MANOEUVRE_PLANTS], ids=["straight", "leaning"])
@given(coordinates, rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_the_jacobian_is_the_slope_of_the_rates(name, plants, q, v, strut_state, z_r, w_r):
    """By central differences of 1e-6, whose error is that times the curvature of the bump stops
    (6e7 N/m² where they begin) over twice the rate that they then have: some 1e-4 of the row."""
    one, d = plants[name], 1e-6
    car = ORACLES[name]
    y_t = np.array([a.y_t * side for a in (car.car.front, car.car.rear) for side in (1, -1)])
    height, rate = (x[[3, 3, 5, 5]] + y_t * x[[4, 4, 6, 6]] for x in (q, v))
    spring, damper = car.k_t * (car.delta + z_r - height), car.c_t * (w_r - rate)
    # no derivative where a tyre just touches, just lifts off, or its damper just gives its most
    assume((np.abs([spring, spring + damper, spring - damper]) > 5.0).all())
    slope = np.empty((7, 14))
    for j, unit in enumerate(d * np.eye(14)):
        ahead = compute_accelerations(one, strut_state, q + unit[:7], v + unit[7:], z_r, w_r)
        behind = compute_accelerations(one, strut_state, q - unit[:7], v - unit[7:], z_r, w_r)
        slope[:, j] = (ahead - behind) / (2.0 * d)
    found = jacobian(one, strut_state, np.concatenate([q, v]), z_r, w_r)
    np.testing.assert_array_equal(found[:7], np.eye(7, 14, 7))
    for part in (slice(0, 7), slice(7, 14)):
        size = np.abs(slope[:, part]).max(axis=1, keepdims=True)
        np.testing.assert_allclose(found[7:, part] / size, slope[:, part] / size, atol=2e-4)


@every_car
@given(coordinates, rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_the_mirror_image_of_a_car_rolls_the_other_way(name, q, v, strut_state, z_r, w_r):
    signs, swap = np.array([1, -1, 1, 1, -1, 1, -1]), [1, 0, 3, 2]
    found = compute_accelerations(
        PLANTS[name], strut_state[swap], signs * q, signs * v, z_r[swap], w_r[swap]
    )
    expected = signs * compute_accelerations(PLANTS[name], strut_state, q, v, z_r, w_r)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@every_car
@given(coordinates, rates, st.sampled_from(MODES), vectors(2, 0.1), vectors(2, 1.0))
def test_a_symmetric_motion_stays_symmetric_to_the_bit(name, q, v, mode, z_r, w_r):
    roll = [1, 4, 6]
    q[roll] = v[roll] = 0.0
    strut_state = settled_strut_state(encode_command(mode))
    found = compute_accelerations(
        PLANTS[name], strut_state, q, v, np.repeat(z_r, 2), np.repeat(w_r, 2)
    )
    assert (found[roll] == 0.0).all()


@every_car
def test_an_axle_in_the_air_falls_with_gravity_and_the_struts_push(name):
    car, one = CARS[name], PLANTS[name]
    strut_state, q = settled_strut_state(encode_command("ride")), np.zeros(7)
    found = compute_accelerations(one, strut_state, q, np.zeros(7), z_r=np.full(4, -1.0))
    struts = 2.0 * car.strut.p_stat * car.strut.A
    for i, axle in enumerate((car.front, car.rear)):
        assert found[3 + 2 * i] == pytest.approx(-oracles.G - struts / axle.m)
    everything = car.m_b * found[0] + car.front.m * found[3] + car.rear.m * found[5]
    assert everything == pytest.approx(-oracles.G * (car.m_b + car.front.m + car.rear.m))


@every_car
@every_mode
def test_at_rest_the_tyres_carry_the_whole_weight_where_statics_puts_it(name, mode):
    car, one = CARS[name], PLANTS[name]
    state = equilibrium(one, settled_strut_state(encode_command(mode)), ZEROS)
    found = compute_accelerations(
        one, settled_strut_state(encode_command(mode)), state[:7], state[7:]
    )
    np.testing.assert_allclose(found, 0.0, atol=1e-9)
    assert (state[[1, 4, 6]] == 0.0).all() and (state[7:] == 0.0).all()
    assert state[[3, 5]] == pytest.approx([0.0, 0.0], abs=1e-12)
    tyres = [a.k_t * d for a, d in zip(car.axles, car.tyre_deflections, strict=True)]
    np.testing.assert_allclose(tyres, oracles.static_loads(car)[1], rtol=1e-12)
    total = oracles.G * (car.m_b + car.front.m + car.rear.m)
    assert 2.0 * sum(tyres) == pytest.approx(total, rel=1e-12)


def test_the_defenders_tyres_stand_compressed_by_21_and_a_half_millimetres():
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
def test_the_car_finds_its_rest_on_any_plausible_ground(name, mode, ground):
    strut_state, one, ground = (
        settled_strut_state(encode_command(mode)),
        PLANTS[name],
        np.array(ground),
    )
    state = equilibrium(one, strut_state, ground)
    found = compute_accelerations(one, strut_state, state[:7], state[7:], ground)
    np.testing.assert_allclose(found, 0.0, atol=1e-9 * (1.0 + np.abs(ground).max()))
    heaves, rolls = 0.5 * (ground[::2] + ground[1::2]), ground[::2] - ground[1::2]
    np.testing.assert_allclose(state[[3, 5]], heaves, atol=0.01)
    assert (np.sign(state[[4, 6]]) == np.sign(rolls)).all()


def test_where_no_rest_is_to_be_found_the_reason_is_said():
    strut_state = settled_strut_state(encode_command("ride"))
    with pytest.raises(ArithmeticError, match="no static equilibrium"):
        equilibrium(PLANTS["unequal_axles"], strut_state, np.array([np.nan, 0.0, 0.0, 0.0]))


@every_car
@given(coordinates, rates, strut_states)
def test_the_compiled_equations_are_the_plain_ones(name, q, v, strut_state):
    found = compute_accelerations(PLANTS[name], strut_state, q, v)
    plain = Plant(PLANTS[name].constants.view(np.recarray), *PLANTS[name].arrays[1:])
    plain = compute_accelerations(plain, strut_state, q, v, kernel=accelerations.py_func)
    np.testing.assert_allclose(found, plain, rtol=1e-12, atol=1e-9)
