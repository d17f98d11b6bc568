"""Vehicle variations: equations of motion and statics with unequal struts, progressive tyres,
bushings with roll stiffness and a flexible frame; against independent equations and energies."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import brentq
from vehicle_fixtures import (
    CARS,
    DEFENDER,
    FLAT_SURFACE,
    VARIATIONS,
    VARIED,
    VARIED_FLEXIBLE,
    VARIED_MANOEUVRE_PLANTS,
    VARIED_PLANTS,
    WITHOUT_STOPS,
    ZEROS,
    compute_accelerations,
    coordinates,
    lossless,
    rates,
    strut_states,
    varied_plant,
    vectors,
    with_twist,
)

from road_envs.roads.surface import Surface
from road_envs.simulation.drive import DriveSimulator
from road_envs.simulation.rosenbrock import ACCELERATION, EXTENSION
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.linear_model import jacobian, linearise
from road_envs.vehicle.parameters import NOMINAL, TorsionalFrame, VehicleVariation
from road_envs.vehicle.suspension import (
    HELD_EXTENSION,
    encode_command,
    settled_strut_state,
    strut_force,
)
from studies.bench.fleet import Fleet, select_vehicle

CAR = CARS["unequal_axles"]
LOSSLESS = {name: varied_plant(lossless(CAR), v) for name, v in VARIATIONS.items()}
MODES = ("ride", "handling")
RIDE = settled_strut_state(encode_command("ride"))
every_variation = pytest.mark.parametrize("name", VARIATIONS)
every_mode = pytest.mark.parametrize("mode", MODES)
twists, twist_rates = st.floats(-0.02, 0.02), st.floats(-1.0, 1.0)


# --- equations of motion --------------------------------------------------------------------------


@every_variation
@given(coordinates, rates, twists, twist_rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_accelerations_match_the_papers_equations_with_the_variation(
    name, q, v, psi, psi_dot, strut_state, z_r, w_r
):
    q, v = with_twist(name, q, v, psi, psi_dot)
    manoeuvre = CAR.h_cg - CAR.roll_centre, CAR.h_cg - CAR.pitch_centre, 1.5, -2.0
    expected = oracles.NonlinearCar(CAR, VARIATIONS[name]).accelerations(
        strut_state, q, v, z_r, w_r, manoeuvre
    )
    actual = compute_accelerations(
        VARIED_MANOEUVRE_PLANTS[name], strut_state, q, v, z_r, w_r, a_xy=(1.5, -2.0)
    )
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-7)


@every_variation
@given(vectors(7, 0.05, 0.05, 0.03, 0.05, 0.05, 0.05, 0.05), twists, vectors(4, 0.1))
def test_conservative_forces_are_minus_the_gradient_of_the_energy(name, q, psi, z_r):
    (q, rest), d = with_twist(name, q, np.zeros(7), psi, 0.0), 1e-6
    oracle = oracles.NonlinearCar(CAR, VARIATIONS[name])
    ends = [[oracle.energy(RIDE, q + s * u, rest, z_r) for s in (d, -d)] for u in np.eye(q.size)]
    slope = [(ahead - behind) / (2.0 * d) for ahead, behind in ends]
    actual = VARIED_PLANTS[name].inertias * compute_accelerations(
        VARIED_PLANTS[name], RIDE, q, rest, z_r
    )
    np.testing.assert_allclose(actual, -np.array(slope), rtol=1e-5, atol=1.0)


@every_variation
@given(coordinates, rates, twists, twist_rates, strut_states)
def test_losses_never_add_energy_on_a_stationary_road(name, q, v, psi, psi_dot, strut_state):
    q, v = with_twist(name, q, v, psi, psi_dot)
    losing, free = (
        compute_accelerations(plants[name], strut_state, q, v)
        for plants in (VARIED_PLANTS, LOSSLESS)
    )
    assert VARIED_PLANTS[name].inertias * v @ (losing - free) <= 1e-9


@every_variation
@given(coordinates, rates, twists, twist_rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_the_jacobian_matches_central_differences(name, q, v, psi, psi_dot, strut_state, z_r, w_r):
    plant, d, car = VARIED_MANOEUVRE_PLANTS[name], 1e-6, oracles.NonlinearCar(CAR, VARIATIONS[name])
    q, v = with_twist(name, q, v, psi, psi_dot)
    n, constants = q.size, plant.constants[0]
    height, rate = (x[[3, 3, 5, 5]] + constants["y_t"] * x[[4, 4, 6, 6]] for x in (q, v))
    u, damper = z_r - height, car.c_t * (w_r - rate)
    spring = car.k_t * (1.0 + VARIED.tyre_progression * u) * (car.delta + u)
    assume((np.abs([spring, spring + damper, spring - damper]) > 5.0).all())
    slope = np.empty((n, 2 * n))
    for j, unit in enumerate(d * np.eye(2 * n)):
        ahead = compute_accelerations(plant, strut_state, q + unit[:n], v + unit[n:], z_r, w_r)
        behind = compute_accelerations(plant, strut_state, q - unit[:n], v - unit[n:], z_r, w_r)
        slope[:, j] = (ahead - behind) / (2.0 * d)
    actual = jacobian(plant, strut_state, np.concatenate([q, v]), z_r, w_r)
    np.testing.assert_array_equal(actual[:n], np.eye(n, 2 * n, n))
    for part in (slice(0, n), slice(n, None)):
        size = np.abs(slope[:, part]).max(axis=1, keepdims=True)
        np.testing.assert_allclose(actual[n:, part] / size, slope[:, part] / size, atol=3e-4)


def test_the_default_variation_leaves_the_plant_unchanged():
    assert DEFENDER.variation == NOMINAL == VehicleVariation()
    assert not build_plant(DEFENDER).flexible


# --- statics --------------------------------------------------------------------------------------


@pytest.mark.parametrize("w", range(4))
def test_strut_components_are_scaled_by_their_factors(w):
    """Gas at rest; damper, friction and bushing separately against the oracle's curves."""
    oracle, strut = oracles.NonlinearCar(DEFENDER), DEFENDER.strut
    plant = varied_plant(DEFENDER, VARIED)

    def difference(e, e_dot, mode):
        """Return the force difference [N] between the varied and the nominal strut."""
        strut_state = settled_strut_state(encode_command(mode))
        described = oracle.strut_forces(strut_state, np.full(4, e), np.full(4, e_dot))[w]
        return strut_force(plant.buffers(strut_state), w, e, e_dot)[0] - described

    gas = (VARIED.gas[w] - 1.0) * oracles.gas_force(oracles.X_STAT["ride"], 0.0)
    assert difference(0.0, 0.0, "ride") == pytest.approx(gas, rel=1e-9)
    for mode in MODES:
        at_rest = (VARIED.gas[w] - 1.0) * oracles.gas_force(oracles.X_STAT[mode], 0.0)
        for v in (-0.7, 0.01, 0.3, 1.5):
            losses = (VARIED.damper[w] - 1.0) * oracles.CubicCurve(getattr(strut.damper, mode))(v)
            losses += (VARIED.friction[w] - 1.0) * oracles.CubicCurve(
                getattr(strut.friction, mode)
            )(v)
            assert difference(0.0, v, mode) == pytest.approx(at_rest - losses, rel=1e-6, abs=1e-6)
    e = 0.09
    bushing = (VARIED.bushing[w] - 1.0) * float(oracles.CubicCurve(strut.bushing)(e))
    gas = (VARIED.gas[w] - 1.0) * oracles.gas_force(oracles.X_STAT["ride"], e)
    assert difference(e, 0.0, "ride") == pytest.approx(gas - bushing, rel=1e-6)


