"""Signals of a drive over distance, and the FIR bank for all speeds and strut states."""

from dataclasses import replace

import numpy as np
import pytest
from test_estimator_contract import CAR, drive

from estimators.common import spatial_signals
from estimators.common.spatial_signals import (
    DECIMATION,
    EDGE_STATIONS,
    N_MOTIONS,
    SPACING,
    SpatialSignals,
    target_profile,
    upsample,
    wheel_paths,
)
from estimators.linear import fir_bank
from estimators.linear.fir_bank import KNOTS, FirBank
from road_envs.records.record import PROFILE_SPACING, Profile, profile_stations


def interior(x: np.ndarray) -> np.ndarray:
    """The array without its ends."""
    return x[..., 2000:-2000]


def test_waves_of_the_scored_band_survive_decimation_and_upsampling():
    stations = profile_stations(200.0)
    for n, within in ((0.3, 0.005), (1.0, 0.005), (1.8, 0.025)):
        left, right = np.sin(2 * np.pi * n * stations), np.cos(2 * np.pi * n * stations)
        profile = Profile(stations, np.array([left, right]))
        z = upsample(target_profile(profile, 200.0), stations.size)
        error = interior(wheel_paths(z) - np.array([left, right]))
        assert np.abs(error).max() < within


def test_front_and_rear_motions_exclude_roll_and_roll_excludes_heave_and_pitch():
    record, _ = drive(400)
    heave, pitch, roll = np.random.default_rng(0).standard_normal((3, record.t.size))
    front, rear, y = 1.2, -2.0, 0.55
    a = np.array([heave - front * pitch - y * roll, heave - rear * pitch + y * roll,
                  heave - rear * pitch - y * roll])  # fmt: skip
    motions = spatial_signals.body_motions(replace(record, a=a), causal=False)[:N_MOTIONS]
    for row, x in enumerate((front, rear)):
        centre = replace(record, a=np.array([heave - x * pitch] * 3))
        centre_line = spatial_signals.body_motions(centre, False)[row]
        np.testing.assert_allclose(motions[row], centre_line, atol=1e-9)
    without_roll = replace(record, a=a + y * np.array([[1], [-1], [1]]) * roll)
    unrolled = spatial_signals.body_motions(without_roll, False)
    np.testing.assert_allclose(motions[:2], unrolled[:2], atol=1e-9)
    np.testing.assert_allclose(unrolled[2], 0.0, atol=1e-9)


def test_velocities_are_the_integrals_of_the_accelerations():
    record, _ = drive(401)
    w = 2.0 * np.pi * 2.0
    a = np.cos(w * record.t) * np.ones((3, 1))
    velocity = spatial_signals.body_motions(replace(record, a=a), causal=False)[N_MOTIONS]
    np.testing.assert_allclose(velocity[300:-300], np.sin(w * record.t[300:-300]) / w, atol=0.003)


def test_causal_signals_are_independent_of_samples_beyond_the_filter_reach():
    record, _ = drive(402)
    changed = replace(record, a=np.where(record.s > 10.0, 5.0, record.a))
    before, after = (SpatialSignals.of(r, 20, causal=True) for r in (record, changed))
    s = SPACING * (np.arange(before.v.size) - 20 - EDGE_STATIONS)
    past = s < 10.0 - spatial_signals.FILTER_REACH - 1e-9
    np.testing.assert_array_equal(before.motions[:, past], after.motions[:, past])
    assert np.any(before.motions[:, s > 10.0] != after.motions[:, s > 10.0])
    np.testing.assert_array_equal(before.spectrum[:, past], after.spectrum[:, past])
    assert np.any(before.spectrum[:, s > 10.0] != after.spectrum[:, s > 10.0])


def test_power_ratios_compare_motions_band_by_band():
    """Sines of 8 and 16 Hz, of which front has three times and roll half the rear's amplitude."""
    fs = 400.0
    t = np.arange(int(20.0 * fs)) / fs
    a = 5.0 * np.outer([3.0, 1.0, 0.5], np.sin(16.0 * np.pi * t))
    a += 5.0 * np.outer([1.0, 2.0, 1.0], np.sin(32.0 * np.pi * t))
    ratios = spatial_signals._power_ratios(a, fs)[:, -1].reshape(2, -1)
    limits = spatial_signals.BANDS
    low, high = (np.searchsorted(limits, f) - 1 for f in (8.0, 16.0))
    np.testing.assert_allclose(np.exp(ratios[:, low]), [9.0, 0.25], rtol=0.05)
    np.testing.assert_allclose(np.exp(ratios[:, high]), [0.25, 0.25], rtol=0.05)


def test_power_ratios_of_noise_alone_are_near_one():
    """What the sensors' noise says of the vehicle is nothing."""
    a = 0.01 * np.random.default_rng(0).standard_normal((3, 2000)) * [[1.0], [1.0], [3.0]]
    assert np.abs(spatial_signals._power_ratios(a, 400.0)).max() < 0.1


def white_signals(
    rng: np.random.Generator, v, combination: int = 0, size: int = 300
) -> SpatialSignals:
    """White motions at a speed, in one combination of strut states."""
    K = size + 2 * 20
    bits = (combination >> np.arange(3, -1, -1)) & 1
    states = np.broadcast_to(bits.astype(float), (K, 4))
    spectrum = np.zeros((spatial_signals.N_RATIOS, K))
    return SpatialSignals(
        rng.standard_normal((6, K)), np.broadcast_to(v, (K,)), states, 20, spectrum
    )


def taps_of_speed(v: float) -> np.ndarray:
    """Taps (3, 5) that are linear in the logarithm of the speed."""
    return np.outer([1.0, -0.5, 2.0], np.linspace(1.0, 2.0, 5)) * np.log(v)


