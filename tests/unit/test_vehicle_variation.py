"""Cars as manufactured: no two struts alike, progressive tyres, bushings that turn, a frame that
twists. The oracles are the paper's equations with these added, energies, and closed forms."""

from dataclasses import replace
from functools import cache

import numpy as np
import oracles
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import eigh
from scipy.optimize import brentq
from vehicle_fixtures import (
    CARS,
    DEFENDER,
    VARIATIONS,
    VARIED,
    VARIED_FLEXIBLE,
    VARIED_MANOEUVRE_PLANTS,
    VARIED_PLANTS,
    ZEROS,
    compute_accelerations,
    coordinates,
    lossless,
    rates,
    run_integrator,
    smooth_road,
    strut_states,
    vectors,
)

from road_envs.roads.surface import Surface
from road_envs.simulation.adaptive_drive import integrate_adaptive, simulate_adaptive
from road_envs.simulation.drive import DriveSimulator, Trajectory
from road_envs.simulation.fleet import Fleet, select_vehicle
from road_envs.simulation.rosenbrock import ACCELERATION, EXTENSION, LOAD, TWIST
from road_envs.simulation.sensitivity import linearize_drive
from road_envs.vehicle.equations import build_plant, equilibrium, jacobian
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.linear_model import frequency_response, linearise, natural_modes
from road_envs.vehicle.parameters import NOMINAL, AxleCurves, TorsionalFrame, VehicleVariation
from road_envs.vehicle.suspension import (
    HELD_EXTENSION,
    encode_command,
    settled_strut_state,
    strut_force,
)

CAR = CARS["unequal_axles"]
FREE = {name: build_plant(lossless(CAR), variation=one) for name, one in VARIATIONS.items()}
SIZES = {"varied": 7, "flexible": 8}
MODES = ("ride", "handling")
RIDE = settled_strut_state(encode_command("ride"))
GENTLE, ROUGH = smooth_road(height=0.007), smooth_road(height=0.03)
SPEED, S_0 = 12.0, 1.0
NOTHING = Curve(x=(-1.0, 1.0), F=(0.0, 0.0))
STOPS = AxleCurves(front=NOTHING, rear=NOTHING)
BARE = replace(CAR, strut=replace(CAR.strut, bushing=NOTHING, bump_stop=STOPS))
"""The car on nothing but its gas springs."""
every_odd = pytest.mark.parametrize("name", VARIATIONS)
every_mode = pytest.mark.parametrize("mode", MODES)
twists, twist_rates = st.floats(-0.02, 0.02), st.floats(-1.0, 1.0)


def motion(name, q, v, psi, psi_dot):
    """Coordinates and rates of a car, with the twist if it has one."""
    return (q, v) if name == "varied" else (np.append(q, psi), np.append(v, psi_dot))


# --- equations of motion --------------------------------------------------------------------------


