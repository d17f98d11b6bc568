"""Digital filters, and the paper's processing of sampled accelerations (section 6)."""

from functools import cache

import numpy as np
import scipy

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd_arrays import get, put
from road_envs.records.record import F_C

LOW_PASS_ORDER = 4  # of the Butterworth low-pass of the processing


@kernel
def filter_sample(sos, filter_state, row, x):
    """Return the next output of second-order sections (n, 6) for the input `x` of a `row`.

    `filter_state` (n, k, 2) of k rows is updated in place; with SIMD lanes they are its last axis.
    """
    for i in range(sos.shape[0]):
        m0, m1 = get(filter_state, i, row, 0), get(filter_state, i, row, 1)
        y = sos[i, 0] * x + m0
        put(filter_state[i, row], 0, sos[i, 1] * x - sos[i, 4] * y + m1)
        put(filter_state[i, row], 1, sos[i, 2] * x - sos[i, 5] * y)
        x = y
    return x


@kernel(count_references=False)
def sosfilt_kernel(sos, filter_state, x, out):
    """Filter the rows of `x` (k, N) by second-order sections (n, 6) into `out` (k, N).

    `filter_state` (n, k, 2), updated in place, is the `zi` of `scipy.signal.sosfilt`, which takes
    ten times as long on the 50 samples of a control interval.
    """
    for row in range(x.shape[0]):
        for j in range(x.shape[1]):
            out[row, j] = filter_sample(sos, filter_state, row, x[row, j])


@cache
def _low_pass(order: int, f_c: float, fs: float) -> np.ndarray:
    warped = 4.0 * np.tan(np.pi * (f_c / fs))
    analogue = -warped * np.exp(0.5j * np.pi * np.arange(1.0 - order, order, 2.0) / order)
    poles = (4.0 + analogue) / (4.0 - analogue)
    half = order // 2
    pairs = 0.5 * (poles[:half] + poles[: half - 1 : -1].conj())
    pairs = pairs[np.argsort(-np.abs(1.0 - np.abs(pairs)))]  # sharpest resonance last
    sos = np.array([[1.0, 2.0, 1.0, *np.poly([p, p.conj()]).real] for p in pairs])
    sos[0, :3] *= warped**order * (1.0 / np.prod(4.0 - analogue)).real
    return sos


def butterworth_sos(order: int, f_c: float, fs: float) -> np.ndarray:
    """Return second-order sections (order / 2, 6) of a Butterworth low-pass of even order.

    `f_c` is the cut-off and `fs` the sampling rate [Hz]. They are those of `scipy.signal.butter`,
    an import of which takes longer than all the rest of an environment's start.
    """
    return _low_pass(order, f_c, fs).copy()


def preprocess_accelerations(
    a: np.ndarray, fs: float, f_c: float = F_C, causal: bool = False
) -> np.ndarray:
    """Return accelerations (k, N) [m/s²] without their mean, low-passed at `f_c` [Hz].

    The filter runs forwards and backwards without delay; both passes attenuate by 6 dB at `f_c`. If
    `causal`, a first-order high-pass at 0.05 Hz replaces the subtraction, and the filter runs
    forwards only. Raises ValueError if samples are not finite or fewer than the filter length.
    """
    if not np.isfinite(a).all():
        raise ValueError("accelerations must be finite: bridge lost samples first")
    sos = butterworth_sos(LOW_PASS_ORDER, f_c, fs)
    if not causal:
        return scipy.signal.sosfiltfilt(sos, a - a.mean(axis=1, keepdims=True), axis=1)
    high_pass = scipy.signal.butter(1, 0.05, "high", fs=fs, output="sos")
    return scipy.signal.sosfilt(np.vstack([high_pass, sos]), a, axis=1)
