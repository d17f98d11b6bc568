"""Impulse responses from the road to accelerometers, identified on a known profile.

    a_j(t) = sum_x sum_p sum_i  g_jxp[i] u_xp(t - i / RATE) + e_j(t)

u_xp is the vertical acceleration d²z/dt² of the wheel path p (left, right) at the axle x while it
passes; g_jxp [-] is what the sensor j makes of it. Nothing is known of the vehicle but the distance
between its axles, because this delay changes with speed; the responses, which belong to springs,
dampers and masses, do not.

The taps have a Gaussian prior with the covariance c lambda^max(i, i'), of smooth and decaying
responses (the "TC kernel" of Chen, Ohlsson & Ljung, Automatica 48, 2012). Scale c, decay lambda and
noise of each sensor are those of the largest marginal likelihood. The residual e holds friction and
other nonlinearities beside the sensors' noise. It is modelled as autoregressive, equally for all
sensors, with correlated innovations, and the taps are fitted again to signals whitened by this
model.
"""

from collections.abc import Sequence
from functools import cache, reduce
from typing import NamedTuple

import numpy as np
from scipy import signal
from scipy.linalg import cho_solve, solve_toeplitz
from scipy.optimize import minimize

from estimators.common.blas import single_blas_thread
from estimators.common.least_squares import LeastSquaresSums
from road_envs.kernels.filters import preprocess_accelerations
from road_envs.records.record import F_C, Profile, Record

RATE = 62.5  # rate [Hz] of signals and taps, 2.5 times the bandwidth F_C
OVERSAMPLING = 8  # instants per sample at which the road under an axle is read, before its low-pass
_STOP_FREQUENCY = 36.0  # [Hz] from which the low-pass of the road's acceleration leaves nothing
# Duration of the responses [s]: bounce at 1.2 Hz with a damping ratio of 0.25 has then fallen to
# a tenth
MEMORY = 1.2
N_TAPS = int(MEMORY * RATE)
AR_ORDER = 12
_SEGMENTS = 5  # parts of each drive; every one is predicted from the others
F_BODY = 0.5  # [Hz] below which accelerometers measure offset and drift rather than the road
# First guess of log c, logit lambda, and log of the noise's share in a sensor's power
_START = (np.log(0.01), np.log(13.0), np.log(0.1))
_DriveData = tuple[np.ndarray, np.ndarray, np.ndarray]  # regressors (N, p), a (k, N), segment (N,)


class RoadDrive(NamedTuple):
    """Sensors `a` (k, N) [m/s²], road accelerations `u` (axles, 2, N) [m/s²] and stations `s` (N,)
    [m] of the first axle in a drive, and the `segment` (N,) of each sample, -1 where it is not
    used.
    """

    a: np.ndarray
    u: np.ndarray
    s: np.ndarray
    segment: np.ndarray

    @classmethod
    def of(cls, record: Record, profile: Profile, axles: np.ndarray) -> "RoadDrive":
        """Return a drive over a known `profile`; `axles` (X,) [m] behind the first. Used are
        samples with all axles on the profile. Its heights go on beyond its ends as they are there.
        """
        t = sample_times(record)
        fine, s = fine_stations(record, t), np.interp(t, record.t, record.s)
        weights = acceleration_filter()
        fine_z = [[np.interp(fine - axle, profile.s, z) for z in profile.z] for axle in axles]
        u = np.apply_along_axis(np.convolve, 2, fine_z, weights, "valid")[:, :, ::OVERSAMPLING]
        return cls(sensed(record, t), u.copy(), s, cls.segment_of(s, profile, axles))

    @staticmethod
    def segment_of(s: np.ndarray, profile: Profile, axles: np.ndarray) -> np.ndarray:
        """Return the segment (N,) at first-axle stations `s` [m]; -1 if an axle is beyond."""
        start, end = profile.s[0] + axles[-1], profile.s[-1]
        part = np.floor(_SEGMENTS * (s - start) / max(end - start, 1e-9)).astype(int)
        return np.where((part >= 0) & (part < _SEGMENTS), part, -1)

    @single_blas_thread()
    def quick_explained(self) -> np.ndarray:
        """Return the shares (k,) of the sensors' power that responses of the usual size and decay
        predict in segments that they were not identified in.
        """
        parts = _segment_sums([(_stack_delays(self.u), self.a, self.segment)], np.ones(1))
        total = reduce(LeastSquaresSums.plus, parts)
        settings = [_first_guess(total, j) for j in range(len(self.a))]
        return _explained(parts, settings, total.ZZ)


