"""Model-predictive switching: its model against SciPy, its choice in a turn, left and right."""

import numpy as np
import pytest
import scipy

from road_envs.analysis.comfort import wk_sos
from road_envs.envs.options import EnvSetup
from road_envs.policies import create
from road_envs.policies.api import PolicyContext
from road_envs.policies.mpc import EXTENSION_RATE, _pair_model, _spring_rates, _state_space
from road_envs.policies.rollout import roll_out
from road_envs.vehicle.linear_model import gaussian_damping, linearise
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")
TURN = {
    "road": "flat",
    "length": 60.0,
    "speed_kmh": 54.0,
    "control": "states",
    "sensors": "ideal",
    "observe": ["accelerations", "planar", "struts"],
}


@pytest.mark.parametrize("pair", [("ride", "ride"), ("stiff_low", "handling")])
def test_the_model_of_a_pair_is_that_of_scipy(pair):
    dt, steps, rng = 0.01, 150, np.random.default_rng(0)
    sos = wk_sos(1.0 / dt)
    A, B, C, D = _pair_model(CAR, pair, _state_space(sos), dt)
    u = rng.standard_normal((steps, 14)) * np.r_[[0.01] * 4, [0.1] * 4, [500.0] * 4, 1.0, 3.0]
    x, outputs = np.zeros(len(A)), []
    for row in u:
        outputs.append(x @ C + row @ D)
        x = A @ x + B @ row
    mode = dict(zip(("front", "rear"), pair, strict=True))
    damping = gaussian_damping(CAR, mode, EXTENSION_RATE)
    seats = {"l": (0.30, 0.38), "r": (0.30, -0.38)}
    linear = linearise(CAR, mode, seats, damping=damping)
    moment = CAR.m_b * (CAR.h_cg - 0.6)
    rates = np.zeros((7, 6))
    rates[:, :4] = linear.strut_rows.T / linear.M[:, None]
    rates[2, 4], rates[1, 5] = -moment / CAR.I_yy, moment / CAR.I_xx
    B_all = np.hstack([linear.B, np.vstack([np.zeros((7, 6)), rates])])
    D_all = np.vstack([linear.sensor_rows @ B_all[7:], np.zeros((4, 14))])
    extensions = np.hstack([linear.strut_rows, np.zeros((4, 7))])
    system = linear.A, B_all, np.vstack([linear.C, extensions]), D_all
    _, y, _ = scipy.signal.dlsim(scipy.signal.cont2discrete(system, dt), u)
    left, right = scipy.signal.sosfilt(sos, y[:, :2], axis=0).T
    outputs = np.array(outputs)
    np.testing.assert_allclose(outputs[:, 2:], y[:, 2:], rtol=1e-7, atol=1e-9)
    mean_square = 0.5 * (left**2 + right**2)
    np.testing.assert_allclose((outputs[:, :2] ** 2).sum(axis=1), mean_square, rtol=1e-6, atol=1e-9)


def test_spring_rates_are_those_of_the_gas():
    """Isothermal gas: rates as one over the columns, 0.0509 m in handling, 0.255 m in ride."""
    handling, ride = (_spring_rates(CAR, mode) for mode in ("handling", "ride"))
    np.testing.assert_allclose(handling / ride, 0.255 / 0.0509, rtol=0.06)
    assert ride == pytest.approx(2167000.0 * 0.001963 / 0.255, rel=0.2)  # paper, eq. 1


def test_it_is_firm_in_a_turn_and_the_same_to_either_side():
    actions = []
    for a_y in (4.6, -4.6):
        turn = {"kind": "steady_turn", "a_y": a_y, "begin": 1.0, "build_up": 0.4, "hold": 2.0}
        driven = roll_out(create("mpc"), {**TURN, "manoeuvre": turn}, [1])
        assert not driven.failed.any()
        actions.append(driven.actions[:, 0])
    np.testing.assert_array_equal(*actions)
    t = 0.05 * (1 + np.arange(len(actions[0])))
    assert (actions[0][t < 0.95] == 0).all()  # ride
    assert (actions[0][(t > 1.2) & (t < 1.8)] != 0).all()


@pytest.mark.parametrize("a", [8.0, -8.0])
def test_it_is_firm_before_a_body_that_rises_or_falls_reaches_its_stops(a):
    """Axles at rest, body at constant acceleration `a`: the stops are at -0.085 and 0.095 m."""
    setup = EnvSetup({**TURN, "control_rate": 50.0})

    def first_firm(a: float) -> float | None:
        policy, parts = create("mpc"), setup.observation_slices
        policy.reset(PolicyContext.from_setup(setup, 1, 0))
        row, e, rate = np.zeros((1, setup.observation_space.shape[0]), dtype=np.float32), 0.0, 0.0
        row[:, parts["speed"]] = 15.0
        for sensor in setup.instruments.accelerometers:
            row[:, parts[sensor]] = a
        while abs(e) < 0.08:
            rate += 0.02 * a
            e += 0.02 * rate
            row[:, parts["extension"]], row[:, parts["extension_rate"]] = e, rate
            if policy.act(row)[0] != 0:
                return e
        return None

    at = first_firm(a)
    assert at is not None and 0.02 < abs(at) < 0.06
    assert first_firm(0.1 * a) is None or abs(first_firm(0.1 * a)) > abs(at)
