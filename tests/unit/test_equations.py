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
    LEANING,
    PLANTS,
    STILL,
    accelerate,
    coordinates,
    lossless,
    memories,
    rates,
    vectors,
)

from road_envs.vehicle.equations import Plant, accelerations, equilibrium, jacobian, plant
from road_envs.vehicle.suspension import command, memory_at_rest

ORACLES = {name: oracles.NonlinearCar(car) for name, car in CARS.items()}
FREE = {name: plant(lossless(car)) for name, car in CARS.items()}
MODES = ("ride", "handling")
every_car = pytest.mark.parametrize("name", CARS)
every_mode = pytest.mark.parametrize("mode", MODES)


@every_car
@given(coordinates, rates, memories, vectors(4, 0.15), vectors(4, 2.0))
def test_the_car_moves_as_the_papers_equations_say(name, q, v, memory, z_r, w_r):
    expected = ORACLES[name].accelerations(memory, q, v, z_r, w_r)
    found = accelerate(PLANTS[name], memory, q, v, z_r, w_r)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)


@every_car
@given(coordinates, rates, memories, vectors(2, 5.0))
def test_in_a_manoeuvre_the_body_leans_as_an_inverted_pendulum(name, q, v, memory, turn):
    car = CARS[name]
    lean = car.h_cg - car.roll_centre, car.h_cg - car.pitch_centre, *turn
    expected = ORACLES[name].accelerations(memory, q, v, STILL, STILL, lean)
    found = accelerate(LEANING[name], memory, q, v, turn=turn)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)
    upright = accelerate(PLANTS[name], memory, q, v)
    np.testing.assert_array_equal(accelerate(PLANTS[name], memory, q, v, turn=turn), upright)


@given(coordinates, rates, memories, vectors(4, 0.15))
def test_the_ten_millimetre_option_moves_as_the_papers_equations_say(q, v, memory, z_r):
    car = replace(CARS["lopsided"], tyre_static_deflection=0.010)
    expected = oracles.NonlinearCar(car).accelerations(memory, q, v, z_r, STILL)
    found = accelerate(plant(car), memory, q, v, z_r)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)


FAR = vectors(7, 0.05, 0.05, 0.03, 0.05, 0.05, 0.05, 0.05)
far = st.tuples(FAR, st.just(memory_at_rest(command("ride"))))
near = st.tuples(vectors(7, 0.008, 0.008, 0.004, 0.008), memories.map(lambda m: m * [0.2, 1, 1]))


@every_car
@given(far | near, vectors(4, 0.1))
def test_forces_are_the_slope_of_the_energy(name, q_and_memory, z_r):
    oracle, rest, d = ORACLES[name], np.zeros(7), 1e-6
    q, memory = q_and_memory
    slope = np.array(
        [
            oracle.energy(memory, q + d * unit, rest, z_r)
            - oracle.energy(memory, q - d * unit, rest, z_r)
            for unit in np.eye(7)
        ]
    ) / (2.0 * d)
    M = PLANTS[name].numbers[0]["M"]
    found = M * accelerate(PLANTS[name], memory, q, rest, z_r)
    np.testing.assert_allclose(found, -slope, rtol=1e-5, atol=1.0)


@every_car
@given(coordinates, rates, memories)
def test_nothing_in_the_car_adds_energy_on_a_still_road(name, q, v, memory):
    losing, free = PLANTS[name], FREE[name]
    M = losing.numbers[0]["M"]
    power = M * v @ (accelerate(losing, memory, q, v) - accelerate(free, memory, q, v))
    assert power <= 1e-9


@every_car
@every_mode
def test_small_motions_follow_the_energy_matrices(name, mode):
    car = CARS[name]
    free, memory = plant(lossless(car)), memory_at_rest(command(mode))
    column = car.strut.x_1 + (car.strut.x_2 if mode == "ride" else 0.0)
    rate = car.strut.n_p * car.strut.p_stat * car.strut.A / column
    M, C, K, K_r, _ = oracles.linear_matrices(lossless(car), (rate, rate))
    rng = np.random.default_rng(0)
    at_rest = accelerate(free, memory, np.zeros(7), np.zeros(7))
    for _ in range(20):
        q, v, z_r = (1e-7 * rng.standard_normal(n) for n in (7, 7, 4))
        expected = np.linalg.solve(M, K_r @ z_r - K @ q - C @ v)
        found = accelerate(free, memory, q, v, z_r) - at_rest
        np.testing.assert_allclose(found, expected, atol=3e-5 * np.abs(expected).max())


@every_mode
def test_the_energy_matrices_have_the_printed_frequencies(mode):
    rate = oracles.static_rate(mode)
    M, _, K, _, _ = oracles.linear_matrices(oracles.PAPER_CAR, (rate, rate))
    np.testing.assert_allclose(
        oracles.natural_frequencies(M, K), oracles.MODES_HZ[mode], atol=0.0005
    )


def frequencies(free, memory, state):
    """Undamped frequencies [Hz] of a plant without losses, from its Jacobian."""
    lower = jacobian(free, memory, state, STILL, STILL)[7:, :7]
    return np.sort(np.sqrt(np.linalg.eigvals(-lower).real)) / (2.0 * np.pi)