factors = st.tuples(*[st.floats(0.85, 1.15)] * 4)


@given(factors, factors, st.floats(0.0, 8.0), st.tuples(*[st.floats(0.0, 2e4)] * 2), st.booleans(),
       st.sampled_from(MODES), vectors(4, 0.02))  # fmt: skip
def test_in_equilibrium_tyre_loads_balance_the_weight(
    gas, tyre, progression, roll_stiffness, frame, mode, z_r
):
    variation = VehicleVariation(
        gas=gas, tyre=tyre, tyre_progression=progression, roll_stiffness=roll_stiffness,
        frame=TorsionalFrame(f=8.0, zeta=0.1) if frame else None,
    )  # fmt: skip
    plant, strut_state = (
        varied_plant(CAR, variation),
        settled_strut_state(encode_command(mode)),
    )
    state = equilibrium(plant, strut_state, z_r)
    n, oracle = state.size // 2, oracles.NonlinearCar(CAR, variation)
    assert n == (8 if frame else 7) and (state[n:] == 0.0).all()
    np.testing.assert_allclose(
        oracle.accelerations(strut_state, state[:n], state[n:], z_r, ZEROS), 0.0, atol=1e-8
    )
    u = z_r - (state[[3, 3, 5, 5]] + plant.constants[0]["y_t"] * state[[4, 4, 6, 6]])
    load = oracle.k_t * (1.0 + progression * u) * (oracle.delta + u)
    axles = (CAR.front, CAR.rear)
    total = oracles.G * (CAR.m_b + sum(axle.m for axle in axles))
    assert load.sum() == pytest.approx(total, rel=1e-9)
    struts = load - 0.5 * oracles.G * np.repeat([axle.m for axle in axles], 2)
    assert struts @ np.repeat([axle.x for axle in axles], 2) == pytest.approx(0.0, abs=1e-6 * total)
    levers = [axle.y_t * side for axle in axles for side in (1.0, -1.0)]
    assert load @ levers == pytest.approx(0.0, abs=1e-6 * total)