@every_odd
@given(coordinates, rates, twists, twist_rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_it_moves_as_the_papers_equations_with_the_deviations_say(
    name, q, v, psi, psi_dot, strut_state, z_r, w_r
):
    q, v = motion(name, q, v, psi, psi_dot)
    lean = CAR.h_cg - CAR.roll_centre, CAR.h_cg - CAR.pitch_centre, 1.5, -2.0
    expected = oracles.NonlinearCar(CAR, VARIATIONS[name]).accelerations(
        strut_state, q, v, z_r, w_r, lean
    )
    found = compute_accelerations(
        VARIED_MANOEUVRE_PLANTS[name], strut_state, q, v, z_r, w_r, a_xy=(1.5, -2.0)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7)


@every_odd
@given(vectors(7, 0.05, 0.05, 0.03, 0.05, 0.05, 0.05, 0.05), twists, vectors(4, 0.1))
def test_forces_are_the_slope_of_the_energy(name, q, psi, z_r):
    (q, rest), d = motion(name, q, np.zeros(7), psi, 0.0), 1e-6
    oracle = oracles.NonlinearCar(CAR, VARIATIONS[name])
    ends = [[oracle.energy(RIDE, q + s * u, rest, z_r) for s in (d, -d)] for u in np.eye(q.size)]
    slope = [(ahead - behind) / (2.0 * d) for ahead, behind in ends]
    found = VARIED_PLANTS[name].inertias * compute_accelerations(
        VARIED_PLANTS[name], RIDE, q, rest, z_r
    )
    np.testing.assert_allclose(found, -np.array(slope), rtol=1e-5, atol=1.0)


@every_odd
@given(coordinates, rates, twists, twist_rates, strut_states)
def test_nothing_in_it_adds_energy_on_a_still_road(name, q, v, psi, psi_dot, strut_state):
    q, v = motion(name, q, v, psi, psi_dot)
    losing, free = (
        compute_accelerations(one[name], strut_state, q, v) for one in (VARIED_PLANTS, FREE)
    )
    assert VARIED_PLANTS[name].inertias * v @ (losing - free) <= 1e-9


@every_odd
@given(coordinates, rates, twists, twist_rates, strut_states, vectors(4, 0.15), vectors(4, 2.0))
def test_the_jacobian_is_the_slope_of_the_rates(name, q, v, psi, psi_dot, strut_state, z_r, w_r):
    one, d, car = VARIED_MANOEUVRE_PLANTS[name], 1e-6, oracles.NonlinearCar(CAR, VARIATIONS[name])
    q, v = motion(name, q, v, psi, psi_dot)
    n, constants = q.size, one.constants[0]
    height, rate = (x[[3, 3, 5, 5]] + constants["y_t"] * x[[4, 4, 6, 6]] for x in (q, v))
    u, damper = z_r - height, car.c_t * (w_r - rate)
    spring = car.k_t * (1.0 + VARIED.tyre_progression * u) * (car.delta + u)
    assume((np.abs([spring, spring + damper, spring - damper]) > 5.0).all())
    slope = np.empty((n, 2 * n))
    for j, unit in enumerate(d * np.eye(2 * n)):
        ahead = compute_accelerations(one, strut_state, q + unit[:n], v + unit[n:], z_r, w_r)
        behind = compute_accelerations(one, strut_state, q - unit[:n], v - unit[n:], z_r, w_r)
        slope[:, j] = (ahead - behind) / (2.0 * d)
    found = jacobian(one, strut_state, np.concatenate([q, v]), z_r, w_r)
    np.testing.assert_array_equal(found[:n], np.eye(n, 2 * n, n))
    for part in (slice(0, n), slice(n, None)):
        size = np.abs(slope[:, part]).max(axis=1, keepdims=True)
        np.testing.assert_allclose(found[n:, part] / size, slope[:, part] / size, atol=3e-4)


def test_as_described_it_is_the_car_itself_to_the_bit():
    nominal, varied = build_plant(DEFENDER), build_plant(DEFENDER, False, VehicleVariation())
    for a, b in zip(nominal.arrays, varied.arrays, strict=True):
        np.testing.assert_array_equal(a, b)
    assert NOMINAL == VehicleVariation() and not build_plant(DEFENDER).flexible


# --- statics --------------------------------------------------------------------------------------


@pytest.mark.parametrize("w", range(4))
def test_the_parts_of_a_strut_differ_by_exactly_their_factors(w):
    """Gas at rest; damper, friction, bushing each alone against the oracle's curves."""
    oracle, strut = oracles.NonlinearCar(DEFENDER), DEFENDER.strut
    one = build_plant(DEFENDER, False, VARIED)
    args = one.constants[0], one.velocity, one.displacement

    def differs(e, e_dot, mode):
        """By how much the odd strut is stronger [N] than the described one."""
        strut_state = settled_strut_state(encode_command(mode))
        described = oracle.strut_forces(strut_state, np.full(4, e), np.full(4, e_dot))[w]
        return strut_force(*args, strut_state, w, e, e_dot)[0] - described

    gas = (VARIED.gas[w] - 1.0) * oracles.gas_force(oracles.X_STAT["ride"], 0.0)
    assert differs(0.0, 0.0, "ride") == pytest.approx(gas, rel=1e-9)
    for mode in MODES:
        at_rest = (VARIED.gas[w] - 1.0) * oracles.gas_force(oracles.X_STAT[mode], 0.0)
        for v in (-0.7, 0.01, 0.3, 1.5):
            losses = (VARIED.damper[w] - 1.0) * oracles.CubicCurve(getattr(strut.damper, mode))(v)
            losses += (VARIED.friction[w] - 1.0) * oracles.CubicCurve(
                getattr(strut.friction, mode)
            )(v)
            assert differs(0.0, v, mode) == pytest.approx(at_rest - losses, rel=1e-6, abs=1e-6)
    e = 0.09
    bushing = (VARIED.bushing[w] - 1.0) * float(oracles.CubicCurve(strut.bushing)(e))
    gas = (VARIED.gas[w] - 1.0) * oracles.gas_force(oracles.X_STAT["ride"], e)
    assert differs(e, 0.0, "ride") == pytest.approx(gas - bushing, rel=1e-6)


factors = st.tuples(*[st.floats(0.85, 1.15)] * 4)


@given(factors, factors, st.floats(0.0, 8.0), st.tuples(*[st.floats(0.0, 2e4)] * 2), st.booleans(),
       st.sampled_from(MODES), vectors(4, 0.02))  # fmt: skip
def test_at_rest_the_tyres_carry_the_whole_weight_about_the_centre_of_mass(
    gas, tyre, progression, roll_stiffness, frame, mode, z_r
):
    one = VehicleVariation(
        gas=gas, tyre=tyre, tyre_progression=progression, roll_stiffness=roll_stiffness,
        frame=TorsionalFrame(f=8.0, zeta=0.1) if frame else None,
    )  # fmt: skip
    made, strut_state = build_plant(CAR, False, one), settled_strut_state(encode_command(mode))
    state = equilibrium(made, strut_state, z_r)
    n, oracle = state.size // 2, oracles.NonlinearCar(CAR, one)
    assert n == (8 if frame else 7) and (state[n:] == 0.0).all()
    np.testing.assert_allclose(
        oracle.accelerations(strut_state, state[:n], state[n:], z_r, ZEROS), 0.0, atol=1e-8
    )
    u = z_r - (state[[3, 3, 5, 5]] + made.constants[0]["y_t"] * state[[4, 4, 6, 6]])
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
def test_another_gas_pressure_in_all_struts_is_another_ride_height(mode, factor):
    one = build_plant(BARE, False, VehicleVariation(gas=(factor,) * 4))
    state, strut = equilibrium(one, settled_strut_state(encode_command(mode)), ZEROS), CAR.strut
    loads = oracles.static_loads(CAR)[0]
    column = strut.x_1 + strut.x_2 * (mode == "ride")
    e = column * ((factor * strut.p_stat * strut.A / loads) ** (1.0 / strut.n_p) - 1.0)
    z, theta = state[0], state[2]
    found = [z - CAR.front.x * theta - state[3], z - CAR.rear.x * theta - state[5]]
    np.testing.assert_allclose(found, e, rtol=1e-9)


@pytest.mark.parametrize("progression", [0.0, 3.0, 9.0])
@pytest.mark.parametrize("factor", [0.8, 1.0, 1.15])
def test_a_progressive_tyre_is_deflected_as_its_own_equation_says(progression, factor):
    one = build_plant(
        CAR, False, VehicleVariation(tyre=(factor,) * 4, tyre_progression=progression)
    )
    state = equilibrium(one, RIDE, ZEROS)
    for i, axle in enumerate((CAR.front, CAR.rear)):
        load = oracles.static_loads(CAR)[1][i]
        delta = load / axle.k_t

        def lacks(x, axle=axle, delta=delta, load=load):
            return factor * axle.k_t * (1.0 + progression * (x - delta)) * x - load

        assert delta - state[3 + 2 * i] == pytest.approx(brentq(lacks, 0.0, 0.1, xtol=1e-15))
    if factor == 1.0:  # the progression turns about the static deflection
        np.testing.assert_allclose(state[[3, 5]], 0.0, atol=1e-12)


@every_mode
def test_a_moment_rolls_the_body_against_struts_and_bushings_before_the_tyres(mode):
    """Springs in series over each axle, axles in parallel: 1 / (1 / (2 k y_s² + k_r) + ...)."""
    stiffness = (6000.0, 2500.0)
    one = build_plant(BARE, False, VehicleVariation(roll_stiffness=stiffness))
    model = linearise(one, mode, {})
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


def test_a_twisted_ground_twists_the_frame_by_its_moment_over_its_rate():
    ground = np.array([0.03, -0.03, -0.03, 0.03])
    state = equilibrium(VARIED_PLANTS["flexible"], RIDE, ground)
    loose = oracles.NonlinearCar(
        CAR, replace(VARIED_FLEXIBLE, frame=TorsionalFrame(f=1e-9, zeta=0.0))
    )
    inertia = 0.25 * CAR.I_xx
    moment = inertia * loose.accelerations(RIDE, state[:8], np.zeros(8), ground, ZEROS)[7]
    rate = inertia * (2.0 * np.pi * VARIED_FLEXIBLE.frame.f) ** 2
    assert state[7] == pytest.approx(moment / rate, rel=1e-6) and state[7] > 5e-4


def twisted_ground(drive):
    """The heights under the wheels of a drive's start, raised crosswise by 3 cm."""
    z = np.full((2, 400), [[0.03], [-0.03]])
    behind = drive.start - 0.5 * CAR.wheelbase
    return Surface(np.where(np.arange(-200, 200) * 0.1 < behind, -z, z), 0.1, -20.0)


def test_a_valve_that_closes_on_twisted_ground_moves_nothing():
    """What it holds is the strut's own extension, twist and all: alone, and in a lane."""
    one = DriveSimulator(VARIED_PLANTS["flexible"], CAR, ROUGH, SPEED)
    surface = twisted_ground(one)
    flat = oracles.SplineRoad(surface.z, surface.ds, surface.start)
    ends = []
    for _ in range(2):
        drive = DriveSimulator(VARIED_PLANTS["flexible"], CAR, surface, 1e-6)
        drive.start, heights = one.start, flat.wheel_inputs(one.start, CAR.wheelbase, 0.0)[0]
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


# --- motion ---------------------------------------------------------------------------------------


@cache
def reference(name, mode, surface, seconds, rtol=1e-9):
    """Times (N,) and states (2 n, N) by LSODA on the compiled equations."""
    one, strut_state = VARIED_PLANTS[name], settled_strut_state(encode_command(mode))
    road, n = oracles.SplineRoad(surface.z, surface.ds), SIZES[name]

    def rate(t, y):
        z_r, w_r = road.wheel_inputs(S_0 + SPEED * t, CAR.wheelbase, SPEED)
        return np.concatenate(
            [y[n:], compute_accelerations(one, strut_state, y[:n], y[n:], z_r, w_r)]
        )

    t, y_0 = np.linspace(0.0, seconds, 51), equilibrium(one, strut_state, ZEROS)
    found = solve_ivp(
        rate, (0.0, seconds), y_0, t_eval=t, method="LSODA", rtol=rtol, atol=rtol * 1e-2
    )
    assert found.success
    return t, found.y


def driven(name, mode, surface, t, h):
    """Rates (n, N) of the same drive at the times `t`, in steps of `h`; least tyre load."""
    one, strut_state = VARIED_PLANTS[name], settled_strut_state(encode_command(mode))
    y, every = equilibrium(one, strut_state, ZEROS), round((t[1] - t[0]) / h)
    steps = every * (t.size - 1) + 1
    out = run_integrator(
        one, y, h=h, steps=steps, surface=surface, speed=SPEED, s_0=S_0, strut_state=strut_state
    )
    rates = out[::every, 7:14]
    if one.flexible:
        rates = np.column_stack([rates, out[::every, TWIST + 1]])
    return rates.T, out[:, LOAD : LOAD + 4].min()


def distance(found, truth):
    """RMS error of the rates, relative to their RMS, the worst coordinate."""
    return np.sqrt(np.mean((found - truth) ** 2, axis=1) / np.mean(truth**2, axis=1)).max()


@every_odd
@every_mode
def test_the_method_stays_of_order_two(name, mode):
    """Also with the frame, whose coupling the step's matrix leaves out."""
    t, truth = reference(name, mode, GENTLE, 1.0)
    h, error = 0.001 / 2.0 ** np.arange(5), []
    for step in h:
        found, least = driven(name, mode, GENTLE, t, step)
        assert least > 0.0
        error.append(distance(found, truth[SIZES[name] :]))
    assert np.polyfit(np.log(h), np.log(error), 1)[0] == pytest.approx(2.0, abs=0.05)
    assert error[0] < 5e-3 and error[-1] < 2e-5


def test_its_drive_over_a_rough_road_is_what_scipy_makes_of_the_equations():
    """All deviations, wheels in the air, nothing shared: letters, curves, splines, Radau."""
    one, t = VARIED_PLANTS["flexible"], np.linspace(0.0, 0.5, 26)
    y_0 = equilibrium(one, RIDE, ZEROS)
    road = oracles.SplineRoad(ROUGH.z, ROUGH.ds)
    s_0 = 5.0  # where the wheels soon leave the ground
    truth = oracles.trajectory(
        CAR, RIDE, road, SPEED, s_0, y_0, t, VARIED_FLEXIBLE, method="Radau", rtol=1e-5, atol=1e-8
    )
    y = y_0.copy()
    out = run_integrator(one, y, h=0.0001, steps=5001, surface=ROUGH, speed=SPEED, s_0=s_0)
    assert (out[:, LOAD : LOAD + 4] == 0.0).any()
    found = np.column_stack([out[::200, 7:14], out[::200, TWIST + 1]]).T
    assert distance(found, truth[8:]) < 5e-4
    np.testing.assert_allclose(out[::200, TWIST], truth[7], atol=1e-3 * np.abs(truth[7]).max())


@every_odd
def test_without_losses_energy_is_kept_to_the_order_of_the_method(name):
    one = replace(
        VARIATIONS[name], frame=TorsionalFrame(f=11.0, zeta=0.0) if name == "flexible" else None
    )
    free, oracle = build_plant(lossless(CAR), False, one), oracles.NonlinearCar(lossless(CAR), one)
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


@every_odd
@every_mode
def test_left_alone_it_never_gains_energy_and_comes_to_rest(name, mode):
    strut_state, n = settled_strut_state(encode_command(mode)), SIZES[name]
    oracle, one = oracles.NonlinearCar(CAR, VARIATIONS[name]), VARIED_PLANTS[name]
    rest, rng = equilibrium(one, strut_state, ZEROS), np.random.default_rng(5)
    y = rest + np.concatenate([0.01 * rng.standard_normal(n), 0.3 * rng.standard_normal(n)])
    out = run_integrator(one, y, h=0.0005, steps=3000, strut_state=strut_state)
    twist = out[:, TWIST:]
    q, v = np.hstack([out[:, :7], twist[:, :1]]), np.hstack([out[:, 7:14], twist[:, 1:2]])
    energy = [oracle.energy(strut_state, *at, ZEROS) for at in zip(q[::5], v[::5], strict=True)]
    span = energy[0] - oracle.energy(strut_state, rest[:n], rest[n:], ZEROS)
    assert np.diff(energy).max() < 2e-6 * span and energy[-1] - energy[0] < -0.9 * span


def test_free_of_its_struts_the_frame_swings_at_its_frequency_and_dies_out_with_its_damping():
    """Over soft springs the body is all but free: a decaying sine of f sqrt(1 - zeta²)."""
    frame = TorsionalFrame(f=13.0, zeta=0.04)
    strut = replace(lossless(BARE).strut, x_2=40.0)
    one = build_plant(replace(lossless(BARE), strut=strut), False, VehicleVariation(frame=frame))
    y, h = equilibrium(one, RIDE, ZEROS), 0.0002
    y[7] += 0.001
    out = run_integrator(one, y, h=h, steps=5000)
    t, psi = h * np.arange(5000), out[:, TWIST]
    omega = 2.0 * np.pi * frame.f
    damped = omega * np.sqrt(1.0 - frame.zeta**2)
    decay = np.exp(-frame.zeta * omega * t)
    expected = decay * (np.cos(damped * t) + frame.zeta * omega / damped * np.sin(damped * t))
    np.testing.assert_allclose(psi, 0.001 * expected, atol=1e-5)
    shown = (out[2:, TWIST + 1] - out[:-2, TWIST + 1]) / (2.0 * h)
    np.testing.assert_allclose(out[1:-1, TWIST + 2], shown, atol=2e-3 * np.abs(shown).max())


def test_a_stiff_frame_is_no_frame():
    """At 200 Hz the halves follow each other: the drive of the odd car without a frame."""
    stiff = build_plant(CAR, False, replace(VARIED, frame=TorsionalFrame(f=200.0, zeta=0.05)))
    ends = []
    for one in (stiff, VARIED_PLANTS["varied"]):
        y = equilibrium(one, RIDE, ZEROS)
        out = run_integrator(one, y, h=0.0005, steps=2000, surface=GENTLE, speed=SPEED, s_0=S_0)
        ends.append(out[:, ACCELERATION : ACCELERATION + 7])
    assert np.sqrt(np.mean((ends[0] - ends[1]) ** 2) / np.mean(ends[1] ** 2)) < 0.02


@given(st.floats(-3.0, 3.0), st.floats(-1.0, 1.0))
def test_a_point_of_a_twisting_body_moves_with_its_half(x, y):
    signals = np.zeros((1, 32))
    signals[0, 14:17], signals[0, TWIST + 2] = (1.3, -0.4, 0.7), 0.9
    found = Trajectory(*np.zeros((4, 1)), signals).body_acceleration(x, y)
    half = -0.4 + (0.45 if x > 0.0 else -0.45 if x < 0.0 else 0.0)
    assert found[0] == pytest.approx(oracles.point_acceleration(1.3, half, 0.7, x, y), abs=1e-12)


# --- small motions, derivatives, error control ----------------------------------------------------


@every_odd
@given(vectors(7, 0.03, 0.03, 0.02, 0.06, 0.02, 0.06, 0.02), vectors(7, 0.7), twists, strut_states)
def test_about_any_state_its_model_is_the_slope_of_motion_and_sensors(name, q, v, psi, strut_state):
    one, places = VARIED_MANOEUVRE_PLANTS[name], {"RF": (1.1, -0.5), "LR": (-2.0, 0.6)}
    q, v = motion(name, q, v, psi, 0.1)
    state, z_r, n = np.concatenate([q, v]), np.array([0.0, 0.01, -0.15, 0.0]), q.size
    model = linearise(one, strut_state, places, state, z_r, 0.1 * z_r)

    def sensed(x, u):
        a = compute_accelerations(one, strut_state, x[:n], x[n:], z_r + u[:4], 0.1 * z_r + u[4:])
        felt = np.append(a, 0.0)[:8]
        rows = [
            oracles.point_acceleration(felt[0], felt[1] + np.sign(x) * 0.5 * felt[7], felt[2], x, y)
            for x, y in places.values()
        ]
        return np.append(a, rows)

    rng, eps = np.random.default_rng(0), 1e-7
    for _ in range(2):
        dx, du = rng.standard_normal(2 * n), rng.standard_normal(8)
        there, back = (sensed(state + s * dx, s * du) for s in (eps, -eps))
        slope = (there - back) / (2.0 * eps)
        found = np.append(model.A[n:] @ dx + model.B[n:] @ du, model.C @ dx + model.D @ du)
        np.testing.assert_allclose(found, slope, atol=1e-3 * np.abs(slope).max())


@every_mode
def test_a_flexible_car_has_an_eighth_mode_the_torsion_of_its_frame(mode):
    model = linearise(VARIED_PLANTS["flexible"], mode, {"RF": (1.0, -0.5)})
    assert model.A.shape == (16, 16) and model.B.shape == (16, 8) and model.M.size == 8
    assert model.states[7] == "psi" and model.states[15] == "psi_dot"
    assert model.state_units[7] == "rad" and model.state_units[15] == "rad/s"
    found = natural_modes(model)
    K = -model.M[:, None] * model.A[8:, :8]
    expected = np.sqrt(eigh(0.5 * (K + K.T), np.diag(model.M), eigvals_only=True)) / (2.0 * np.pi)
    np.testing.assert_allclose(found.f, expected, rtol=1e-9)
    at = found.names.index("frame torsion")
    assert len(set(found.names)) == 8
    assert VARIED_FLEXIBLE.frame.f < found.f[at] < 1.4 * VARIED_FLEXIBLE.frame.f
    assert model.M[7] * found.shapes[7, at] ** 2 > 0.5
    assert np.isfinite(frequency_response(model, 10.0, f=np.array([1.0, 11.0]))).all()


@every_mode
def test_the_adjoint_of_its_drive_is_the_transpose_of_its_tangent(mode):
    strut_state, steps, h = settled_strut_state(encode_command(mode)), 400, 0.001
    start = equilibrium(VARIED_PLANTS["varied"], strut_state, ZEROS)
    s = 4.0 + SPEED * 0.5 * h * np.arange(2 * steps)
    stations = np.stack([s, s - CAR.wheelbase])
    z, slope = ROUGH.height(stations), SPEED * ROUGH.slope(stations)
    road = np.stack([np.transpose(x, (2, 1, 0)).reshape(-1, 4) for x in (z, slope)], axis=1)
    tape = linearize_drive(VARIED_PLANTS["varied"], strut_state, start, road, h)
    assert (tape.signals[:, LOAD:] == 0.0).any()
    rng = np.random.default_rng(2)
    for _ in range(3):
        change = rng.standard_normal(14), 0.1 * rng.standard_normal(road.shape)
        a, end = rng.standard_normal((steps, 7)), rng.standard_normal(14)
        da, dend = tape.tangent(*change)
        back, road_back = tape.adjoint(a, end)
        forth, size = np.sum(a * da) + end @ dend, np.abs(a * da).sum() + np.abs(end * dend).sum()
        assert abs(forth - back @ change[0] - np.sum(road_back * change[1])) <= 1e-10 * size


def test_with_error_control_its_drive_is_that_of_small_constant_steps():
    t, one = (
        0.01 * np.arange(150),
        DriveSimulator(VARIED_PLANTS["varied"], CAR, ROUGH, SPEED, "ride", 0.0001),
    )
    found = integrate_adaptive(one, t, 1e-7, 1e-9).trajectory
    expected = one.advance(np.full(14901, encode_command("ride"), dtype=np.uint8))
    for name in ("state", "acceleration", "tyre_load"):
        a, b = getattr(found, name), getattr(expected, name)[::100]
        assert np.sqrt(np.mean((a - b) ** 2)) < 2e-3 * np.sqrt(np.mean(b**2)), name
    nominal = simulate_adaptive(CAR, ROUGH, SPEED, rtol=1e-4).trajectory
    assert np.abs(nominal.acceleration[:100] - found.acceleration[:100]).max() > 0.1


def test_a_flexible_car_is_refused_where_its_frame_is_not_known():
    one = VARIED_PLANTS["flexible"]
    with pytest.raises(ValueError, match="flexible frame is driven in fixed steps"):
        integrate_adaptive(DriveSimulator(one, CAR, ROUGH, SPEED), np.array([0.0, 1.0]))
    with pytest.raises(ValueError, match="flexible frame has no tape"):
        linearize_drive(one, RIDE, np.zeros(14), np.zeros((2, 2, 4)), 0.001)


# --- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"gas": (1.0, 0.0, 1.0, 1.0)}, "gas must be four positive factors"),
        ({"tyre": (1.0, float("nan"), 1.0, 1.0)}, "tyre must be four positive factors"),
        ({"tyre_progression": -1.0}, "tyre_progression must not be negative"),
        ({"roll_stiffness": (-1.0, 0.0)}, "roll_stiffness must not be negative"),
    ],
)
def test_a_car_that_cannot_be_is_refused_in_one_sentence(options, says):
    with pytest.raises(ValueError, match=says):
        VehicleVariation(**options)


def test_a_frame_needs_a_frequency_and_a_tyre_keeps_some_stiffness():
    with pytest.raises(ValueError, match="f must be positive"):
        TorsionalFrame(f=0.0, zeta=0.1)
    with pytest.raises(ValueError, match="zeta must not be negative"):
        TorsionalFrame(f=10.0, zeta=-0.1)
    with pytest.raises(ValueError, match=r"tyre_progression must be below 46\.. 1/m, got 50"):
        build_plant(DEFENDER, False, VehicleVariation(tyre_progression=50.0))
