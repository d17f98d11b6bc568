"""The model-free estimator against linear vehicles of which everything is known.

Each wheel's path acts on each sensor through a resonance of its own (SciPy's `lsim` of its transfer
function), so that the true responses have a closed form.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import signal, sparse

from estimators.api import CalibrationDrive, CalibrationError, NotFittedError, check_estimate
from estimators.linear import calibrated_fir, impulse_responses
from estimators.linear.calibrated_fir import CalibratedFir
from estimators.linear.impulse_responses import (
    N_TAPS,
    RATE,
    Responses,
    RoadDrive,
    _kernel_factor,
)
from estimators.linear.road_posterior import Nodes, NormalEquations
from estimators.preprocessing import RecordError
from road_envs.records.accelerometers import Accelerometer
from road_envs.records.record import PROFILE_SPACING, Profile, Record, profile_stations, scored_band
from road_envs.records.roughness import band_pass
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")
SPOT = Accelerometer(mounted="body", axle="front", ahead=0.0, y=0.0)
"""Where sensors are does not matter to this estimator."""

WHEELBASE, FS = 3.4, 250.0
SHARES = np.array([[0.1, 0.7, 0.0, 0.2], [0.15, 0.05, 0.7, 0.1], [0.1, 0.05, 0.2, 0.65]])
"""Shares of the wheels FL, FR, RL, RR in each sensor's motion on long waves: they sum to 1."""

FREQUENCIES, DAMPING = np.array([1.6, 1.4, 2.1, 1.9]), 0.35
"""Of the resonance through which each wheel acts [Hz]."""

SPEEDS = (6.0, 10.0, 15.0)
"""Speeds [m/s] of the calibration drives."""


def road(seed: int, length: float, rise: float = 2e-3) -> Profile:
    """Two independent random walks over distance, smoothed over 0.1 m; `rise` [m] in a metre."""
    s = profile_stations(length)
    steps = np.random.default_rng(seed).standard_normal((2, s.size)) * rise * PROFILE_SPACING**0.5
    z = signal.sosfiltfilt(
        signal.butter(2, 4.0, fs=1.0 / PROFILE_SPACING, output="sos"), np.cumsum(steps, axis=1)
    )
    return Profile(s, z - z[:, :1])


def drive(profile: Profile, v: float, noise: float = 0.02, seed: int = 0) -> Record:
    """A drive of the linear vehicle at a constant speed [m/s]."""
    length = float(profile.s[-1] + PROFILE_SPACING)
    t = np.arange(int((length + 8.0) / v * FS)) / FS
    s = v * t - 2.0
    a = np.zeros((len(SHARES), t.size))
    for wheel, f in enumerate(FREQUENCIES):
        z = np.interp(s - WHEELBASE * (wheel >= 2), profile.s, profile.z[wheel % 2])
        w = 2.0 * np.pi * f
        system = ([w**2, 0.0, 0.0], [1.0, 2.0 * DAMPING * w, w**2])
        _, response, _ = signal.lsim(system, z, t)
        a += SHARES[:, [wheel]] * response
    a += noise * np.random.default_rng(seed).standard_normal(a.shape)
    state = np.zeros((t.size, 4), dtype=bool)
    return Record(t, a, np.full(t.size, v), s, state, state, length)


@cache
def calibrated() -> CalibratedFir:
    profiles = [road(seed, 55.0) for seed in (1, 21, 22)]
    drives = [drive(p, v, seed=k) for k, (p, v) in enumerate(zip(profiles, SPEEDS, strict=True))]
    return CalibratedFir(wheelbase=WHEELBASE).fit(drives, profiles, CAR, 0)