@every_mode
@pytest.mark.parametrize("factor", [0.9, 1.05])
def test_a_common_change_of_gas_pressure_changes_the_ride_height(mode, factor):
    plant = varied_plant(WITHOUT_STOPS, VehicleVariation(gas=(factor,) * 4))
    state, strut = equilibrium(plant, settled_strut_state(encode_command(mode)), ZEROS), CAR.strut
    loads = oracles.static_loads(CAR)[0]
    column = strut.x_1 + strut.x_2 * (mode == "ride")
    e = column * ((factor * strut.p_stat * strut.A / loads) ** (1.0 / strut.n_p) - 1.0)
    z, theta = state[0], state[2]
    actual = [z - CAR.front.x * theta - state[3], z - CAR.rear.x * theta - state[5]]
    np.testing.assert_allclose(actual, e, rtol=1e-9)


@pytest.mark.parametrize("progression", [0.0, 3.0, 9.0])
@pytest.mark.parametrize("factor", [0.8, 1.0, 1.15])
def test_deflection_of_a_progressive_tyre_solves_its_equation(progression, factor):
    plant = varied_plant(CAR, VehicleVariation(tyre=(factor,) * 4, tyre_progression=progression))
    state = equilibrium(plant, RIDE, ZEROS)
    for i, axle in enumerate((CAR.front, CAR.rear)):
        load = oracles.static_loads(CAR)[1][i]
        delta = load / axle.k_t

        def lacks(x, axle=axle, delta=delta, load=load):
            return factor * axle.k_t * (1.0 + progression * (x - delta)) * x - load

        assert delta - state[3 + 2 * i] == pytest.approx(brentq(lacks, 0.0, 0.1, xtol=1e-15))
    if factor == 1.0:  # the progression keeps the stiffness at the static deflection
        np.testing.assert_allclose(state[[3, 5]], 0.0, atol=1e-12)


@every_mode
def test_roll_stiffness_is_struts_and_bushings_in_series_with_tyres(mode):
    """Springs in series at each axle, axles in parallel: 1 / (1 / (2 k y_s² + k_r) + ...)."""
    stiffness = (6000.0, 2500.0)
    plant = varied_plant(WITHOUT_STOPS, VehicleVariation(roll_stiffness=stiffness))
    model = linearise(plant, mode, {})
    K = -model.M[:, None] * model.A[7:, :7]
    rolled = np.linalg.solve(K, np.eye(7)[1])[1]
    strut, total = CAR.strut, 0.0
    for i, axle in enumerate((CAR.front, CAR.rear)):
        load = oracles.static_loads(CAR)[0][i]
        column = strut.x_1 + strut.x_2 * (mode == "ride")
        compressed = column * (strut.p_stat * strut.A / load) ** (1.0 / strut.n_p)
        over = 2.0 * strut.n_p * load / compressed * axle.y_s**2 + stiffness[i]
        total += 1.0 / (1.0 / over + 1.0 / (2.0 * axle.k_t * axle.y_t**2))
    assert rolled == pytest.approx(1.0 / total, rel=1e-9)


