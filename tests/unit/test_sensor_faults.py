"""Sensor faults against closed forms; dropouts are detected, bridged or rejected."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from vehicle_fixtures import DEFENDER

from estimators.preprocessing import clean_record, spatial_accelerations
from road_envs.records.record import Record
from road_envs.sensing.data_logger import DataLogger, load_instruments
from road_envs.sensing.sensor_faults import NO_FAULTS, JitteredSampler, SensorFaults, gauss_markov
from road_envs.simulation.drive import Trajectory
from road_envs.simulation.rosenbrock import ACCELERATION, N_SIGNALS

IDEAL, PAPER = load_instruments("ideal"), load_instruments("paper")
STEP = 0.0005


def motion(acceleration) -> Trajectory:
    """Return a trajectory of body accelerations (N, 3): heave, roll, pitch."""
    signals = np.zeros((len(acceleration), N_SIGNALS))
    signals[:, ACCELERATION : ACCELERATION + 3] = acceleration
    t = STEP * np.arange(len(acceleration))
    return Trajectory(t, 15.0 * t, np.full(t.size, 15.0), np.zeros(t.size, np.uint8), signals)


def logger(faults=NO_FAULTS, instruments=IDEAL, seed=0) -> DataLogger:
    return DataLogger(instruments, DEFENDER, STEP, np.random.default_rng(seed), faults)


# --- mounting, gain, offset -----------------------------------------------------------------------


def test_readings_follow_location_tilt_gain_and_offset():
    faults = SensorFaults(
        dx=(0.02, -0.01, 0.03), dy=(0.01, 0.04, -0.02), tilt=(0.05, -0.1, 0.2),
        gain=(1.02, 0.97, 1.0), offset=(0.1, -0.3, 0.0),
    )  # fmt: skip
    locations = [(1.395 - 0.12 + 0.02, -0.55 + 0.01), (-1.399 - 0.62 - 0.01, 0.55 + 0.04),
              (-1.399 - 0.62 + 0.03, -0.55 - 0.02)]  # fmt: skip
    for body in ([1.5, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, -3.0], [1.0, -2.0, 0.5]):
        actual = logger(faults).sample(motion(np.tile(body, (4000, 1))))[:, -1]
        for k, place in enumerate(locations):
            a = oracles.point_acceleration(*body, *place)
            projected = (a + oracles.G) * np.cos(faults.tilt[k]) - oracles.G
            expected = faults.gain[k] * projected + faults.offset[k]
            assert actual[k] == pytest.approx(expected, abs=1e-9)


def test_instruments_without_faults_sample_as_before_to_the_bit():
    trajectory = motion(2.0 * np.random.default_rng(1).standard_normal((801, 3)))
    plain, sound = logger(instruments=PAPER), logger(SensorFaults(), PAPER)
    np.testing.assert_array_equal(plain.sample(trajectory), sound.sample(trajectory))
    assert plain.flush().shape == (3, 0) and plain.speed_gain == sound.speed_gain == 1.0


def test_faults_do_not_change_the_noise_of_a_seed():
    still = motion(np.zeros((2000, 3)))
    quiet, noisy = (
        logger(SensorFaults(offset=(0.5, 0.5, 0.5)), replace(PAPER, noise_density=d)).sample(still)
        for d in (0.0, 0.01)
    )
    np.testing.assert_allclose(noisy - quiet, logger(instruments=PAPER).sample(still), atol=1e-12)


# --- speed and odometer ---------------------------------------------------------------------------


def test_the_speed_fault_multiplies_the_instruments_own_error():
    one = logger(SensorFaults(speed=0.02), replace(PAPER, speed_error=0.01), seed=4)
    own = logger(instruments=replace(PAPER, speed_error=0.01), seed=4)
    assert one.speed_gain == pytest.approx(1.02 * own.speed_gain) and own.speed_gain != 1.0


@pytest.mark.parametrize("fix", [4.0, 10.0, 50.0])
@pytest.mark.parametrize("speed", [-0.02, 0.015])
def test_position_fixes_bound_the_odometer_error(fix, speed):
    distance = np.linspace(0.0, 120.0, 200)
    actual = logger(SensorFaults(speed=speed, position_fix_length=fix)).odometer(distance)
    error = solve_ivp(lambda d, e: speed - e / fix, (0.0, 120.0), [0.0], t_eval=distance,
                      rtol=1e-10, atol=1e-13).y[0]  # fmt: skip
    np.testing.assert_allclose(actual - distance, error, atol=1e-9)
    assert (np.diff(actual) > 0.0).all()
    np.testing.assert_array_equal(
        logger(SensorFaults(speed=speed)).odometer(distance), (1.0 + speed) * distance
    )


def test_receiver_errors_have_the_stated_deviation_and_correlation_time():
    """Tolerances are four standard errors: 2000 independent processes."""
    runs = np.array(
        [gauss_markov(2.0, 30.0, 0.5, 121, np.random.default_rng(k)) for k in range(2000)]
    )
    error = 4.0 / np.sqrt(len(runs))
    for k in (0, 60, 120):  # at once stationary
        assert runs[:, k].std() == pytest.approx(2.0, rel=error)
        assert abs(runs[:, k].mean()) < 2.0 * error
    for lag in (10, 60):  # 5 s, 30 s
        found = np.mean(runs[:, 60 - lag] * runs[:, 60]) / 4.0
        assert found == pytest.approx(np.exp(-lag * 0.5 / 30.0), abs=1.5 * error)


@pytest.mark.parametrize("speed", [0.0, 0.015])
def test_the_odometer_follows_fixes_that_wander(speed):
    faults = SensorFaults(speed=speed, position_fix_length=10.0, position_noise=2.0)
    t = np.arange(10_000) / PAPER.fs
    distance = 12.0 * t + 3.0 * np.sin(t)
    actual = logger(faults, seed=5).odometer(distance) - distance
    g = gauss_markov(2.0, 30.0, 1.0 / PAPER.fs, t.size, np.random.default_rng(5).spawn(1)[0])

    def rate(d, e):
        return speed - (e - np.interp(d, distance, g)) / 10.0

    span = (0.0, float(distance[-1]))
    expected = solve_ivp(rate, span, [g[0]], t_eval=distance, max_step=0.02).y[0]
    np.testing.assert_allclose(actual, expected, atol=2e-3)
    assert np.ptp(actual) > 0.5


def test_fixes_that_wander_change_no_other_draw():
    still = motion(np.zeros((2000, 3)))
    plain = SensorFaults(jitter=1e-4, dropout_rate=0.05, position_fix_length=10.0)
    one, other = (
        logger(faults, replace(PAPER, speed_error=0.01), seed=3)
        for faults in (plain, replace(plain, position_noise=2.0))
    )
    assert one.speed_gain == other.speed_gain
    np.testing.assert_array_equal(one.sample(still), other.sample(still))


# --- clock jitter ---------------------------------------------------------------------------------


def sampled(a, every=2, parts=(), **faults):
    """Return the samples of a signal (3, N), in chunks if cuts are given."""
    one = JitteredSampler(every, STEP, SensorFaults(**faults))
    edges = [0, *sorted(parts), a.shape[1]]
    actual = [one.sample(a[:, begin:end]) for begin, end in pairwise(edges)]
    return np.concatenate([*actual, one.sample(np.zeros((3, 0)), last=True)], axis=1)


def test_jitter_on_a_ramp_causes_an_error_of_slope_times_time_error():
    jitter, slope = 2e-4, 7.0
    t = STEP * np.arange(40_001)
    ramp = slope * np.outer([1.0, -2.0, 0.5], t)
    actual = sampled(ramp, jitter=jitter)
    error = (actual / ramp[:, 1:2] * STEP - 2.0 * STEP * np.arange(actual.shape[1]))[:, 10:-10]
    # all sensors share a clock
    np.testing.assert_allclose(error[1:], error[:1].repeat(2, 0), atol=1e-12)
    assert error.std() == pytest.approx(jitter, rel=0.02)
    assert abs(error.mean()) < 5.0 * jitter / np.sqrt(error.shape[1])
    assert np.abs(error).max() <= 3.0 * jitter * (1.0 + 1e-9)


def test_the_jitter_error_on_a_tone_grows_with_its_frequency():
    t, jitter = STEP * np.arange(40_001), 1e-4
    for f in (5.0, 20.0):
        tone = np.tile(np.sin(2.0 * np.pi * f * t), (3, 1))
        error = (sampled(tone, jitter=jitter) - tone[:, ::2])[:, 10:-10]
        assert error.std() == pytest.approx(2.0 * np.pi * f * jitter / np.sqrt(2.0), rel=0.05)


@settings(max_examples=30)
@given(st.lists(st.integers(0, 700), max_size=8), st.sampled_from([1, 2, 5]),
       st.sampled_from([0.0, 1e-4, 2e-3]), st.sampled_from([0.0, 0.05]))  # fmt: skip
def test_a_stream_in_chunks_yields_the_samples_of_the_whole(cuts, every, jitter, lost):
    a = np.random.default_rng(3).standard_normal((3, 700))
    faults = {"jitter": jitter, "dropout_rate": lost, "dropout_length": 4, "seed": (7,)}
    whole = sampled(a, every, **faults)
    np.testing.assert_array_equal(sampled(a, every, cuts, **faults), whole)
    assert whole.shape[1] == -(-700 // every)
    if jitter == lost == 0.0:
        np.testing.assert_array_equal(whole, a[:, ::every])


# --- dropouts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("share", "burst"), [(0.02, 5), (0.1, 1), (0.3, 8)])
def test_dropouts_have_the_stated_rate_and_length(share, burst):
    actual = sampled(np.ones((3, 400_000)), 1, dropout_rate=share, dropout_length=burst)
    lost = np.isnan(actual)
    assert (lost == lost[0]).all()  # all sensors at once
    edges = np.flatnonzero(np.diff(lost[0].astype(int), prepend=0, append=0))
    sizes = np.diff(edges)[::2]
    spread = np.sqrt(2.0 * burst / (share * 400_000))
    assert lost[0].mean() == pytest.approx(share, rel=5.0 * spread)
    assert sizes.max() == 2 * burst - 1 and sizes.min() == 1
    assert sizes.mean() == pytest.approx(burst, rel=0.1)


def record(lost=()):
    """Return a record of smooth accelerations, NaN at `lost`."""
    t = 0.001 * np.arange(6000)
    tones = [np.sin(2.0 * np.pi * f * t + f) for f in (1.3, 4.1, 9.7)]
    a = np.array([sum(tones), tones[0] - tones[2], tones[1] + tones[2]])
    a[:, list(lost)] = np.nan
    states = np.zeros((t.size, 4), dtype=bool)
    return Record(t, a, np.full(t.size, 10.0), 10.0 * t - 5.0, states, states, 40.0)


def test_dropouts_are_bridged_with_a_small_error_and_reported():
    whole, holed = record(), record([1000, *range(2000, 2009), *range(3500, 3505)])
    error = spatial_accelerations(clean_record(holed)[0]) - spatial_accelerations(whole)
    assert 0.0 < np.abs(error).max() < 0.05
    assert (
        clean_record(whole)[1] == () and "of the samples are missing" in clean_record(holed)[1][0]
    )


# --- invalid input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"jitter": -1e-4}, "jitter: must not be negative"),
        ({"dropout_rate": -0.1}, "dropout_rate: must not be negative"),
        ({"dropout_rate": 0.5}, "dropout_rate: must be below 0.5"),
        ({"dropout_length": 0}, "dropout_length: must be at least 1"),
        ({"position_fix_length": 0.0}, "position_fix_length: must be positive"),
    ],
)
def test_invalid_faults_are_rejected_in_one_sentence(options, says):
    with pytest.raises(ValueError, match=says):
        SensorFaults(**options)
