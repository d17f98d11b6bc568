"""What the data logger writes, in the model: anti-alias filter and sampling at the true times."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.ndimage import spline_filter1d
from scipy.signal import butter, freqz, lfilter
from test_map_smoother import residual_at
from vehicle_fixtures import DEFENDER

from estimators.common.sensor_filter import SampledFilter, SensorFilter, _lagrange_weights
from estimators.map_smoother import preparation
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.objective import Objective
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.windows import whole_objective
from estimators.preprocessing import mask_record, restore_times
from road_envs.core import config
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Record
from road_envs.roads import realise_road
from road_envs.roads.surface import Surface
from road_envs.sensing.instruments import load_instruments

PHONE = load_instruments("phone")
MIXED = {"front": "ride", "rear": "handling"}
STEP, HALF_STEP = 1e-3, 5e-4


def sampled_filter(jitter: float = 0.0, samples: int = 300) -> SampledFilter:
    """The filter of a phone, sampled every ten steps and up to `jitter` steps later."""
    late = jitter * np.random.default_rng(2).random(samples)
    filtered = SensorFilter.of(PHONE, STEP, 100.0)
    return SampledFilter(filtered, 10.0 * np.arange(samples) + late, 10 * samples)


def record_of(name: str, surface: Surface, kmh: float, jitter: float, seed: int = 11) -> Record:
    """A record by shipped instruments, of samples up to `jitter` of an interval late or early."""
    sheet = replace(load_instruments(name), speed_error=0.0)
    drive = {"speed_kmh": kmh, "mode": MIXED, "seed": seed, "vehicle": DEFENDER}
    if not jitter:
        return simulate_record(surface, instruments=sheet, **drive)[0]
    sheet_of_steps = replace(sheet, fs=1.0 / HALF_STEP)
    fine, _ = simulate_record(surface, instruments=sheet_of_steps, step=HALF_STEP, **drive)
    even = np.arange(2.0, int(sheet.fs * fine.t[-1]) - 2.0)
    late = jitter * np.random.default_rng(seed).uniform(-1.0, 1.0, even.size)
    t = (even + late) / sheet.fs
    at = np.searchsorted(fine.t, t) - 1
    return replace(
        fine.select(at),
        t=t,
        a=CubicSpline(fine.t, fine.a, axis=1)(t),
        v=np.interp(t, fine.t, fine.v),
        s=np.interp(t, fine.t, fine.s),
    )


def residual_at_truth(objective: Objective, surface: Surface) -> float:
    """Power of the residual at the true road over that of the noise, less the sensors' means."""
    road = objective.road
    z = surface.height(road.origin + road.ds * np.arange(road.size))
    c = spline_filter1d(z - z[:, :1], order=3, axis=1, mode="nearest")
    u = road.whiten(np.diff(c, axis=1, prepend=0.0))
    residual, (one,) = residual_at(objective, objective.from_noise(u)), objective.passes
    used = one.is_used
    residual = residual - np.sum(residual * used, axis=1, keepdims=True) / used.sum(axis=1)[:, None]
    return float(np.mean((one.information * residual**2)[used]))


@pytest.mark.parametrize("jitter", [0.0, 0.3], ids=["exact clock", "jittering clock"])
@pytest.mark.parametrize("name", config.names("sensors"))
def test_at_the_true_road_the_residual_is_the_noise(name, jitter, monkeypatch):
    # narrow nodes, and means as of wider ones
    fine = replace(TUNING, node_spacings=(0.0125, 0.0125), axle_readings_per_unknown=0.25)
    monkeypatch.setattr(preparation, "TUNING", fine)
    surface = realise_road("iso_c", 11, 60.0)
    for kmh in (14.5, 54.0):
        record = record_of(name, surface, kmh, jitter)
        # samples between the simulator's steps are those of finer ones
        smoother = MapSmoother(instruments=name, step=HALF_STEP if jitter else STEP)
        drive, _ = smoother.prepare(record, DEFENDER, readings_per_unknown=0.5)
        objective = whole_objective(drive, smoother.road_prior)
        assert residual_at_truth(objective, surface) < 2.0


def test_the_filter_is_the_butterworth_filter_of_the_data_sheet():
    b, a = butter(4, 40.0, fs=1.0 / STEP)
    one, f = SensorFilter.of(PHONE, STEP, 100.0), np.array([0.0, 7.0, 40.0, 200.0])
    np.testing.assert_allclose(one.response(f), freqz(b, a, f, fs=1.0 / STEP)[1], atol=1e-9)
    x = np.random.default_rng(1).standard_normal((3, 400))
    first, state = one.filter(x[:, :170], one.at_rest(3))
    second, _ = one.filter(x[:, 170:], state)
    expected = lfilter(b, a, x, axis=1)
    np.testing.assert_allclose(np.concatenate([first, second], axis=1), expected, atol=1e-9)