def test_static_frame_twist_is_its_moment_over_its_stiffness():
    ground = np.array([0.03, -0.03, -0.03, 0.03])
    state = equilibrium(VARIED_PLANTS["flexible"], RIDE, ground)
    loose = oracles.NonlinearCar(
        CAR, replace(VARIED_FLEXIBLE, frame=TorsionalFrame(f=1e-9, zeta=0.0))
    )
    inertia = 0.25 * CAR.I_xx
    moment = inertia * loose.accelerations(RIDE, state[:8], np.zeros(8), ground, ZEROS)[7]
    rate = inertia * (2.0 * np.pi * VARIED_FLEXIBLE.frame.f) ** 2
    assert state[7] == pytest.approx(moment / rate, rel=1e-6) and state[7] > 5e-4


def twisted_ground(start):
    """Return a surface that raises diagonal wheels by 3 cm, with the front axle at `start` [m]."""
    z = np.full((2, 400), [[0.03], [-0.03]])
    behind = start - 0.5 * CAR.wheelbase
    return Surface(np.where(np.arange(-200, 200) * 0.1 < behind, -z, z), 0.1, -20.0)


def test_closing_a_valve_on_twisted_ground_causes_no_motion():
    """The held extension includes the twist, in a single drive and in a SIMD lane."""
    start = DriveSimulator(VARIED_PLANTS["flexible"], CAR, FLAT_SURFACE, 12.0).start
    surface = twisted_ground(start)
    flat = oracles.SplineRoad(surface.z, surface.ds, surface.start)
    ends = []
    for _ in range(2):
        drive = DriveSimulator(VARIED_PLANTS["flexible"], CAR, surface, 1e-6)
        drive.start, heights = start, flat.wheel_inputs(start, CAR.wheelbase, 0.0)[0]
        drive.state[:] = equilibrium(drive.plant, drive.strut_state, heights)
        assert np.ptp(heights[:2]) > 0.05 and abs(drive.state[7]) > 5e-4
        ends.append(drive)
    shut = np.full(300, encode_command("handling"), dtype=np.uint8)
    alone = ends[0].advance(shut).signals
    lane = select_vehicle(Fleet([ends[1]]).advance(shut[None]), 0)
    for signals in (alone, lane):
        np.testing.assert_allclose(signals[:, ACCELERATION : ACCELERATION + 7], 0.0, atol=1e-7)
    extension = alone[-1, EXTENSION : EXTENSION + 4]
    held = extension * CAR.strut.x_2 / (CAR.strut.x_1 + CAR.strut.x_2)
    np.testing.assert_allclose(ends[0].strut_state[:, HELD_EXTENSION], held, rtol=1e-6)


# --- errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"gas": (1.0, 0.0, 1.0, 1.0)}, "gas.1: must be positive"),
        ({"tyre": (1.0, float("nan"), 1.0, 1.0)}, "tyre.1: must be finite"),
        ({"tyre_progression": -1.0}, "tyre_progression: must not be negative"),
        ({"roll_stiffness": (-1.0, 0.0)}, "roll_stiffness.0: must not be negative"),
    ],
)
def test_an_invalid_variation_raises_value_error(options, reason):
    with pytest.raises(ValueError, match=reason):
        VehicleVariation(**options)


def test_invalid_frames_and_progressions_raise_value_error():
    with pytest.raises(ValueError, match="f: must be positive"):
        TorsionalFrame(f=0.0, zeta=0.1)
    with pytest.raises(ValueError, match="zeta: must not be negative"):
        TorsionalFrame(f=10.0, zeta=-0.1)
    with pytest.raises(ValueError, match=r"tyre_progression must be below 46\.. 1/m, got 50"):
        varied_plant(DEFENDER, VehicleVariation(tyre_progression=50.0))
