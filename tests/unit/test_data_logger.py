"""The data logger against rigid-body kinematics, Welch spectra and filter formulas."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal
from vehicle_fixtures import CARS, DEFENDER

from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.kernels.filters import butterworth_sos, preprocess_accelerations, sosfilt_kernel
from road_envs.records.record import SENSORS
from road_envs.sensing.data_logger import DataLogger, load_instruments
from road_envs.simulation.drive import Trajectory
from road_envs.simulation.rosenbrock import ACCELERATION, N_SIGNALS

IDEAL, PAPER = load_instruments("ideal"), load_instruments("paper")
STEP = 0.001


def motion(acceleration) -> Trajectory:
    """Return a trajectory of body accelerations (N, 3): heave, roll, pitch."""
    signals = np.zeros((len(acceleration), N_SIGNALS))
    signals[:, ACCELERATION : ACCELERATION + 3] = acceleration
    t = STEP * np.arange(len(acceleration))
    return Trajectory(t, 15.0 * t, np.full(t.size, 15.0), np.zeros(t.size, np.uint8), signals)


def part(trajectory, where) -> Trajectory:
    fields = ("t", "s", "v", "commands", "signals")
    return Trajectory(*(getattr(trajectory, f)[where] for f in fields))


def logger(instruments=IDEAL, car=DEFENDER, step=STEP, seed=0) -> DataLogger:
    return DataLogger(instruments, car, step, np.random.default_rng(seed))


def noise(size=4000, seed=1, scale=2.0):
    return scale * np.random.default_rng(seed).standard_normal((size, 3))


# --- sensor locations -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", CARS)
def test_accelerometers_measure_the_rigid_body_at_the_papers_locations(name):
    """Locations 120 mm behind the front axle and 620 mm behind the rear one."""
    car = CARS[name]
    locations = [(car.front.x - 0.12, -0.55), (car.rear.x - 0.62, 0.55), (car.rear.x - 0.62, -0.55)]
    for heave, roll, pitch in np.vstack([np.eye(3), [1.0, -2.0, 0.5]]):
        actual = logger(car=car).sample(motion(np.tile([heave, roll, pitch], (3000, 1))))[:, -1]
        expected = [oracles.point_acceleration(heave, roll, pitch, x, y) for x, y in locations]
        np.testing.assert_allclose(actual, expected, atol=1e-9)
    assert SENSORS == ("RF", "LR", "RR")


@pytest.mark.parametrize("name", CARS)
def test_instruments_report_the_papers_sensor_locations(name):
    car = CARS[name]
    assert PAPER.locations(car) == {
        "RF": (car.front.x - 0.12, -0.55, None),
        "LR": (car.rear.x - 0.62, 0.55, None),
        "RR": (car.rear.x - 0.62, -0.55, None),
    }


def test_the_reported_response_is_that_of_the_antialias_filter():
    """Against SciPy's analogue filter, and below 30 Hz against the digital one within 0.12 ms."""
    f = np.geomspace(0.01, 1000.0, 60)
    b, a = signal.butter(4, 2.0 * np.pi * PAPER.f_alias, analog=True)
    expected = signal.freqs(b, a, 2.0 * np.pi * f)[1]
    np.testing.assert_allclose(PAPER.response(f), expected, rtol=1e-9)
    slow = f[f < 30.0]
    sampled = signal.sosfreqz(logger(PAPER, step=0.0005).sos, slow, fs=2000.0)[1]
    np.testing.assert_allclose(PAPER.response(slow), sampled, atol=1.2e-4 * 2.0 * np.pi * 30.0)


# --- noise, range, filter, samples ----------------------------------------------------------------


@pytest.mark.parametrize("step", [0.001, 0.0005])
def test_noise_has_its_density_at_every_integrator_step(step):
    """The relative error of Welch averages of K half-overlapping segments is 1.1 / sqrt(K)."""
    density, size, segment = 0.03, 2**17, 1024
    instruments = replace(IDEAL, noise_density=density)
    samples = logger(instruments, step=step).sample(motion(np.zeros((size, 3))))
    f, G = signal.welch(samples, fs=1000.0, nperseg=segment, axis=1)
    band = (f > 5.0) & (f < 100.0)
    actual = G[:, band].mean(axis=1)
    averages = 2 * samples.shape[1] / segment * band.sum() / 2.0
    np.testing.assert_allclose(actual, density**2, rtol=5.0 * 1.1 / np.sqrt(averages))
    apart = np.corrcoef(samples)
    assert np.abs(apart - np.eye(3)).max() < 5.0 / np.sqrt(samples.shape[1] / 2)


