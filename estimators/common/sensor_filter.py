"""Samples that the data logger writes: the anti-alias filter, sampled at the times of the samples.

The model gives the acceleration a(t) at each of its steps. The logger low-passes it and samples it
at times that need not be even,

    y_k = (h * a)(t_k),      h: causal Butterworth filter of ANTIALIAS_ORDER

A filter whose corner is far above the block means only delays them (`model_inputs`). One of 40 Hz,
as of a phone, also weakens them and keeps waves out that would be aliased.

The tangent of a drive is in means of the acceleration over groups of steps (`block_tangent`), since
one matrix for each step would be slow. `SampledFilter.apply` predicts the samples from these means:
in the frequency domain it divides by the response of the mean and multiplies by that of the filter,
and interpolates at t_k. That is exact for signals below half the rate of the means.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import sosfilt, sosfreqz
from scipy.sparse import csr_array

from road_envs.kernels.filters import butterworth_sos
from road_envs.sensing.instruments import ANTIALIAS_ORDER, Instruments

# Frequency [Hz] above which roads hardly excite the body, and share of the power that the filter
# may take there for a delay to stand for it: a filter of 333 Hz takes 7e-5
_F_EXCITED, _DELAY_LOSS = 100.0, 1e-3
# Rate of the groups of steps, over the highest frequency that samples or block means contain: the
# tangent of a phone then errs by 1 %, with a ratio of 4 by 3 %
_GROUP_RATE_RATIO = 6.0
_MEMORY_PERIODS = 8.0  # of the corner, after which the filter has forgotten its input: to 1e-6
_POINTS = 8  # of the Lagrange interpolation among means of groups, or among steps of the model


@dataclass(frozen=True, eq=False)
class SensorFilter:
    """Anti-alias filter of all sensors: second-order sections `sos` (n, 6) at the model's `step`
    [s], with the corner `f_alias` [Hz]; the tangent has one mean for each `group` of steps.
    """

    sos: np.ndarray
    step: float
    f_alias: float
    group: int

    @classmethod
    def of(cls, instruments: Instruments, step: float, block_rate: float) -> "SensorFilter":
        """Return the filter for a model of a `step` [s] and for `block_rate` [Hz] block means."""
        highest = min(instruments.f_alias, 0.5 * block_rate, _F_EXCITED)
        group = max(1, int(1.0 / (step * _GROUP_RATE_RATIO * highest)))
        corner = min(instruments.f_alias, 0.45 / step)
        sos = butterworth_sos(ANTIALIAS_ORDER, corner, 1.0 / step)
        return cls(sos, step, corner, group)

    @property
    def memory(self) -> float:
        """Time [s] after which the filter has forgotten its input."""
        return _MEMORY_PERIODS / self.f_alias

    def at_rest(self, n_sensors: int) -> np.ndarray:
        """Return the state (n, S, 2) of the filter after zeros."""
        return np.zeros((len(self.sos), n_sensors, 2))

    def response(self, f: np.ndarray) -> np.ndarray:
        """Return the complex response (F,) [-] at `f` (F,) [Hz], below half the steps' rate."""
        f = np.minimum(f, 0.5 / self.step)
        return np.asarray(sosfreqz(self.sos, f, fs=1.0 / self.step)[1])

    def filter(self, sensed: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return filtered accelerations (S, N) from unfiltered ones, and the state after them."""
        filtered, after = sosfilt(self.sos, sensed, axis=1, zi=state)
        return filtered, after


@dataclass(frozen=True, eq=False)
class SampledFilter:
    """A `filter` sampled at the steps `at` (T,), which need not be whole, of `n_steps`."""

    filter: SensorFilter
    at: np.ndarray
    n_steps: int

    def read(self, sensed: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Return the samples (S, T) from accelerations (S, N) at each step, behind `state`."""
        filtered, _ = self.filter.filter(sensed, state)
        return (self._among_steps @ filtered.T).T

    def apply(self, means: np.ndarray) -> np.ndarray:
        """Return the samples (S, T) from means (S, G) over the groups, which follow zeros."""
        size = self._spectrum_size
        filtered = irfft(self._transfer * rfft(means, size), size)[:, : self.n_groups]
        return (self._among_means @ filtered.T).T

    def apply_transpose(self, samples: np.ndarray) -> np.ndarray:
        """Apply the transpose of `apply`: from samples (S, T) to means (S, G)."""
        size = self._spectrum_size
        filtered = (self._among_means.T @ samples.T).T
        return irfft(self._transfer.conj() * rfft(filtered, size), size)[:, : self.n_groups]

    @property
    def n_groups(self) -> int:
        """Groups G of steps."""
        return self.n_steps // self.filter.group

    @property
    def _spectrum_size(self) -> int:
        memory = int(np.ceil(self.filter.memory / (self.filter.step * self.filter.group)))
        return int(next_fast_len(self.n_groups + memory, real=True))

    @cached_property
    def _transfer(self) -> np.ndarray:
        """Response of the filter over that of a mean, whose time is that of its first step."""
        group, step = self.filter.group, self.filter.step
        f = rfftfreq(self._spectrum_size, step * group)
        mean = np.exp(2j * np.pi * f[:, None] * step * np.arange(group)).mean(axis=1)
        return self.filter.response(f) / mean

    @cached_property
    def _among_steps(self) -> csr_array:
        return _lagrange_weights(self.at, self.n_steps, _POINTS)

    @cached_property
    def _among_means(self) -> csr_array:
        return _lagrange_weights(self.at / self.filter.group, self.n_groups, _POINTS)


def _lagrange_weights(at: np.ndarray, size: int, points: int) -> csr_array:
    """Return the weights (T, `size`) of even samples in the value at `at` (T,), in units of their
    spacing, of the polynomial through the nearest `points`.
    """
    points = min(points, size)
    first = np.clip(np.floor(at).astype(int) - points // 2 + 1, 0, size - points)
    node = np.arange(points)
    x = np.clip(at - first, -1.0, points)[:, None]  # a sample just beyond the ends is extrapolated
    weights = np.ones((at.size, points))
    for k in range(points):
        others = node != k
        weights[:, k] = np.prod((x - node[others]) / (k - node[others]), axis=1)
    columns = first[:, None] + node
    rows = points * np.arange(at.size + 1)
    return csr_array((weights.ravel(), columns.ravel(), rows), shape=(at.size, size))


def is_only_a_delay(instruments: Instruments) -> bool:
    """Return whether the filter does no more than delay what a road excites in the body."""
    return bool(abs(instruments.response(np.array(_F_EXCITED))) ** 2 > 1.0 - _DELAY_LOSS)
