"""Accelerations weighted by Wk after ISO 2631-1, and their RMS."""

import numpy as np
import scipy

from road_envs.analysis.comfort import wk_sos


def apply_wk(a: np.ndarray, fs: float) -> np.ndarray:
    """Filter accelerations `a` (..., N) [m/s²], sampled at `fs` [Hz], by Wk from rest."""
    return scipy.signal.sosfilt(wk_sos(fs), a, axis=-1)


def weighted_rms(a: np.ndarray, fs: float) -> np.ndarray:
    """Return the Wk-weighted RMS (...,) [m/s²] of vertical accelerations `a` (..., N) [m/s²]."""
    return np.sqrt(np.mean(apply_wk(a, fs) ** 2, axis=-1))