def test_the_papers_noise_has_an_rms_of_a_tenth_below_100_hertz():
    samples = logger(PAPER).sample(motion(np.zeros((2**16, 3))))
    below = signal.sosfiltfilt(signal.butter(8, 100.0, fs=1000.0, output="sos"), samples, axis=1)
    np.testing.assert_allclose(below.std(axis=1), 0.1, rtol=0.03)


def test_clipping_happens_before_the_antialias_filter():
    assert PAPER.range == pytest.approx(4.0 * oracles.G)
    blows = np.repeat([100.0, -100.0, 100.0], 1000)
    trajectory = motion(np.outer(blows, [1.0, 0.0, 0.0]))
    clipped = logger(replace(PAPER, noise_density=0.0)).sample(trajectory)
    for end, sign in ((999, 1.0), (1999, -1.0), (2999, 1.0)):
        np.testing.assert_allclose(clipped[:, end], sign * PAPER.range, rtol=1e-6)
    assert clipped.max() > 1.05 * PAPER.range  # the filter overshoots after clipping
    assert logger(IDEAL).sample(trajectory)[0, 999] == pytest.approx(100.0)


@pytest.mark.parametrize(("step", "f"), [(0.001, 100.0), (0.001, 333.0), (0.00025, 500.0),
                                         (0.00025, 900.0), (0.00025, 1500.0)])  # fmt: skip
def test_the_antialias_filter_is_a_fourth_order_butterworth(step, f):
    t = step * np.arange(round(1.0 / step))
    tone = motion(np.outer(np.sin(2.0 * np.pi * f * t), [1.0, 0.0, 0.0]))
    instruments = replace(IDEAL, fs=1.0 / step, f_alias=333.0)
    samples = logger(instruments, step=step).sample(tone)[0]
    actual = 2.0 * np.abs(np.mean((samples * np.exp(-2j * np.pi * f * t))[t >= 0.5]))
    expected = oracles.butterworth_gain(f, 333.0, 4, 1.0 / step)
    assert actual == pytest.approx(expected, rel=1e-3)
    if f == 333.0:
        assert expected == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize(("step", "every"), [(0.001, 1), (0.0005, 2), (0.0001, 10)])
def test_a_sample_is_the_filtered_acceleration_at_its_instant(step, every):
    trajectory = motion(noise(1003))
    all_of_them = logger(replace(IDEAL, fs=1.0 / step), step=step).sample(trajectory)
    np.testing.assert_array_equal(logger(step=step).sample(trajectory), all_of_them[:, ::every])


@given(st.sampled_from([2, 4, 6, 8]), st.floats(1e-3, 0.499), st.sampled_from([200.0, 1000.0]))
def test_the_low_pass_is_that_of_scipy(order, share, fs):
    expected = signal.butter(order, share * fs, fs=fs, output="sos")
    np.testing.assert_allclose(butterworth_sos(order, share * fs, fs), expected, rtol=1e-12)