class Responses(NamedTuple):
    """Responses and noise of the sensors of one vehicle in one state of its struts.

    `taps` (k, axles, 2, N_TAPS) [-] by sensor, axle and wheel path; `ar` (AR_ORDER,): coefficients
    of the residual's autoregression; `innovation` (k, k) [(m/s²)²]: covariance of its innovations
    at RATE.
    """

    taps: np.ndarray
    ar: np.ndarray
    innovation: np.ndarray

    @property
    def long_wave_gain(self) -> np.ndarray:
        """Motion of each sensor in phase with the road (k,), relative to it, at F_BODY.

        About 1 for any vehicle on its springs: that is the real part of
        (1 + 2 i d x) / (1 - x² + 2 i d x) at its resonance, x = 1, and far below. Drives do not
        determine the sum of the taps, the gain at zero frequency.
        """
        turn = np.exp(-2j * np.pi * F_BODY / RATE * np.arange(N_TAPS))
        return (self.taps.sum(axis=(1, 2)) @ turn).real


class IdentifiedResponses(NamedTuple):
    """`responses`; those without each segment, `held_out` (_SEGMENTS,); and the shares `explained`
    (k,) of each sensor's power in segments that were not used.
    """

    responses: Responses
    held_out: list[Responses]
    explained: np.ndarray

    @classmethod
    @single_blas_thread()
    def identify(
        cls, drives: Sequence[RoadDrive], prior: np.ndarray | None = None
    ) -> "IdentifiedResponses":
        """Identify the responses from drives of one vehicle in one state.

        `prior` (k, axles, 2, N_TAPS): mean of the taps before these drives, by default 0.
        """
        k, shape = len(drives[0].a), (*drives[0].u.shape[:2], N_TAPS)
        mean = np.zeros((k, int(np.prod(shape)))) if prior is None else prior.reshape(k, -1)
        stacked = [(drive, _stack_delays(drive.u)) for drive in drives]
        data = [(X, drive.a - mean @ X.T, drive.segment) for drive, X in stacked]
        parts = _segment_sums(data, np.ones(1))
        total = reduce(LeastSquaresSums.plus, parts)
        settings = [_fit_settings(total, j) for j in range(k)]
        powers = [np.sum(drive.a[:, drive.segment >= 0] ** 2, axis=1) for drive in drives]
        explained = _explained(parts, settings, np.sum(powers, axis=0))
        ar = _fit_autoregression(_residuals(data, _solve_taps(total, settings)))
        white = np.append(1.0, -ar)
        parts = _segment_sums(data, white)
        total = reduce(LeastSquaresSums.plus, parts)
        settings = [_fit_settings(total, j) for j in range(k)]
        theta = _solve_taps(total, settings)
        e = [signal.lfilter(white, 1.0, x) for x in _residuals(data, theta)]
        innovation = np.cov(np.concatenate(e, axis=1), bias=True).reshape(k, k)
        held_out = [_solve_taps(total.plus(part, -1), settings) for part in parts]
        first, *others = [
            Responses((mean + x).reshape(k, *shape), ar, innovation) for x in (theta, *held_out)
        ]
        return cls(first, others, explained)


def sample_times(record: Record) -> np.ndarray:
    """Return the instants (N,) [s] at RATE within a record."""
    return record.t[0] + np.arange(int((record.t[-1] - record.t[0]) * RATE + 1e-6) + 1) / RATE


def sensed(record: Record, t: np.ndarray) -> np.ndarray:
    """Return the processed accelerations (k, N) [m/s²] at the instants `t`."""
    a = preprocess_accelerations(record.a, record.fs, F_C)
    return np.array([np.interp(t, record.t, x) for x in a])


@cache
def acceleration_filter() -> np.ndarray:
    """Return the taps [1/s²] of a low-pass and a second difference, at RATE * OVERSAMPLING."""
    fs = RATE * OVERSAMPLING
    length, beta = signal.kaiserord(50.0, (_STOP_FREQUENCY - F_C) / (0.5 * fs))
    cut = 0.5 * (F_C + _STOP_FREQUENCY)
    low_pass = signal.firwin(length | 1, cut, window=("kaiser", beta), fs=fs)
    return np.convolve(low_pass, np.array([1.0, -2.0, 1.0]) * fs**2)


def fine_stations(record: Record, t: np.ndarray) -> np.ndarray:
    """Return the stations [m] of the first axle at all instants that the acceleration filter needs
    for the samples at `t` (N,); beyond the record at the speeds of its ends.
    """
    reach, fs = acceleration_filter().size // 2, RATE * OVERSAMPLING
    fine = t[0] + np.arange(-reach, (t.size - 1) * OVERSAMPLING + reach + 1) / fs
    s = np.interp(fine, record.t, record.s)
    s += np.minimum(fine - record.t[0], 0.0) * record.v[0]
    return s + np.maximum(fine - record.t[-1], 0.0) * record.v[-1]


