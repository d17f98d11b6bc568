"""Ride comfort after ISO 2631-1: the vertical weighting Wk.

The weighting is the product of four second-order sections (ISO 2631-1, annex A; s = 2 pi i f):

    band limits   s² / (s² + √2 w1 s + w1²),   1 / (1 + √2 s/w2 + (s/w2)²)
    transition    (1 + s/w3) / (1 + s/(Q4 w4) + (s/w4)²)
    upward step   (w5² + s w5/Q5 + s²) / (w6² + s w6/Q6 + s²)
"""

import numpy as np

W_1, W_2, W_3, W_4, W_5, W_6 = 2.0 * np.pi * np.array([0.4, 100.0, 12.5, 12.5, 2.37, 3.35])
Q_4, Q_5, Q_6 = 0.63, 0.91, 0.91
SQRT_2 = np.sqrt(2.0)
WK_SECTIONS = (
    (np.array([1.0, 0.0, 0.0]), np.array([1.0, SQRT_2 * W_1, W_1**2]), 0.4),
    (np.array([W_2**2]), np.array([1.0, SQRT_2 * W_2, W_2**2]), 100.0),
    (np.array([W_4**2 / W_3, W_4**2]), np.array([1.0, W_4 / Q_4, W_4**2]), 12.5),
    (np.array([1.0, W_5 / Q_5, W_5**2]), np.array([1.0, W_6 / Q_6, W_6**2]), 3.35),
)
"""Numerator and denominator in s, and corner [Hz], of each section of Wk."""


def wk(f: np.ndarray) -> np.ndarray:
    """Return the magnitude [-] of the analogue weighting Wk at `f` [Hz], any shape."""
    return np.abs(np.prod([_response(b, a, np.asarray(f)) for b, a, _ in WK_SECTIONS], axis=0))


def wk_sos(fs: float) -> np.ndarray:
    """Return second-order sections (4, 6) of Wk for `scipy.signal.sosfilt` at the rate `fs` [Hz].

    From 0.5 to 31.5 Hz the magnitude is within 0.1 % of `wk` at fs = 1 kHz, 0.3 % at 500 Hz and
    1.6 % at 200 Hz; at 100 Hz it is within 2.2 % up to 20 Hz. Raises ValueError if `fs` is invalid.
    """
    if not 0.0 < fs < np.inf:
        raise ValueError(f"the sampling rate fs must be positive, got {fs}")
    return np.array([_match_section(b, a, corner, fs) for b, a, corner in WK_SECTIONS])


def _match_section(b: np.ndarray, a: np.ndarray, corner: float, fs: float) -> np.ndarray:
    """Return the digital section (6,) at `fs` [Hz] of an analogue section b(s) / a(s).

    The poles are mapped exactly; the zeros match the analogue magnitude at 0, at the `corner` [Hz]
    and at half the sampling rate (Vicanek, Matched second order digital filters, 2016), where the
    bilinear transform would have a zero.
    """
    f = np.array([0.0, min(corner, 0.25 * fs), 0.5 * fs])
    z = np.exp(2j * np.pi * f / fs)
    den = np.poly(np.exp(np.roots(a) / fs)).real
    gain = _response(b, a, f)
    start, middle, end = np.abs(gain * np.polyval(den, z)) ** 2
    x = np.sin(np.pi * f[1] / fs) ** 2
    curvature = (middle - start * (1.0 - x) - end * x) / (4.0 * x * (1.0 - x))
    even, odd = 0.5 * (np.sqrt(start) + np.sqrt(end)), 0.5 * (np.sqrt(start) - np.sqrt(end))
    b_0 = 0.5 * (even + np.sqrt(max(even**2 + curvature, 0.0)))
    return np.r_[b_0, odd, -0.25 * curvature / b_0, den]


def _response(b: np.ndarray, a: np.ndarray, f: np.ndarray) -> np.ndarray:
    s = 2j * np.pi * f
    return np.polyval(b, s) / np.polyval(a, s)