def test_the_filter_kernel_agrees_with_scipy():
    a = noise(500).T
    sos, memory, out = butterworth_sos(4, 80.0, 1000.0), np.zeros((2, 3, 2)), np.empty((3, 500))
    sosfilt_kernel(sos, memory, a, out)
    expected, left = signal.sosfilt(sos, a, axis=1, zi=np.zeros((2, 3, 2)))
    np.testing.assert_allclose(out, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(memory, left, rtol=1e-10, atol=1e-12)


@settings(max_examples=25)
@given(st.lists(st.integers(0, 700), max_size=8), st.sampled_from([0.001, 0.00025]))
def test_sampling_in_chunks_equals_sampling_at_once_to_the_bit(cuts, step):
    trajectory, edges = motion(noise(700)), [0, *sorted(cuts), 700]
    whole = logger(PAPER, step=step).sample(trajectory)
    piecewise = logger(PAPER, step=step)
    parts = [piecewise.sample(part(trajectory, slice(*ends))) for ends in pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole)


def test_speed_has_one_relative_error_per_drive():
    gains = [logger(replace(PAPER, speed_error=0.02), seed=i).speed_gain for i in range(2000)]
    assert np.mean(gains) == pytest.approx(1.0, abs=5.0 * 0.02 / np.sqrt(2000))
    assert np.std(gains) == pytest.approx(0.02, rel=5.0 / np.sqrt(2 * 2000))
    assert logger(PAPER).speed_gain == 1.0


def test_a_speed_error_does_not_change_the_noise():
    trajectory = motion(np.zeros((50, 3)))
    np.testing.assert_array_equal(
        logger(PAPER).sample(trajectory),
        logger(replace(PAPER, speed_error=0.02)).sample(trajectory),
    )


@pytest.mark.parametrize(("fs", "step"), [(1000.0, 0.0003), (1000.0, 0.002), (300.0, 0.001)])
def test_a_sampling_rate_that_does_not_divide_the_steps_is_rejected(fs, step):
    with pytest.raises(ConfigError, match="whole number of integrator steps"):
        logger(replace(IDEAL, fs=fs, f_alias=100.0), step=step)


# --- processing -----------------------------------------------------------------------------------


def test_processing_removes_the_mean():
    a = 3.0 + noise(5000).T
    assert np.abs(preprocess_accelerations(a, 1000.0).mean(axis=1)).max() < 0.01
    np.testing.assert_allclose(
        preprocess_accelerations(a + 40.0, 1000.0), preprocess_accelerations(a, 1000.0), atol=1e-9
    )


def tone(f, fs=1000.0, seconds=20.0):
    return np.sin(2.0 * np.pi * f * np.arange(round(seconds * fs)) / fs)[None]


def gain(processed, f, fs=1000.0):
    """Return the complex gain of a sine in the middle of the record."""
    middle = slice(processed.shape[1] // 4, 3 * processed.shape[1] // 4)
    wave = np.exp(-2j * np.pi * f * np.arange(processed.shape[1]) / fs)
    return 2j * np.mean((processed[0] * wave)[middle])


@pytest.mark.parametrize("f", [1.0, 10.0, 25.0, 50.0])
def test_offline_processing_is_6_db_down_at_25_hertz_without_delay(f):
    actual = gain(preprocess_accelerations(tone(f), 1000.0), f)
    assert actual == pytest.approx(oracles.butterworth_gain(f, 25.0, 4, 1000.0) ** 2, abs=1e-4)
    if f == 25.0:
        assert 20.0 * np.log10(abs(actual)) == pytest.approx(-6.02, abs=0.01)


@pytest.mark.parametrize("f", [1.0, 10.0, 25.0, 50.0])
def test_causal_processing_is_3_db_down_at_25_hertz(f):
    actual = abs(gain(preprocess_accelerations(tone(f), 1000.0, causal=True), f))
    assert actual == pytest.approx(oracles.butterworth_gain(f, 25.0, 4, 1000.0), abs=2e-3)


def test_causal_processing_ignores_the_future_and_removes_the_mean():
    a = noise(4000).T
    whole, cut = (
        preprocess_accelerations(a, 1000.0, causal=True),
        preprocess_accelerations(a[:, :2500], 1000.0, causal=True),
    )
    np.testing.assert_array_equal(whole[:, :2500], cut)
    b = a.copy()
    b[:, 2500:] += 7.0
    np.testing.assert_array_equal(preprocess_accelerations(b, 1000.0, causal=True)[:, :2500], cut)
    constant = preprocess_accelerations(np.full((1, 40_000), 2.0), 1000.0, causal=True)
    assert abs(constant[0, -1]) < 2.0 * np.exp(-2.0 * np.pi * 0.05 * 39.0) + 1e-3


def test_processing_rejects_nonfinite_or_too_few_samples():
    with pytest.raises(ValueError, match="finite"):
        preprocess_accelerations(np.array([[0.0, np.nan, 1.0]]), 1000.0)
    with pytest.raises(ValueError, match="length"):
        preprocess_accelerations(np.zeros((3, 5)), 1000.0)


# --- shipped instruments --------------------------------------------------------------------------


@pytest.mark.parametrize("name", config.names("sensors"))
def test_every_shipped_set_of_instruments_produces_finite_samples(name):
    instruments = load_instruments(name)
    assert instruments.name == name
    assert np.isfinite(logger(instruments).sample(motion(noise(50)))).all()


def test_the_papers_logger_samples_at_1_khz_with_a_333_hz_filter():
    assert (PAPER.fs, PAPER.f_alias) == (1000.0, 333.0)
    assert math.isinf(IDEAL.range) and IDEAL.noise_density == 0.0
