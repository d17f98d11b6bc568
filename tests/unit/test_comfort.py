"""The Wk weighting against the tabulated values and the signal tests of the standards."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles_roads import wk_weight
from scipy.signal import freqz, sosfilt, sosfilt_zi
from weighted import apply_wk, weighted_rms

from road_envs.analysis import comfort

WEIGHTS = {1: 0.482, 2: 0.531, 4: 0.967, 5: 1.039, 8: 1.036, 12.5: 0.902, 16: 0.768, 31.5: 0.405}
BURSTS = {1: 0.0299, 2: 0.0411, 4: 0.0577, 8: 0.0814, 16: 0.115, None: 0.362}


def digital(fs, f):
    """Return the gain of the digital filter from the coefficients of its sections."""
    gains = [np.abs(freqz(s[:3], s[3:], worN=f, fs=fs)[1]) for s in comfort.wk_sos(fs)]
    return np.prod(gains, axis=0)


def saw_tooth(periods, fs=1000.0):
    """Return bursts of `periods` (None: unlimited) of 100 rad/s and 1 m/s² at 1, 11, ... 51 s."""
    t = np.arange(60 * round(fs)) / fs
    turns = (t - 1.0) * 100.0 / (2.0 * np.pi)
    if periods is not None:
        turns = ((t - 1.0) % 10.0) * 100.0 / (2.0 * np.pi)
        turns[(turns >= periods) | (t < 1.0)] = 0.0
    return (
        2.0 * (turns + 0.5 - np.floor(turns + 0.5)) - 1.0
        if periods is None
        else (2.0 * (turns - np.floor(turns + 0.5)))
    )


def test_the_analogue_weights_are_the_tabulated_ones():
    np.testing.assert_allclose(comfort.wk(list(WEIGHTS)), list(WEIGHTS.values()), atol=7e-4)


def test_the_analogue_weight_is_the_product_of_the_printed_magnitudes():
    f = np.geomspace(0.05, 400.0, 200)
    np.testing.assert_allclose(comfort.wk(f), wk_weight(f), rtol=1e-10)


@pytest.mark.parametrize(
    ("fs", "up_to", "within"),
    [(2000.0, 31.5, 3e-4), (1000.0, 31.5, 1e-3), (500.0, 31.5, 3e-3), (200.0, 31.5, 0.016),
     (100.0, 20.0, 0.022)],
)  # fmt: skip
def test_the_digital_weights_are_within_the_documented_error(fs, up_to, within):
    f = np.geomspace(0.5, up_to, 100)
    np.testing.assert_allclose(digital(fs, f), wk_weight(f), rtol=within)


@pytest.mark.parametrize("periods", BURSTS)
def test_saw_tooth_bursts_have_the_weighted_rms_of_the_standard(periods):
    rms = weighted_rms(saw_tooth(periods), 1000.0)
    assert rms == pytest.approx(BURSTS[periods], rel=0.02)  # the standard allows 10 %


@settings(deadline=None, max_examples=30)
@given(st.floats(30.0, 20000.0))
def test_the_filter_is_stable_at_any_rate(fs):
    sos = comfort.wk_sos(fs)
    assert sos.shape == (4, 6)
    for section in sos:
        assert np.abs(np.roots(section[3:])).max() < 1.0


def test_a_steady_sine_has_the_rms_of_its_weight():
    t = np.arange(0.0, 200.0, 1e-3)
    rms = weighted_rms(np.sin(2.0 * np.pi * 4.0 * t), 1000.0)
    assert rms == pytest.approx(WEIGHTS[4] / np.sqrt(2.0), rel=2e-3)


def test_a_constant_acceleration_is_filtered_out():
    a = apply_wk(np.full(60000, 9.81), 1000.0)
    assert np.abs(a[-1000:]).max() < 1e-6


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.integers(1, 999))
def test_weighting_in_pieces_equals_weighting_at_once(seed, cut):
    a = np.random.default_rng(seed).standard_normal(1000)
    sos = comfort.wk_sos(400.0)
    zi = np.zeros_like(sosfilt_zi(sos))
    head, zi = sosfilt(sos, a[:cut], zi=zi)
    tail, _ = sosfilt(sos, a[cut:], zi=zi)
    np.testing.assert_allclose(np.r_[head, tail], apply_wk(a, 400.0), atol=1e-12)


def test_channels_are_weighted_independently():
    a = np.random.default_rng(3).standard_normal((3, 5000))
    each = [weighted_rms(row, 250.0) for row in a]
    np.testing.assert_allclose(weighted_rms(a, 250.0), each)


@pytest.mark.parametrize("fs", [0.0, -1.0, np.nan, np.inf])
def test_an_invalid_sampling_rate_is_rejected(fs):
    with pytest.raises(ValueError, match="fs"):
        comfort.wk_sos(fs)