@every_mode
def test_the_car_has_the_printed_frequencies(mode):
    """At the origin, where the gas has its nominal pressure, to the digits printed.

    At rest the body's weight and not the nominal pressure decides the force in a strut, which is
    0.1 % more in front and 0.2 % less behind. The rate goes with the square of the force (the gas
    column shortens as well), the frequency with its root: so 0.2 % here.
    """
    free, memory = plant(lossless(DEFENDER)), memory_at_rest(command(mode))
    at_origin = frequencies(free, memory, np.zeros(14))
    np.testing.assert_allclose(at_origin, oracles.MODES_HZ[mode], atol=0.0005)
    at_rest = frequencies(free, memory, equilibrium(free, memory, STILL))
    np.testing.assert_allclose(at_rest, oracles.MODES_HZ[mode], rtol=0.002)


@every_car
@pytest.mark.parametrize("plants", [PLANTS, LEANING], ids=["straight", "leaning"])
@given(coordinates, rates, memories, vectors(4, 0.15), vectors(4, 2.0))
def test_the_jacobian_is_the_slope_of_the_rates(name, plants, q, v, memory, z_r, w_r):
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
        ahead = accelerate(one, memory, q + unit[:7], v + unit[7:], z_r, w_r)
        behind = accelerate(one, memory, q - unit[:7], v - unit[7:], z_r, w_r)
        slope[:, j] = (ahead - behind) / (2.0 * d)
    found = jacobian(one, memory, np.concatenate([q, v]), z_r, w_r)
    np.testing.assert_array_equal(found[:7], np.eye(7, 14, 7))
    for part in (slice(0, 7), slice(7, 14)):
        size = np.abs(slope[:, part]).max(axis=1, keepdims=True)
        np.testing.assert_allclose(found[7:, part] / size, slope[:, part] / size, atol=2e-4)


@every_car
@given(coordinates, rates, memories, vectors(4, 0.15), vectors(4, 2.0))
def test_the_mirror_image_of_a_car_rolls_the_other_way(name, q, v, memory, z_r, w_r):
    signs, swap = np.array([1, -1, 1, 1, -1, 1, -1]), [1, 0, 3, 2]
    found = accelerate(PLANTS[name], memory[swap], signs * q, signs * v, z_r[swap], w_r[swap])
    expected = signs * accelerate(PLANTS[name], memory, q, v, z_r, w_r)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@every_car
@given(coordinates, rates, st.sampled_from(MODES), vectors(2, 0.1), vectors(2, 1.0))
def test_a_symmetric_motion_stays_symmetric_to_the_bit(name, q, v, mode, z_r, w_r):
    roll = [1, 4, 6]
    q[roll] = v[roll] = 0.0
    memory = memory_at_rest(command(mode))
    found = accelerate(PLANTS[name], memory, q, v, np.repeat(z_r, 2), np.repeat(w_r, 2))
    assert (found[roll] == 0.0).all()


@every_car
def test_an_axle_in_the_air_falls_with_gravity_and_the_struts_push(name):
    car, one = CARS[name], PLANTS[name]
    memory, q = memory_at_rest(command("ride")), np.zeros(7)
    found = accelerate(one, memory, q, np.zeros(7), z_r=np.full(4, -1.0))
    struts = 2.0 * car.strut.p_stat * car.strut.A
    for i, axle in enumerate((car.front, car.rear)):
        assert found[3 + 2 * i] == pytest.approx(-oracles.G - struts / axle.m)
    everything = car.m_b * found[0] + car.front.m * found[3] + car.rear.m * found[5]
    assert everything == pytest.approx(-oracles.G * (car.m_b + car.front.m + car.rear.m))


@every_car
@every_mode
def test_at_rest_the_tyres_carry_the_whole_weight_where_statics_puts_it(name, mode):
    car, one = CARS[name], PLANTS[name]
    state = equilibrium(one, memory_at_rest(command(mode)), STILL)
    found = accelerate(one, memory_at_rest(command(mode)), state[:7], state[7:])
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
    memory, one, ground = memory_at_rest(command(mode)), PLANTS[name], np.array(ground)
    state = equilibrium(one, memory, ground)
    found = accelerate(one, memory, state[:7], state[7:], ground)
    np.testing.assert_allclose(found, 0.0, atol=1e-9 * (1.0 + np.abs(ground).max()))
    heaves, rolls = 0.5 * (ground[::2] + ground[1::2]), ground[::2] - ground[1::2]
    np.testing.assert_allclose(state[[3, 5]], heaves, atol=0.01)
    assert (np.sign(state[[4, 6]]) == np.sign(rolls)).all()


def test_where_no_rest_is_to_be_found_the_reason_is_said():
    memory = memory_at_rest(command("ride"))
    with pytest.raises(ArithmeticError, match="no static equilibrium"):
        equilibrium(PLANTS["lopsided"], memory, np.array([np.nan, 0.0, 0.0, 0.0]))


@every_car
@given(coordinates, rates, memories)
def test_the_compiled_equations_are_the_plain_ones(name, q, v, memory):
    found = accelerate(PLANTS[name], memory, q, v)
    plain = Plant(PLANTS[name].numbers.view(np.recarray), *PLANTS[name].arrays[1:])
    plain = accelerate(plain, memory, q, v, kernel=accelerations.py_func)
    np.testing.assert_allclose(found, plain, rtol=1e-12, atol=1e-9)