@pytest.fixture
def short_memory(monkeypatch):
    """Half as many taps, for identifications in a fraction of the time."""
    monkeypatch.setattr(impulse_responses, "N_TAPS", N_TAPS // 2)


def error(estimate, profile: Profile, v: float) -> float:
    """In-band RMS error over the RMS of the road."""
    band = scored_band(v)
    e, z = (band_pass(x, profile.ds, band) for x in (estimate.z - profile.z, profile.z))
    return float(np.sqrt(np.mean(e**2) / np.mean(z**2)))


@pytest.mark.costly
def test_identified_responses_have_the_transfer_functions_of_the_vehicle():
    taps = calibrated().fitted_state.by_state[0].responses.taps
    f = np.array([1.0, 1.5, 2.0, 2.5, 4.0])
    found = taps @ np.exp(-2j * np.pi * np.outer(np.arange(N_TAPS) / RATE, f))
    true = np.empty((len(SHARES), 2, 2, f.size), dtype=complex)
    for wheel, resonance in enumerate(FREQUENCIES):
        x = f / resonance
        transmitted = 1.0 / (1.0 - x**2 + 2j * DAMPING * x)
        true[:, wheel // 2, wheel % 2] = SHARES[:, [wheel]] * transmitted
    assert np.abs(found - true).max() < 0.1 * np.abs(true).max()
    np.testing.assert_allclose(taps.sum(axis=(1, 2, 3)), 1.0, atol=0.1)


def test_the_long_wave_gain_is_the_motion_in_phase_with_the_road_at_half_a_hertz():
    """Of a resonance; and of one that answers a quarter of a period late, hence not in phase."""
    f_0, damping, late = 1.2, 0.3, round(0.5 * RATE)
    t, w = np.arange(N_TAPS) / RATE, 2.0 * np.pi * f_0
    w_d = w * np.sqrt(1.0 - damping**2)
    g = w**2 / w_d * np.exp(-damping * w * t) * np.sin(w_d * t) / RATE
    taps = np.zeros((2, 2, 2, N_TAPS))
    taps[0, :, 0] = 0.3 * g, 0.7 * g
    taps[1, 0, 1, late] = 1.0
    found = Responses(taps, np.zeros(impulse_responses.AR_ORDER), np.eye(2)).long_wave_gain
    x = 0.5 / f_0
    np.testing.assert_allclose(found[0], (1.0 / (1.0 - x**2 + 2j * damping * x)).real, rtol=0.05)
    assert abs(found[1]) < 0.03


@pytest.mark.parametrize("v", [8.0, 5.0])
@pytest.mark.costly
def test_another_road_is_found_at_any_speed(v):
    """A wheelbase told wrongly, and a window over distance, would not carry over."""
    profile = road(2, 100.0)
    estimate = calibrated().estimate(drive(profile, v, seed=3), CAR)
    check_estimate(estimate, drive(profile, v))
    assert error(estimate, profile, v) < 0.12


@pytest.mark.costly
def test_standard_deviations_cover_the_errors():
    profile = road(4, 200.0)
    estimate = calibrated().estimate(drive(profile, 10.0, seed=5), CAR)
    e = band_pass(estimate.z - profile.z, profile.ds, scored_band(10.0))
    cut = (profile.s.size - e.shape[1]) // 2
    ratio = np.abs(e) / estimate.z_std[:, cut : cut + e.shape[1]]
    assert np.mean(ratio < 0.6745) == pytest.approx(0.5, abs=0.15)
    assert np.mean(ratio < 1.6449) == pytest.approx(0.9, abs=0.1)


def test_amplitude_is_found_and_not_only_shape():
    profile = road(2, 100.0)
    estimate = calibrated().estimate(drive(profile, 10.0, seed=3), CAR)
    band = scored_band(10.0)
    found, true = (band_pass(z, profile.ds, band).ravel() for z in (estimate.z, profile.z))
    assert found @ true / (true @ true) == pytest.approx(1.0, abs=0.06)


@pytest.mark.usefixtures("short_memory")
@pytest.mark.costly
def test_any_number_of_sensors_serves():
    """With two of the three sensors the wheel paths are told apart less well."""
    profile, test = road(1, 40.0), road(2, 40.0)
    errors = []
    for kept in ([0, 1, 2], [0, 1]):
        layout = {f"spot_{i}": SPOT for i in kept}
        records = [
            replace(drive(each, 10.0), a=drive(each, 10.0).a[kept], sensors=layout)
            for each in (profile, test)
        ]
        one = CalibratedFir(wheelbase=WHEELBASE).fit(records[:1], [profile], CAR, 0)
        errors.append(error(one.estimate(records[1], CAR), test, 10.0))
    assert errors[0] < errors[1] < 0.7
    with pytest.raises(RecordError, match="calibrated with 2 accelerometers, the record has 3"):
        one.estimate(drive(test, 10.0), CAR)


def test_the_kernel_is_that_of_chen_ohlsson_and_ljung():
    F = _kernel_factor(np.log(0.3), 0.9)
    i = np.arange(N_TAPS)
    np.testing.assert_allclose(F @ F.T, 0.3 * 0.9 ** np.maximum.outer(i, i), atol=1e-12)


def test_the_banded_posterior_is_the_dense_one():
    """Normal equations with whitened rows, written out as one dense matrix."""
    profile = road(6, 30.0)
    record, responses = drive(profile, 10.0), calibrated().fitted_state.by_state[0].responses
    t = impulse_responses.sample_times(record)
    a = impulse_responses.sensed(record, t)
    nodes = Nodes(-4.0, 0.3, 130)
    fine = impulse_responses.fine_stations(record, t)
    roads = [nodes.accelerations(fine - axle) for axle in (0.0, WHEELBASE)]
    settings = np.array([-9.0, 0.4])
    found = NormalEquations.of(responses, a, roads).solve(nodes.prior_bands(), settings)

    G = np.zeros((len(a), t.size, nodes.size, 2))
    for sensor, by_axle in enumerate(responses.taps):
        for axle, by_path in enumerate(by_axle):
            for path, taps in enumerate(by_path):
                past = signal.lfilter(taps, 1.0, roads[axle].toarray(), axis=0)
                G[sensor, :, :, path] += past
    white = signal.lfilter(np.append(1.0, -responses.ar), 1.0, G, axis=1)
    H = white.transpose(1, 0, 2, 3).reshape(t.size, len(a), -1)
    y = signal.lfilter(np.append(1.0, -responses.ar), 1.0, a).T
    weight = np.linalg.inv(responses.innovation) / np.exp(0.4)
    size = nodes.size
    walk = np.diff(np.eye(size), axis=0)
    prior = np.kron(walk.T @ walk + (0.3 / 16.0) ** 2 * np.eye(size), np.eye(2))
    prior += 0.5 * (0.3 / 1.2) ** 2 * np.kron(np.eye(size), [[1.0, -1.0], [-1.0, 1.0]])
    precision = np.einsum("nip,ij,njq->pq", H, weight, H) + np.exp(9.0) * prior / 0.3
    mean = np.linalg.solve(precision, np.einsum("nip,ij,nj->p", H, weight, y))
    np.testing.assert_allclose(found.mean, mean, atol=1e-6 * np.abs(mean).max())
    draws = found.draw(4000, np.random.default_rng(0))
    variance = np.diag(np.linalg.inv(precision))
    np.testing.assert_allclose(np.var(draws, axis=1), variance, rtol=0.2)


def test_spline_nodes_give_the_acceleration_of_a_smooth_road():
    """Of a sine: its second derivative in time, from spline coefficients and from a profile."""
    v, k = 8.0, 2.0 * np.pi * 0.7
    t = np.arange(int(20.0 / v * FS)) / FS
    state = np.zeros((t.size, 4), dtype=bool)
    record = Record(t, np.zeros((3, t.size)), np.full(t.size, v), v * t, state, state, 20.0)
    nodes = Nodes(-5.0, 0.1, 320)
    at = nodes.start + nodes.ds * np.arange(nodes.size)
    attenuation = (2.0 + np.cos(k * nodes.ds)) / 3.0  # of coefficients, at the nodes
    times = impulse_responses.sample_times(record)
    U = nodes.accelerations(impulse_responses.fine_stations(record, times))
    assert sparse.issparse(U)
    inner = slice(20, -20)
    true = -((k * v) ** 2) * np.sin(k * v * times)
    found = U @ (np.sin(k * at) / attenuation)
    np.testing.assert_allclose(found[inner], true[inner], atol=0.02 * np.abs(true).max())
    s = PROFILE_SPACING * np.arange(-200, 1000)
    profile = Profile(s, np.array([np.sin(k * s), 0.0 * s]))
    ((u,),) = RoadDrive.of(record, profile, np.zeros(1)).u[None, :, :1]
    np.testing.assert_allclose(u[0][inner], true[inner], atol=0.02 * np.abs(true).max())


def test_weights_restore_the_estimator():
    profile = road(2, 60.0)
    again = CalibratedFir(wheelbase=WHEELBASE).with_weights(calibrated().weights())
    record = drive(profile, 10.0)
    for name in ("z", "z_std"):
        one, other = (getattr(x.estimate(record, CAR), name) for x in (calibrated(), again))
        np.testing.assert_array_equal(one, other)


def calibrate(record: Record, profile: Profile | None):
    return CalibratedFir(wheelbase=WHEELBASE).calibrate(
        [CalibrationDrive(record, profile, name="a.csv")], CAR
    )


REFUSED = {
    "millimetres": (lambda r, p: (r, Profile(p.s, 1e3 * p.z)), "units of heights"),
    "units of gravity": (lambda r, p: (replace(r, a=r.a / 9.81), p), "units of heights"),
    "downwards": (lambda r, p: (replace(r, a=-r.a), p), "axis that points down"),
    "reversed": (lambda r, p: (r, Profile(p.s, p.z[::-1, ::-1])), "the profile is reversed"),
    "elsewhere": (
        lambda r, p: (r, Profile(p.s + 4.0, p.z)),
        r"the profile lies \+[345]\.\d m from where",
    ),
    "another road": (lambda r, p: (r, road(9, 35.0)), "another road or lane, or too smooth"),
    "short": (lambda r, p: (r, Profile(p.s[:700], p.z[:, :700])), "at least 25 m"),
    "one path": (lambda r, p: (r, Profile(p.s, p.z[[0, 0]])), "difference of the wheel paths"),
    "a sine": (
        lambda r, p: (r, Profile(p.s, np.sin(np.outer([3.0, 5.0], p.s)))),
        "independent frequencies",
    ),
    "unmeasured": (lambda r, p: (r, None), "has no model of the vehicle"),
}


@pytest.mark.usefixtures("short_memory")
@pytest.mark.parametrize("fault", REFUSED)
@pytest.mark.costly
def test_calibration_drives_that_tell_nothing_are_refused(fault):
    profile = road(1, 35.0)
    change, message = REFUSED[fault]
    with pytest.raises(CalibrationError, match=message):
        calibrate(*change(drive(profile, 10.0), profile))


def test_it_must_be_calibrated_before_use():
    with pytest.raises(NotFittedError, match="road-recon train"):
        CalibratedFir().estimate(drive(road(1, 30.0), 10.0), CAR)


@pytest.mark.usefixtures("short_memory")
@pytest.mark.costly
def test_each_strut_state_has_its_own_responses():
    profile = road(1, 30.0)
    soft = drive(profile, 10.0)
    stiff = replace(
        soft, a=0.5 * soft.a + 0.5 * soft.a.mean(axis=0), spring_stiff=~soft.spring_stiff
    )
    both = CalibratedFir(wheelbase=WHEELBASE).calibrate(
        [CalibrationDrive(soft, profile), CalibrationDrive(stiff, profile)], CAR
    )
    alone = calibrate(stiff, profile)
    for one, other in zip(both.estimate(stiff, CAR).z, alone.estimate(stiff, CAR).z, strict=True):
        np.testing.assert_array_equal(one, other)
    other_state = replace(soft, damper_high=~soft.damper_high, spring_stiff=~soft.spring_stiff)
    assert any("no calibration drive" in note for note in both.estimate(other_state, CAR).notes)


@pytest.mark.costly
def test_a_second_calibration_starts_from_the_responses_before_it():
    """Drives of a vehicle like it serve as prior for one short drive of the vehicle itself."""
    short, test = road(14, 40.0), road(15, 60.0)
    record, known = drive(test, 10.0), drive(short, 10.0, seed=9)
    alone, both = (
        calibrate(known, short),
        calibrated().calibrate([CalibrationDrive(known, short)], CAR),
    )
    assert error(both.estimate(record, CAR), test, 10.0) < 0.8 * error(
        alone.estimate(record, CAR), test, 10.0
    )
    assert both.calibrate([CalibrationDrive(record)], CAR) is both


@pytest.mark.costly
def test_a_long_road_is_estimated_in_windows_that_agree(monkeypatch):
    profile = road(2, 130.0)
    record = drive(profile, 10.0)
    whole = calibrated().estimate(record, CAR).z
    monkeypatch.setattr("estimators.linear.calibrated_fir._WINDOW", 65.0)
    parts = calibrated().estimate(record, CAR).z
    band = scored_band(10.0)
    difference = band_pass(whole - parts, profile.ds, band)
    assert np.sqrt(np.mean(difference**2)) < 0.1 * np.std(band_pass(profile.z, profile.ds, band))


def test_the_posterior_module_solves_for_the_most_probable_settings():
    """Ten times the noise raises the factor on the noise by its square."""
    profile = road(6, 60.0)
    responses = calibrated().fitted_state.by_state[0].responses
    found = []
    for noise in (0.02, 0.2):
        record = drive(profile, 10.0, noise)
        t = impulse_responses.sample_times(record)
        fine = impulse_responses.fine_stations(record, t)
        nodes = Nodes(-8.0, 0.2, 380)
        roads = [nodes.accelerations(fine - axle) for axle in (0.0, WHEELBASE)]
        data = NormalEquations.of(responses, impulse_responses.sensed(record, t), roads)
        found.append(data.fit_settings(nodes.prior_bands()))
        best = data.solve(nodes.prior_bands(), found[-1]).log_likelihood
        for change in ([0.3, 0.0], [-0.3, 0.0], [0.0, 0.1], [0.0, -0.1], [0.3, 0.3], [-0.3, -0.3]):
            other = data.solve(nodes.prior_bands(), found[-1] + change)
            assert other.log_likelihood < best
    assert found[1][1] > found[0][1] + 1.0
    assert abs(found[1][0] - found[0][0]) < 0.7


@pytest.mark.costly
def test_responses_that_tell_nothing_of_a_held_out_road_are_refused(monkeypatch):
    profile = road(1, 55.0)
    monkeypatch.setattr(calibrated_fir, "_MAX_HELD_OUT", 0.01)
    with pytest.raises(CalibrationError, match=r"held out the error is 0\.\d+ of the road"):
        CalibratedFir(wheelbase=WHEELBASE).fit([drive(profile, 10.0)], [profile], CAR, 0)
