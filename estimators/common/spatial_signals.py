"""Signals of a drive over distance, the inputs of estimators trained for all speeds and modes.

Three accelerometers on a rigid body give three motions. Those of the centre line above the front
and the rear sensors depend on the mean m of the wheel paths alone, the roll on their half
difference q, whatever the height and length of the body (RF and RR are on one side):

    roll = (LR - RR) / 2      front = RF + roll      rear = (LR + RR) / 2
    z_left = m + q            z_right = m - q

Mirroring the road therefore changes the sign of roll and q. Stations are SPACING apart, fine enough
for 1.8 cycles/m, the end of the scored band. Signals are low-passed over distance before decimation
and heights after upsampling to the profile grid, by the same short filter, which reaches
FILTER_REACH to either side: a causal input stays causal up to 2 FILTER_REACH. Velocities of the
three motions are integrals over time, high-passed at 0.3 Hz.

A body that twists or bends is not rigid, and then the three motions are not what they are called.
How front and roll compare with rear, frequency by frequency, separates such a vehicle from a rigid
one on any road: `spectrum` has the logarithms of these ratios.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import signal

from estimators.preprocessing import sample_profile
from road_envs.kernels.filters import preprocess_accelerations
from road_envs.records.record import (
    F_C,
    PROFILE_SPACING,
    SCORED_F_MAX,
    Profile,
    Record,
    profile_stations,
)

DECIMATION = 6
SPACING = DECIMATION * PROFILE_SPACING  # distance between stations [m]
EDGE_STATIONS = 4  # stations beyond either end of the road, for the filter back to the grid
FILTER_REACH = EDGE_STATIONS * SPACING  # reach of the low-pass [m] to either side
_N_CUT = 3.0  # cut-off of the low-pass [cycles/m]: 50 dB down from 4.5 on, flat to 0.4 % up to 1.8
_LOWPASS = signal.firwin(
    2 * EDGE_STATIONS * DECIMATION + 1, _N_CUT, window=("kaiser", 5.0), fs=1.0 / PROFILE_SPACING
)

_F_VELOCITY = 0.3  # high-pass of the velocities [Hz]: below, integrated drift is as large as motion
# Limits of the frequency bands [Hz] in which the powers of the motions are compared
BANDS = np.geomspace(5.0, SCORED_F_MAX, 6)
# Energy [m²/s³] that is added to that of every motion in every band: of noise of 0.05 m/s² over
# 20 s. Ratios are 1 where nothing has been measured.
_NOISE_ENERGY = 0.05
LEVEL_MIN = 3e-4  # added to the level of heights [m], so that noise on level roads is not amplified
N_HIGH_PASS = 0.05  # high-pass of the target heights [cycles/m]: accelerations fall with n² v²
_N_SHORT = 0.15  # spatial frequency [cycles/m] above which waves are short
N_MOTIONS = 3  # front, rear and roll
N_RATIOS = 2 * (BANDS.size - 1)  # front over rear, then roll over rear, in each of the bands


class SpatialSignals(NamedTuple):
    """Signals at K even stations, `margin` of them before the first that is estimated and after
    the last. `motions` (6, K): accelerations [m/s²] and velocities [m/s] of front, rear and roll;
    `v` (K,): speed [m/s]; `states` (K, 4): shares of stiff springs and of high damping in front,
    then at the rear. All are those of the moment when the front axle passed the station; motions
    are zero where the record does not reach. `spectrum` (N_RATIOS, K): logarithms of power ratios
    until that moment, or those of the whole drive throughout.
    """

    motions: np.ndarray
    v: np.ndarray
    states: np.ndarray
    margin: int
    spectrum: np.ndarray

    @classmethod
    def of(cls, record: Record, margin: int, causal: bool = False) -> "SpatialSignals":
        """Return the signals of a record at its stations and at `margin` more at either end.

        With `causal` no station uses a sample from more than FILTER_REACH after it.
        """
        K = _n_stations(record.length) + 2 * margin
        first = -(EDGE_STATIONS + margin) * DECIMATION
        edge = EDGE_STATIONS * DECIMATION
        fine = PROFILE_SPACING * np.arange(first - edge, first + (K - 1) * DECIMATION + edge + 1)
        sensed = body_motions(record, causal)
        motions = record.interpolate(fine, sensed)
        motions[:, (fine < record.s[0]) | (fine > record.s[-1])] = 0.0
        s = fine[edge:-edge:DECIMATION]
        states = record.interpolate(s, axle_states(record))
        v, ratios = np.interp(s, record.s, record.v), _power_ratios(sensed[:N_MOTIONS], record.fs)
        spectrum = record.interpolate(s, ratios) if causal else np.tile(ratios[:, -1:], K)
        return cls(_decimate(motions), v, states.T, margin, spectrum)

    @property
    def size(self) -> int:
        """Number of estimated stations."""
        return self.v.size - 2 * self.margin

    @property
    def inside(self) -> slice:
        """The estimated stations among all."""
        return slice(self.margin, self.v.size - self.margin)

    @property
    def state(self) -> np.ndarray:
        """State (4,) that prevails at the estimated stations, 0 or 1, in the order of `states`."""
        return self.states[self.inside].mean(axis=0).round()

    @property
    def speed(self) -> float:
        """Mean speed [m/s] at the estimated stations."""
        return float(self.v[self.inside].mean())


def axle_states(record: Record) -> np.ndarray:
    """Return the shares (4, N) of stiff springs and of high damping in front, then at the rear."""
    stiff, high = record.spring_stiff, record.damper_high
    axles = (stiff[:, :2], high[:, :2], stiff[:, 2:], high[:, 2:])
    return np.array([pair.mean(axis=1) for pair in axles])


def _n_stations(length: float) -> int:
    """Return the number of estimated stations on a road of `length` [m]."""
    return -(-profile_stations(length).size // DECIMATION) + 2 * EDGE_STATIONS


def _power_ratios(a: np.ndarray, fs: float) -> np.ndarray:
    """Return logarithms (N_RATIOS, N) of the ratios of the powers of front and of roll to that of
    rear in each of BANDS, from the first to each sample of the accelerations `a` (3, N) [m/s²].
    """
    energy = np.empty((BANDS.size - 1, *a.shape))
    for band, limits in zip(energy, pairwise(BANDS), strict=True):
        sos = signal.butter(2, limits, "bandpass", fs=fs, output="sos")
        band[:] = np.cumsum(signal.sosfilt(sos, a) ** 2, axis=1) / fs
    front, rear, roll = np.log(energy + _NOISE_ENERGY).transpose(1, 0, 2)
    return np.concatenate([front - rear, roll - rear])


def body_motions(record: Record, causal: bool) -> np.ndarray:
    """Return accelerations and velocities (6, N) of front, rear and roll over time."""
    rf, lr, rr = preprocess_accelerations(record.a, record.fs, F_C, causal)
    roll = 0.5 * (lr - rr)
    a = np.array([rf + roll, 0.5 * (lr + rr), roll])
    velocity = np.cumsum(a, axis=1) / record.fs
    return np.concatenate([a, high_pass(velocity, _F_VELOCITY, record.fs, 2000, causal)])


def high_pass(
    x: np.ndarray, corner: float, rate: float, padding: int, causal: bool = False
) -> np.ndarray:
    """Return rows (k, N) sampled at a `rate`, high-passed at a `corner` in the same units.

    The filter is a second-order Butterworth, forward only if `causal`; else forward and backward
    with `padding` samples at most beyond either end.
    """
    sos = signal.butter(2, corner, "high", fs=rate, output="sos")
    if causal:
        return signal.sosfilt(sos, x)
    return signal.sosfiltfilt(sos, x, padlen=min(padding, x.shape[-1] - 1))


def without_long_waves(z: np.ndarray) -> np.ndarray:
    """Return heights (2, M) [m] at profile stations without waves longer than 20 m."""
    wave = int(1.0 / (N_HIGH_PASS * PROFILE_SPACING))
    return high_pass(z, N_HIGH_PASS, 1.0 / PROFILE_SPACING, wave)


def keep_short_waves(x: np.ndarray, causal: bool = False) -> np.ndarray:
    """Return rows at the stations, high-passed at _N_SHORT; without phase unless `causal`."""
    return high_pass(x, _N_SHORT, 1.0 / SPACING, 100, causal)


def motion_windows(
    signals: SpatialSignals, behind: int, ahead: int, causal: bool = False
) -> np.ndarray:
    """Return short waves (3, M, behind + 1 + ahead) [m/s²] of the motions about each station."""
    motions = keep_short_waves(signals.motions[:N_MOTIONS].astype(float), causal)
    inside = motions[:, signals.margin - behind : signals.margin + signals.size + ahead]
    return np.lib.stride_tricks.sliding_window_view(inside, behind + 1 + ahead, axis=1)


def _decimate(x: np.ndarray) -> np.ndarray:
    """Return K low-passed stations of `x` (k, (K - 1 + 2 EDGE_STATIONS) DECIMATION + 1)."""
    edges = 2 * EDGE_STATIONS
    last = (x.shape[1] - 1) // DECIMATION + 1
    return signal.upfirdn(_LOWPASS, x, 1, DECIMATION, axis=1)[:, edges:last]


def upsample(x: np.ndarray, size: int) -> np.ndarray:
    """Return heights (k, size) on the grid from those at the stations (k, M)."""
    fine = signal.upfirdn(DECIMATION * _LOWPASS, x, DECIMATION, 1, axis=1)
    edges = 2 * EDGE_STATIONS * DECIMATION
    return fine[:, edges : edges + size]


def target_profile(truth: Profile, length: float) -> np.ndarray:
    """Return mean and half difference (2, M) [m] of the true wheel paths at the estimated stations.

    Low-passed as the signals are and without waves longer than 20 m; continued beyond the ends of
    the road by odd reflection.
    """
    left, right = sample_profile(truth, profile_stations(length))
    z = without_long_waves(np.array([0.5 * (left + right), 0.5 * (left - right)]))
    after = (_n_stations(length) - 1) * DECIMATION + 1 - z.shape[1]
    ends = (2 * EDGE_STATIONS * DECIMATION, after)
    return _decimate(np.pad(z, ((0, 0), ends), mode="reflect", reflect_type="odd"))


def wheel_paths(x: np.ndarray) -> np.ndarray:
    """Return left and right (2, M) from mean and half difference (2, M)."""
    return np.array([x[0] + x[1], x[0] - x[1]])