def test_samples_follow_from_the_means_of_groups_of_steps_as_from_the_steps():
    for jitter in (0.0, 6.0):
        one = sampled_filter(jitter)
        t = STEP * np.arange(one.n_steps)
        tones = [np.sin(2.0 * np.pi * f * t + k) for k, f in enumerate((3.0, 20.0, 45.0))]
        sensed = np.array(tones) * np.sin(np.pi * t / t[-1]) ** 2
        exact = one.read(sensed, one.filter.at_rest(3))
        means = sensed[:, : one.n_groups * one.filter.group].reshape(3, one.n_groups, -1)
        assert one.filter.group == 4
        np.testing.assert_allclose(one.apply(means.mean(axis=2)), exact, atol=0.01)


def test_the_transpose_of_the_sampled_filter_is_its_transpose():
    one, rng = sampled_filter(6.0), np.random.default_rng(3)
    means, samples = rng.standard_normal((3, one.n_groups)), rng.standard_normal((3, 300))
    expected = np.sum(samples * one.apply(means))
    assert np.sum(means * one.apply_transpose(samples)) == pytest.approx(expected, rel=1e-10)


def test_interpolation_reproduces_a_cubic_also_just_beyond_the_ends():
    cubic = np.polynomial.Polynomial([1.0, -0.4, 0.2, 0.03])
    at = np.array([-0.6, 0.0, 3.3, 8.999, 9.4])
    found = _lagrange_weights(at, 10, 4) @ cubic(np.arange(10.0))
    np.testing.assert_allclose(found, cubic(at), atol=1e-9)


def test_the_tangent_of_filtered_samples_is_the_derivative_of_the_residual():
    record = record_of("phone", realise_road("iso_c", 11, 30.0), 36.0, 0.2)
    drive, _ = MapSmoother(instruments="phone").prepare(record, DEFENDER)
    objective = whole_objective(drive, MapSmoother().road_prior)
    rng = np.random.default_rng(5)
    x, dx = 0.3 * rng.standard_normal((2, objective.size))
    lin = objective.linearize(x)
    above, below = (residual_at(objective, x + sign * 1e-5 * dx) for sign in (1.0, -1.0))
    numeric = -(above - below) / 2e-5
    assert np.linalg.norm(lin.tangent(dx)[0] - numeric) < 0.02 * np.linalg.norm(numeric)
    y = rng.standard_normal(numeric.shape)
    assert np.sum(y * lin.tangent(dx)[0]) == pytest.approx(lin.adjoint([y]) @ dx, rel=1e-5)


def test_a_window_in_the_middle_of_a_drive_goes_on_where_the_filter_was():
    record = record_of("phone", realise_road("iso_c", 11, 60.0), 36.0, 0.0)
    drive, _ = MapSmoother(instruments="phone").prepare(record, DEFENDER)
    objective = whole_objective(drive, MapSmoother().road_prior)
    x = 0.3 * np.random.default_rng(5).standard_normal(objective.size)
    (one,), c, (_, (own,), _) = objective.passes, objective.coefficients(x), objective.split(x)
    state, strut_state, filter_state = one.state_after(c, own, 3000)
    rest = replace(one.inputs, offset=None)
    later = rest.slice_steps(3000, rest.n_steps)
    whole = one.linearize(c, own).residual
    means = one.measurements
    part = replace(
        one,
        inputs=later,
        initial_state=state,
        strut_state=strut_state,
        filter_state=filter_state,
        measurements=replace(
            means,
            y=means.y[:, 300:],
            sample_weight=means.sample_weight[:, 300:],
            sample_count=means.sample_count[:, 300:],
        ),
    )
    own[: state.size] = 0.0
    np.testing.assert_allclose(part.linearize(c, own).residual, whole[:, 300:], atol=1e-6)


def test_lost_samples_of_a_jittering_clock_are_missing_and_the_others_stay():
    record = record_of("phone", realise_road("iso_c", 11, 60.0), 36.0, 0.2)
    kept = np.ones(record.t.size, dtype=bool)
    kept[[100, 101, 250]] = False
    with_gaps = record.select(kept)
    found = restore_times(mask_record(with_gaps, PHONE), with_gaps, PHONE).record
    assert found.t.size == record.t.size
    np.testing.assert_array_equal(found.t[kept], record.t[kept])
    np.testing.assert_array_equal(np.isnan(found.a[0]), ~kept)