def test_the_fir_bank_recovers_taps_that_vary_with_speed_and_strut_states():
    rng = np.random.default_rng(1)
    drives, targets = [], []
    for k in range(120):
        v, sign = float(np.exp(rng.uniform(np.log(1.4), np.log(20.0)))), 1.0 - 2.0 * (k % 2)
        signals = white_signals(rng, v, 15 * (k % 2))
        taps = 1e-3 * sign * taps_of_speed(v)
        windows = np.lib.stride_tricks.sliding_window_view(signals.motions[:3, 18:-18], 5, axis=1)
        m, q = windows[:2].transpose(1, 0, 2).reshape(300, 10) @ taps[:2].ravel(), windows[2]
        drives.append(signals)
        targets.append(np.array([m, q @ taps[2]]))
    bank = FirBank.fit(drives, targets, 2, 2)
    for combination, sign in ((0, 1.0), (15, -1.0)):
        for knot in range(1, KNOTS.size - 1):
            expected = sign * taps_of_speed(KNOTS[knot])
            np.testing.assert_allclose(bank.taps[combination, knot], expected, rtol=0.05, atol=0.03)
    z = bank(drives[0])
    np.testing.assert_allclose(z, targets[0], atol=0.03 * np.abs(targets[0]).max())


def test_a_state_combination_without_a_drive_gets_the_nearest_ones_taps():
    rng = np.random.default_rng(2)
    signals = [white_signals(rng, 5.0, c) for c in (0, 15)]
    bank = FirBank.fit(signals, [c.motions[:2, 20:-20] for c in signals], 2, 2)
    np.testing.assert_array_equal(bank.taps[1], bank.taps[0])
    np.testing.assert_array_equal(bank.taps[14], bank.taps[15])
    assert np.any(bank.taps[0] != bank.taps[15])


def test_taps_are_interpolated_between_speeds_and_states_at_each_station():
    rng = np.random.default_rng(3)
    taps = rng.standard_normal((16, KNOTS.size, 3, 5)).astype(np.float16)
    bank = FirBank(taps, 2)
    v = np.exp(np.linspace(np.log(1.0), np.log(30.0), 340))
    signals = white_signals(rng, v)
    signals = signals._replace(states=rng.uniform(0.0, 1.0, (340, 4)))
    z = bank(signals)
    for i in (0, 77, 299):
        k = 20 + i
        place = np.interp(np.log(v[k]), np.log(KNOTS), np.arange(KNOTS.size))
        expected = np.zeros((3, 5))
        for combination in range(16):
            on = [(combination >> b) & 1 for b in (3, 2, 1, 0)]
            share = np.prod(
                [s if o else 1.0 - s for s, o in zip(signals.states[k], on, strict=True)]
            )
            for knot in range(KNOTS.size):
                expected += share * max(0.0, 1.0 - abs(place - knot)) * taps[combination, knot]
        window = signals.motions[:3, k - 2 : k + 3]
        terms = 1e-3 * np.sum(expected * window, axis=1)
        np.testing.assert_allclose(z[:, i], [terms[0] + terms[1], terms[2]], rtol=1e-9)


def test_the_normal_equations_equal_least_squares_with_penalty_rows():
    rng = np.random.default_rng(4)
    blocks, rows, expected = fir_bank._KnotNormalEquations.zeros(3), [], []
    for v in (KNOTS[0], 2.0, 3.1, 5.0, 9.0, 20.5):
        X, z = rng.standard_normal((20, 3)), rng.standard_normal(20)
        blocks.add(X, z, v)
        place = np.interp(np.log(v), np.log(KNOTS), np.arange(KNOTS.size))
        hats = np.maximum(0.0, 1.0 - np.abs(place - np.arange(KNOTS.size)))
        rows.append(np.concatenate([hat * X for hat in hats], axis=1))
        expected.append(z)
    A, b = np.concatenate(rows), np.concatenate(expected)
    level = sum(np.trace(block) for block in blocks.diagonal) / (3 * KNOTS.size)
    ridge = np.sqrt(fir_bank.RIDGE * level) * np.eye(3 * KNOTS.size)
    steps = np.kron(np.diff(np.eye(KNOTS.size), axis=0), np.eye(3))
    steps *= np.sqrt(fir_bank.SMOOTHNESS * level)
    A = np.concatenate([A, ridge, steps])
    b = np.concatenate([b, np.zeros(len(A) - b.size)])
    solution, *_ = np.linalg.lstsq(A, b)
    np.testing.assert_allclose(blocks.solve().ravel(), solution, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("causal", [False, True])
def test_a_mirrored_drive_gives_the_mirrored_road(causal):
    from test_estimator_contract import fit

    record, _ = drive(403)
    # the right front sensor becomes the left one: on a rigid body LF = RF + LR - RR
    a = np.array([record.a[0] + record.a[1] - record.a[2], *record.a[[2, 1]]])
    mirrored = replace(record, a=a)
    estimator = fit("tcn_causal" if causal else "tcn")
    z, other = estimator.estimate(record, CAR).z, estimator.estimate(mirrored, CAR).z
    np.testing.assert_allclose(other, z[::-1], atol=1e-5 * np.abs(z).max())


def test_stations_are_every_sixth_point_of_the_profile_grid():
    assert SPACING == DECIMATION * PROFILE_SPACING
    record, _ = drive(404)
    signals = SpatialSignals.of(record, 3)
    assert signals.size == spatial_signals._n_stations(record.length)
    assert signals.motions.shape == (6, signals.v.size) and signals.states.shape == (
        signals.v.size,
        4,
    )