def _stack_delays(u: np.ndarray) -> np.ndarray:
    """Return the regressors (N, inputs N_TAPS) of inputs `u` (..., N), zero before them."""
    # a window ends at each sample; reversed, its first value is the newest, as taps count back
    padded = np.pad(u.reshape(-1, u.shape[-1]), ((0, 0), (N_TAPS - 1, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, N_TAPS, axis=1)[:, :, ::-1]
    return np.concatenate(list(windows), axis=1)


def _explained(
    parts: Sequence[LeastSquaresSums], settings: Sequence[np.ndarray], power: np.ndarray
) -> np.ndarray:
    """Return the shares (k,) of the sensors' `power` (k,) that are predicted in parts left out."""
    total, left = reduce(LeastSquaresSums.plus, parts), np.zeros(power.shape)
    for part in parts:
        taps = _solve_taps(total.plus(part, -1), settings)
        # |z - X taps|² of the part from its sums alone, for each sensor
        left += part.ZZ + np.sum(taps * (taps @ part.XX - 2.0 * part.XZ.T), axis=1)
    return 1.0 - left / np.maximum(power, 1e-12)


def _solve_taps(sums: LeastSquaresSums, settings: Sequence[np.ndarray]) -> np.ndarray:
    """Return the posterior means (k, p) of the taps of all sensors under their `settings`."""
    return np.array([_posterior(sums, j, x)[1] for j, x in enumerate(settings)])


def _kernel_factor(log_scale: float, decay: float) -> np.ndarray:
    """Return F (T, T) with F F' = c decay^max(i, j), the TC kernel of T = N_TAPS taps."""
    # a random walk that begins at the last tap: the variances of its steps are differences
    steps = decay ** np.arange(N_TAPS) * np.append(np.full(N_TAPS - 1, 1.0 - decay), 1.0)
    return np.exp(0.5 * log_scale) * np.triu(np.ones((N_TAPS, N_TAPS))) * np.sqrt(steps)


def _posterior(sums: LeastSquaresSums, j: int, settings: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the negative log marginal likelihood of sensor `j` and its taps' posterior mean (p,).
    `settings`: log c, logit lambda, log of the noise variance.
    """
    # taps are F w with white w: M is the Gram matrix of w, F' (X'X) F block by block of inputs
    F = _kernel_factor(settings[0], 1.0 / (1.0 + np.exp(-settings[1])))
    inputs, noise = len(sums.XX) // N_TAPS, float(np.exp(settings[2]))
    blocks = sums.XX.reshape(inputs, N_TAPS, inputs, N_TAPS)
    M = np.einsum("ij,aibk->ajbk", F, blocks @ F, optimize=True).reshape(sums.XX.shape)
    b = (sums.XZ[:, j].reshape(inputs, N_TAPS) @ F).ravel()
    factor = np.linalg.cholesky(M / noise + np.eye(len(M)))
    w = cho_solve((factor, True), b / noise)
    misfit = (float(sums.ZZ[j]) - b @ w) / noise
    loss = 0.5 * (misfit + sums.n * settings[2]) + np.log(np.diag(factor)).sum()
    return float(loss), (w.reshape(inputs, N_TAPS) @ F.T).ravel()


def _first_guess(sums: LeastSquaresSums, j: int) -> np.ndarray:
    """Return the settings _START, the noise as a share of the power of sensor `j`."""
    power = float(sums.ZZ[j]) / max(sums.n, 1) + 1e-12
    return np.array(_START) + np.array([0.0, 0.0, np.log(power)])


def _fit_settings(sums: LeastSquaresSums, j: int) -> np.ndarray:
    """Return the settings of the largest marginal likelihood of sensor `j`."""
    start = _first_guess(sums, j)
    simplex = start + np.array([[0, 0, 0], [1.5, 0, 0], [0, 0.7, 0], [0, 0, -1.5]])
    options = {"xatol": 0.05, "fatol": 0.5, "maxiter": 60, "initial_simplex": simplex}
    return minimize(
        lambda x: _posterior(sums, j, x)[0], start, method="Nelder-Mead", options=options
    ).x


def _segment_sums(data: list[_DriveData], white: np.ndarray) -> list[LeastSquaresSums]:
    """Return the sums of each segment over all drives, of signals filtered by `white`."""
    sums = [LeastSquaresSums.zeros(data[0][0].shape[1], len(data[0][1]))] * _SEGMENTS
    for X, a, segment in data:
        xw, yw = signal.lfilter(white, 1.0, X, axis=0), signal.lfilter(white, 1.0, a)
        for part in range(_SEGMENTS):
            here = segment == part
            sums[part] = sums[part].plus(LeastSquaresSums.from_samples(xw[here], yw[:, here].T))
    return sums


def _residuals(data: list[_DriveData], theta: np.ndarray) -> list[np.ndarray]:
    return [(a - theta @ X.T)[:, segment >= 0] for X, a, segment in data]


def _fit_autoregression(residuals: Sequence[np.ndarray]) -> np.ndarray:
    """Return the coefficients (AR_ORDER,) of one autoregression of all rows (Yule-Walker)."""
    r = np.zeros(AR_ORDER + 1)
    for e in residuals:
        scaled, N = e / (e.std(axis=1, keepdims=True) + 1e-12), e.shape[1]
        r += [np.sum(scaled[:, lag:] * scaled[:, : N - lag]) for lag in range(AR_ORDER + 1)]
    r[0] = r[0] * (1.0 + 1e-6) + 1e-12
    return solve_toeplitz(r[:-1], r[1:])
