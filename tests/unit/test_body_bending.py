"""The bending mode of the body: its shape, its response, and what the sensors get of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.integrate import quad, solve_ivp
from vehicle_fixtures import DEFENDER, smooth_road

from road_envs.sensing.data_logger import DataLogger
from road_envs.sensing.instruments import load_instruments
from road_envs.simulation.drive import DriveSimulator
from road_envs.vehicle.body_bending import BendingMotion, response, section, shape
from road_envs.vehicle.equations import THETA, Z_B, build_plant
from road_envs.vehicle.parameters import BendingMode, VehicleVariation
from road_envs.vehicle.suspension import encode_command

MODE = BendingMode(f=22.0, zeta=0.05, length=4.4)
TONES = (3.0, 9.0, 17.0, 23.0, 31.0)
IDEAL = load_instruments("ideal")


def integral(function):
    return quad(function, -0.5 * MODE.length, 0.5 * MODE.length)[0]


def test_the_shape_is_that_of_a_free_beam():
    """No net force and moment, modal mass m / 4, and psi'''' = b^4 psi with free ends."""
    assert integral(lambda x: shape(MODE, x)) == pytest.approx(0.0, abs=1e-9)
    assert integral(lambda x: x * shape(MODE, x)) == pytest.approx(0.0, abs=1e-9)
    assert integral(lambda x: shape(MODE, x) ** 2) == pytest.approx(0.25 * MODE.length)
    assert shape(MODE, 0.5 * MODE.length) == pytest.approx(1.0)
    h, b = 0.02, 4.730040744862704 / MODE.length
    x = np.arange(-0.9, 0.9, 0.1)
    stencil = np.array([shape(MODE, x + k * h) for k in (-2, -1, 0, 1, 2)])
    fourth = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) @ stencil / h**4
    np.testing.assert_allclose(fourth, b**4 * shape(MODE, x), rtol=2e-3, atol=2e-3)
    end = 0.5 * MODE.length
    moment = shape(MODE, end) - 2.0 * shape(MODE, end - 1e-3) + shape(MODE, end - 2e-3)
    assert abs(moment) / 1e-6 < 1e-2 * b**2


@pytest.mark.parametrize("f", [5.0, 22.0, 40.0])
def test_a_sine_is_answered_by_the_closed_form(f):
    """Steady state of q'' + 2 zeta w q' + w² q = F / (m / 4) for forces at one axle."""
    step = 0.0005
    t = step * np.arange(8000)
    force = 1000.0 * np.sin(2.0 * np.pi * f * t)
    heave, pitch = force / DEFENDER.m_b, -DEFENDER.front.x * force / DEFENDER.I_yy
    q = BendingMotion(MODE, DEFENDER, step).advance(heave, pitch)
    s, w = 2j * np.pi * f, 2.0 * np.pi * MODE.f
    gain = s**2 / (s**2 + 2.0 * MODE.zeta * w * s + w**2)
    assert response(MODE, np.array([f]))[0] == pytest.approx(gain)
    gain /= 0.25 * DEFENDER.m_b
    expected = 1000.0 * shape(MODE, DEFENDER.front.x) * np.imag(gain * np.exp(s * t))
    late = t > 2.0
    np.testing.assert_allclose(q[late], expected[late], atol=0.02 * np.abs(expected).max())


def test_the_digital_filter_is_exact_at_the_resonance_and_close_below():
    f = np.array([2.0, 10.0, MODE.f, 30.0])
    _, digital = signal.sosfreqz(section(MODE, 0.0005), f, fs=2000.0)
    np.testing.assert_allclose(digital, response(MODE, f), rtol=2e-3)


def test_any_motion_is_answered_as_scipy_integrates_it_and_chunks_equal_the_whole():
    step = 0.0005
    t = step * np.arange(2000)
    rng = np.random.default_rng(1)
    phases = rng.uniform(0.0, 6.0, 5)

    def heave(t):
        return sum(
            np.sin(2 * np.pi * f * t + p) - np.sin(p) for f, p in zip(TONES, phases, strict=True)
        )

    w, psi = 2.0 * np.pi * MODE.f, shape(MODE, np.array([DEFENDER.front.x, DEFENDER.rear.x]))
    x_f, x_r = DEFENDER.front.x, DEFENDER.rear.x
    share = np.array([-x_r, x_f]) / (x_f - x_r)  # without pitching
    force = lambda t: 4.0 * float(psi @ share) * heave(t)  # noqa: E731
    solved = solve_ivp(
        lambda t, y: [y[1], force(t) - 2 * MODE.zeta * w * y[1] - w**2 * y[0]],
        (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-12,
    ).y  # fmt: skip
    expected = np.array([force(k) for k in t]) - 2 * MODE.zeta * w * solved[1] - w**2 * solved[0]
    motion, level = BendingMotion(MODE, DEFENDER, step), np.zeros(t.size)
    parts = [motion.advance(heave(t)[k], level[k]) for k in (slice(0, 700), slice(700, None))]
    np.testing.assert_allclose(np.concatenate(parts), expected, atol=0.02 * np.abs(expected).max())


def test_the_sensors_measure_the_bending_at_their_places():
    drive = DriveSimulator(
        build_plant(DEFENDER), DEFENDER, smooth_road(length=10.0, height=0.01), 12.0
    )
    motion = drive.advance(np.full(drive.steps_left, encode_command("ride"), dtype=np.uint8))
    loggers = [
        DataLogger(IDEAL, car, 0.001, np.random.default_rng(1))
        for car in (DEFENDER, replace(DEFENDER, variation=VehicleVariation(bending=MODE)))
    ]
    rigid, bent = (logger.sample(motion) for logger in loggers)
    q = BendingMotion(MODE, DEFENDER, 0.001).advance(
        motion.acceleration[:, Z_B], motion.acceleration[:, THETA]
    )
    difference = bent - rigid
    x = np.array([place.x for place in IDEAL.locations(DEFENDER).values()])
    np.testing.assert_allclose(difference[1], difference[2], atol=1e-9)
    ratio = shape(MODE, x[0]) / shape(MODE, x[1])
    np.testing.assert_allclose(difference[0], ratio * difference[1], atol=1e-9)
    assert 0.7 < difference[1].std() / (shape(MODE, x[1]) * q).std() < 1.05
