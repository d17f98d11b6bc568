"""Filters, and the paper's processing of sampled accelerations (section 6)."""

from functools import cache

import numpy as np
from scipy import signal

from road_envs._numba import kernel
from road_envs.simulation.simd import get, put

LOW_PASS_ORDER = 4


@kernel
def sosfilt_kernel(sos, filter_state, x, out):
    """Filter the rows of `x` (k, N) by second-order sections (n, 6) into `out` (k, N).

    `filter_state` (n, k, 2) carries on from call to call, as `zi` of `scipy.signal.sosfilt` does
    with the same layout; that one costs ten times as much on the 50 samples of a control interval.
    With lanes, `x`, `out` and `filter_state` have them as a last axis.
    """
    for row in range(x.shape[0]):
        for i in range(sos.shape[0]):
            b0, b1, b2 = sos[i, 0], sos[i, 1], sos[i, 2]
            a1, a2 = sos[i, 4], sos[i, 5]
            m0, m1 = get(filter_state, i, row, 0), get(filter_state, i, row, 1)
            for j in range(x.shape[1]):
                value = get(x, row, j) if i == 0 else get(out, row, j)
                y = b0 * value + m0
                m0 = b1 * value - a1 * y + m1
                m1 = b2 * value - a2 * y
                put(out[row], j, y)
            put(filter_state[i, row], 0, m0)
            put(filter_state[i, row], 1, m1)


@cache
def _sections(order: int, f_c: float, fs: float, kind: str) -> np.ndarray:
    return signal.butter(order, f_c, kind, fs=fs, output="sos")


def butterworth_sos(order: int, f_c: float, fs: float, kind: str = "low") -> np.ndarray:
    """Second-order sections (n, 6) of a Butterworth filter with cut-off `f_c` at rate `fs` [Hz]."""
    return _sections(order, f_c, fs, kind).copy()


def preprocess_accelerations(
    a: np.ndarray, fs: float, f_c: float = 25.0, causal: bool = False
) -> np.ndarray:
    """Accelerations (k, N) [m/s²] without their constant trend, low-passed at `f_c` [Hz].

    Offline the mean is subtracted and the filter runs both ways, so that nothing is delayed; the
    two passes together are 6 dB down at `f_c`. Causal, the trend is removed by a first-order
    high-pass at 0.05 Hz and the filter runs once, forward. Raises ValueError on samples that are
    not finite or fewer than the filter's length.
    """
    if not np.isfinite(a).all():
        raise ValueError("accelerations to be processed must be finite")
    sos = butterworth_sos(LOW_PASS_ORDER, f_c, fs)
    if not causal:
        return signal.sosfiltfilt(sos, a - a.mean(axis=1, keepdims=True), axis=1)
    return signal.sosfilt(np.vstack([butterworth_sos(1, 0.05, fs, "high"), sos]), a, axis=1)
