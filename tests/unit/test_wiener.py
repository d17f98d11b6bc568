"""Wiener smoothers: against the error bound on linear vehicles, against the bound with force
residuals as noise on the nominal one, and on faulty records.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.fft import irfft
from vehicle_fixtures import DEFENDER

from estimators import create
from estimators.api import check_estimate
from estimators.preprocessing import mask_record
from estimators.wiener import iteration, spectral_model
from estimators.wiener.iteration import _gaussian_expectation
from estimators.wiener.segments import Segment, split_segments
from estimators.wiener.spectral_model import (
    SensedVehicle,
    SpectralModel,
    _build_model,
    _ShapedRoadPrior,
    fit_hyperparameters,
    run_em,
    windowed_spectrum,
)
from estimators.wiener.tuning import TUNING
from leaderboard.metrics.heights import band_pass, nrmse
from road_envs.analysis.information_bound import RoadPrior, bound
from road_envs.analysis.statistical_linearization import NonlinearResidual
from road_envs.core.config import ConfigError
from road_envs.drives.recording import simulate_record
from road_envs.records.record import PROFILE_SPACING, profile_stations, scored_band
from road_envs.roads import load_road, with_length
from road_envs.roads.surface import Surface, enveloped
from road_envs.sensing.instruments import load_instruments
from road_envs.sensing.perturbed_vehicle import perturb_vehicle
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.struts import _ModeCurves

PAPER = load_instruments("paper")
KNOWN = replace(DEFENDER, tolerances={})
SPLIT = {"front": "ride", "rear": "handling"}


@cache
def linear_car():
    """The Defender with linear dampers, no friction and a linear gas spring."""
    line = [Curve(x=(-3.0, 3.0), F=(-3.0 * c, 3.0 * c)) for c in (2000.0, 5000.0)]
    none = Curve(x=(-3.0, 3.0), F=(0.0, 0.0))
    strut = replace(
        DEFENDER.strut,
        damper=_ModeCurves(ride=line[0], handling=line[1]),
        friction=_ModeCurves(ride=none, handling=none),
    )
    return replace(DEFENDER, name="linear", strut=strut)


CARS = {"linear": linear_car(), "defender": DEFENDER}


@cache
def drive(car="defender", road="iso_d", mode="ride", speed_kmh=54.0, seed=1, length=100.0):
    surface = with_length(load_road(road), length).realise(np.random.default_rng(seed))
    given = {"ride": "ride", "handling": "handling", "split": SPLIT}[mode]
    return simulate_record(
        surface, vehicle=CARS[car], speed_kmh=speed_kmh, mode=given, instruments=PAPER, seed=seed,
        step=0.0005,
    )  # fmt: skip


def in_band(estimate, truth, speed_kmh):
    return nrmse(truth.z, estimate.z, PROFILE_SPACING, scored_band(speed_kmh / 3.6)).pooled


@pytest.mark.costly
def test_iterations_that_end_early_find_the_road_of_all_of_them(monkeypatch):
    record, truth = drive(mode="ride", length=40.0)
    early = in_band(create("iterated_wiener", adapt=False).estimate(record, DEFENDER), truth, 54.0)
    calls, residual_forces = [], iteration._residual_forces
    monkeypatch.setattr(iteration, "TUNING", replace(TUNING, converged=0.0))
    monkeypatch.setattr(spectral_model, "TUNING", replace(TUNING, level_tolerance=0.0))
    monkeypatch.setattr(
        iteration, "_residual_forces", lambda *of: calls.append(1) or residual_forces(*of)
    )
    whole = in_band(create("iterated_wiener", adapt=False).estimate(record, DEFENDER), truth, 54.0)
    assert len(calls) == 14
    assert early == pytest.approx(whole, rel=0.01)


# --- accuracy against theory ----------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["ride", "split"])
@pytest.mark.costly
def test_on_a_linear_vehicle_the_error_is_at_the_bound(mode):
    """On class B, where gas springs and bump stops stay linear."""
    errors = []
    for seed in (1, 2):
        record, truth = drive("linear", "iso_b", mode, seed=seed)
        errors.append(in_band(create("wiener").estimate(record, linear_car()), truth, 54.0))
    given = {"ride": "ride", "split": SPLIT}[mode]
    prior = RoadPrior(G_d0=64e-6)
    least = bound(linear_car(), given, 15.0, PAPER, prior).pooled
    assert np.mean(errors) == pytest.approx(least, rel=0.2)


@pytest.mark.parametrize(("mode", "speed_kmh"), [("ride", 54.0), ("handling", 30.0)])
@pytest.mark.costly
def test_on_the_defender_the_error_is_the_bound_with_residuals_as_noise(mode, speed_kmh):
    errors = []
    for seed in (1, 2):
        record, truth = drive("defender", "iso_c", mode, speed_kmh, seed)
        errors.append(in_band(create("wiener").estimate(record, DEFENDER), truth, speed_kmh))
    given = (DEFENDER, mode, speed_kmh / 3.6, PAPER, RoadPrior(G_d0=256e-6))
    expected, least = bound(*given, residual_as_noise=True).pooled, bound(*given).pooled
    assert np.mean(errors) == pytest.approx(expected, rel=0.2)
    assert np.mean(errors) > 1.3 * least


@pytest.mark.parametrize("mode", ["ride", "split"])
@pytest.mark.costly
def test_subtracting_the_force_residuals_reduces_the_error(mode):
    record, truth = drive("defender", "iso_d", mode)
    once, often = (
        in_band(create(name).estimate(record, DEFENDER), truth, 54.0)
        for name in ("wiener", "iterated_wiener")
    )
    assert often < (0.7 if mode == "ride" else 0.4) * once


@pytest.mark.parametrize("name", ["wiener", "iterated_wiener"])
def test_intervals_have_the_stated_coverage(name):
    """In the scored band; on two drives, so the tolerance is twice that of the board."""
    inside = []
    for mode in ("ride", "split"):
        record, truth = drive("defender", "iso_d", mode, length=150.0)
        found = create(name).estimate(record, KNOWN)
        error = band_pass(found.z - truth.z, PROFILE_SPACING, scored_band(15.0))
        cut = (truth.s.size - error.shape[1]) // 2
        std = found.z_std[:, cut : cut + error.shape[1]]
        inside.append([np.mean(np.abs(error) < k * std) for k in (0.6745, 1.6449)])
    half, most = np.mean(inside, axis=0)
    assert half == pytest.approx(0.5, abs=0.1)
    assert most == pytest.approx(0.9, abs=0.08)


# --- vehicles that twist and bend -----------------------------------------------------------------


def test_a_flexible_vehicle_that_is_known_costs_no_accuracy():
    given = {"vehicle": DEFENDER, "speed_kmh": 54.0, "mode": SPLIT, "length": 50.0}
    record, truth = simulate_record("iso_d", **given, instruments=PAPER, seed=901, grade="S2")
    car = replace(perturb_vehicle(DEFENDER, "S2", 901).car, tolerances={})
    assert in_band(create("iterated_wiener").estimate(record, car), truth, 54.0) < 0.10


def test_waves_are_enveloped_as_on_an_enveloped_surface():
    s, car = np.arange(0.0, 40.0, 0.01), perturb_vehicle(DEFENDER, "S2", 3).car
    vehicle, L = SensedVehicle.of(car, PAPER), car.variation.contact_length
    for n in (0.5, 2.0):
        z = np.tile(np.sin(2.0 * np.pi * n * s), (2, 1))
        smooth = enveloped(Surface(z=z, ds=0.01, start=0.0), L).height(s[500:-500])
        factor = smooth.std() / z[:, 500:-500].std()
        assert vehicle.envelope(np.array([n]))[0] == pytest.approx(factor, rel=2e-3)


# --- hyperparameters of a segment -----------------------------------------------------------------


def synthetic_segment(
    level: float, noise: float, seed: int, v: float = 10.0, w: float = 2.0, car=DEFENDER
) -> tuple[Segment, SpectralModel]:
    """A segment drawn from the model itself, with this road level and noise scale."""
    stride, size, M = 3, 4096, 3000
    mode = dict.fromkeys(("FL", "FR", "RL", "RR"), "ride")
    segment = Segment(
        np.zeros((3, M)),
        np.ones((3, M), dtype=bool),
        0,
        stride,
        v,
        mode,
        (0.0, M * stride * PROFILE_SPACING),
    )
    prior = _ShapedRoadPrior(G_d0=level, w=w)
    model = _build_model(
        SensedVehicle.of(car, PAPER), segment, prior, size, np.full(size // 2 + 1, noise)
    )
    rng = np.random.default_rng(seed)
    spectrum = model.H @ model.S @ np.conj(model.H.swapaxes(1, 2)) + model.noise_psd()
    root = np.linalg.cholesky(spectrum + 1e-18 * np.eye(3))
    white = rng.standard_normal((2, 3, model.n.size)) * np.sqrt(0.5)
    lines = np.einsum("fab,bf->af", root, white[0] + 1j * white[1])
    a = irfft(lines * np.sqrt(size / (2.0 * segment.spacing)), size)[:, :M]
    return replace(segment, a=a), model


@pytest.mark.parametrize("level", [64e-6, 1024e-6])
@pytest.mark.costly
def test_the_road_level_is_estimated_from_the_record(level):
    found = []
    for seed in (1, 2, 3):
        segment, _ = synthetic_segment(level, 1.0, seed)
        fitted = fit_hyperparameters(SensedVehicle.of(DEFENDER, PAPER), segment)
        found.append(10.0 * np.log10(fitted.prior.G_d0 / level))
    assert abs(np.mean(found)) < 0.5


@pytest.mark.parametrize("w", [1.5, 2.5])
def test_a_waviness_other_than_the_prior_is_estimated(w):
    """By octave within 1.5 dB of the true level; the prior is up to 4 dB off."""
    segment, model = synthetic_segment(1024e-6, 1.0, 7, w=w)
    fitted = fit_hyperparameters(SensedVehicle.of(DEFENDER, PAPER), segment)
    octaves = np.array([0.25, 0.5, 1.0, 2.0])
    found = 10.0 * np.log10(fitted.prior.density(octaves) / model.prior.density(octaves))
    assert np.abs(found).max() < 1.5


def test_the_noise_scale_is_separated_from_the_road_level():
    for noise in (0.5, 1.0, 4.0):
        segment, model = synthetic_segment(256e-6, noise, 4)
        supposed = replace(model, noise_scale=np.ones(model.n.size))
        prior = noise_scale = None
        for _ in range(4):
            lines = windowed_spectrum(supposed, segment)
            prior, noise_scale = run_em(supposed, lines, np.arange(3))
            supposed = replace(supposed, noise_scale=noise_scale)
        in_band = (model.f > 1.0) & (model.f < 24.0)
        ratio = np.exp(np.mean(np.log(noise_scale[in_band]))) / noise
        # the pseudo-count pulls towards 1
        assert (0.8 < ratio < 1.5) if noise < 1.0 else (0.7 < ratio < 1.2)
        assert prior.G_d0 == pytest.approx(256e-6, rel=0.2)


def test_the_expected_force_residual_equals_a_monte_carlo_mean():
    x = np.linspace(-3.0, 3.0, 4001)
    law = np.array([k * np.tanh(8.0 * x) for k in (50.0, 80.0, 10.0, 20.0)])
    bend = np.array([k * x**2 for k in (30.0, 20.0, 10.0, 5.0)])
    rest = NonlinearResidual(x, bend, x, law)
    e, w = np.full((4, 2), [-0.1, 0.2]), np.full((4, 2), [0.05, -0.3])
    std_e, std_w = np.full(4, 0.05), np.full(4, 0.2)
    mean, variance = _gaussian_expectation(rest, e, w, std_e, std_w)
    rng = np.random.default_rng(0)
    near_e = e[..., None] + 0.05 * rng.standard_normal((4, 2, 100_000))
    near_w = w[..., None] + 0.2 * rng.standard_normal((4, 2, 100_000))
    of_rate, of_extension = np.array([[50.0, 80.0, 10.0, 20.0], [30.0, 20.0, 10.0, 5.0]])
    drawn_force = of_rate[:, None, None] * np.tanh(8.0 * near_w)
    drawn_force += of_extension[:, None, None] * near_e**2
    np.testing.assert_allclose(mean, drawn_force.mean(axis=2), atol=0.5)
    np.testing.assert_allclose(variance, drawn_force.var(axis=2).mean(axis=1), rtol=0.05)


# --- properties of the estimate -------------------------------------------------------------------


@pytest.mark.parametrize("name", ["wiener", "iterated_wiener"])
@pytest.mark.costly
def test_left_and_right_paths_are_not_swapped(name):
    record, truth = drive("defender", "iso_d", "handling", 30.0)
    band = scored_band(30.0 / 3.6)
    z, y = (
        band_pass(p.z, PROFILE_SPACING, band)
        for p in (create(name).estimate(record, DEFENDER), truth)
    )
    for side in (0, 1):
        own, other = (np.corrcoef(z[side], y[k])[0, 1] for k in (side, 1 - side))
        assert own > 0.9 and other < 0.5


def test_a_sign_flip_flips_the_linear_estimate_and_an_offset_does_not_change_it():
    record, _ = drive(length=60.0)
    once = create("wiener").estimate(record, DEFENDER)
    flipped = create("wiener").estimate(replace(record, a=-record.a), DEFENDER)
    np.testing.assert_allclose(flipped.z, -once.z, atol=1e-9)
    offset = create("wiener").estimate(replace(record, a=record.a + 0.7), DEFENDER)
    np.testing.assert_allclose(offset.z, once.z, atol=1e-6)


def test_standard_deviations_follow_a_change_of_roughness():
    smooth, _ = drive("defender", "iso_b", "ride", length=150.0)
    rough, _ = drive("defender", "iso_d", "ride", length=150.0)
    channels = ("v", "spring_stiff", "damper_high")
    both = replace(
        smooth,
        t=np.concatenate([smooth.t, smooth.t[-1] + 0.001 + rough.t]),
        s=np.concatenate([smooth.s, smooth.s[-1] + 0.015 + rough.s - rough.s[0]]),
        length=300.0,
        **{k: np.concatenate([getattr(smooth, k), getattr(rough, k)]) for k in channels},
        a=np.hstack([smooth.a, rough.a]),
    )
    std = create("wiener").estimate(both, DEFENDER).z_std
    assert std[0, std.shape[1] * 5 // 6] > 2.0 * std[0, std.shape[1] // 6]


@pytest.mark.costly
def test_segments_are_joined_without_steps(monkeypatch):
    """Two segments give the estimate of one in the scored band."""
    record, truth = drive("defender", "iso_c", "ride", length=210.0)
    whole = create("wiener").estimate(record, DEFENDER)
    parts = list(split_segments(mask_record(record, PAPER), 150.0, 40.0))
    assert len(parts) == 1
    parts = list(split_segments(mask_record(record, PAPER), 100.0, 40.0))
    assert [p.core for p in parts] == [(0.0, 105.0), (105.0, 210.0)]
    monkeypatch.setattr("estimators.wiener.wiener.TUNING", replace(TUNING, segment_length=100.0))
    pieces = create("wiener").estimate(record, DEFENDER)
    band = scored_band(15.0)
    gap = band_pass(pieces.z - whole.z, PROFILE_SPACING, band).std()
    error = band_pass(whole.z - truth.z, PROFILE_SPACING, band).std()
    assert gap < 0.3 * error


# --- faults in the record -------------------------------------------------------------------------


def faulty(record, where, value, sensors=slice(None)):
    a = record.a.copy()
    a[sensors, where] = value
    return replace(record, a=a)


@pytest.mark.parametrize("value", [np.nan, np.inf, 39.24], ids=["nan", "inf", "limit"])
@pytest.mark.costly
def test_a_gap_degrades_the_estimate_only_near_the_gap(value):
    record, truth = drive()
    whole = create("wiener").estimate(record, DEFENDER)
    gap = (record.s > 70.0) & (record.s < 75.0)
    found = create("wiener").estimate(faulty(record, gap, value), DEFENDER)
    check_estimate(found, record)
    assert any("of the signals are left out" in note for note in found.notes)
    with_gap, without = (
        band_pass(z - truth.z, PROFILE_SPACING, scored_band(15.0)) for z in (found.z, whole.z)
    )
    s = truth.s[(truth.s.size - without.shape[1]) // 2 :][: without.shape[1]]
    far = (s < 50.0) | (s > 95.0)
    assert with_gap[:, far].std() < 1.25 * without[:, far].std()
    inside = (found.s > 71.0) & (found.s < 74.0)
    assert (found.z_std[:, inside] > 2.0 * whole.z_std[:, inside]).all()
    assert np.abs(found.z[:, inside]).max() < 3.0 * np.abs(truth.z).max()


def test_with_one_dead_sensor_the_mean_of_the_wheel_paths_is_estimated():
    record, truth = drive("defender", "iso_d", "split")
    found = create("wiener").estimate(faulty(record, slice(None), np.nan, [2]), DEFENDER)
    band = scored_band(15.0)
    mean = [
        band_pass(x.mean(axis=0, keepdims=True), PROFILE_SPACING, band) for x in (found.z, truth.z)
    ]
    assert np.corrcoef(mean[0][0], mean[1][0])[0, 1] > 0.8


@pytest.mark.costly
def test_varying_speed_and_mode_changes_are_noted():
    record, _ = drive(length=60.0)
    swaying = replace(record, v=record.v * (1.0 + 0.2 * np.sin(record.t)))
    notes = create("wiener").estimate(swaying, DEFENDER).notes
    assert any("treated as driven at" in note for note in notes)
    stiff = record.spring_stiff.copy()
    stiff[: record.t.size // 3] = True
    notes = create("wiener").estimate(replace(record, spring_stiff=stiff), DEFENDER).notes
    assert any("in the dominant mode" in note for note in notes)


def test_settings_are_validated():
    record, _ = drive(length=60.0)
    with pytest.raises(ConfigError, match="unknown sensor 'papre'"):
        create("wiener", instruments="papre").estimate(record, DEFENDER)
    with pytest.raises(ConfigError, match="passes: must be at least 1, got 0"):
        create("iterated_wiener", passes=0)


def test_a_segment_holds_the_record_on_profile_stations():
    record, _ = drive(length=60.0)
    (segment,) = split_segments(mask_record(record, PAPER), 100.0, 40.0)
    at = segment.spacing * (segment.first + np.arange(segment.a.shape[1]))
    assert segment.stride == int(15.0 / 100.0 / PROFILE_SPACING) and segment.v == pytest.approx(
        15.0
    )
    assert set(segment.mode.values()) == {"ride"}
    assert np.isin(
        np.round(profile_stations(60.0) / PROFILE_SPACING)[:: segment.stride],
        np.round(at / PROFILE_SPACING),
    ).all()
    valid = segment.valid.all(axis=0)
    assert valid[(at > record.s[0] + 0.2) & (at < record.s[-1] - 0.2)].all()
    assert not valid[(at < record.s[0]) | (at > record.s[-1])].any()
    slow = record.interpolate(at[valid], record.a - record.a.mean(axis=1, keepdims=True))
    assert np.corrcoef(slow[0], segment.a[0, valid])[0, 1] > 0.9
