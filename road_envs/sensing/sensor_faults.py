"""Faults of one set of instruments: mounting, gain, offset, clock jitter, dropouts, speed error.

An accelerometer with a tilted axis, whose reading is corrected for the gravity g, measures

    gain ((a + g) cos(tilt) - g) + offset

of the vertical acceleration a at its true location. Samples are taken slightly before or after
their nominal time, which the record states. Dropouts affect all sensors at once, in bursts; lost
samples are NaN in the record. The odometer integrates the speed signal with its error. Position
fixes pull the odometer back, so that its error e changes with the distance d as

    de/dd = speed - (e - g) / position_fix_length

g is the error of the fixes along the road. It wanders as a first-order Gauss-Markov process of the
standard deviation `position_noise`; e begins at g, as of a receiver that has run before.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy
from pydantic import Field

from road_envs.core.config import ConfigError, Count, Finite, NonNegative, Positive, Settings
from road_envs.vehicle.parameters import GRAVITY

PerSensor = tuple[Finite, ...]
"""One value for each accelerometer; none if all are without this fault."""

MAX_JITTER_STDS = 3.0  # limit of the time error of a sample, in standard deviations of the jitter

PositionFixLength = Annotated[
    float, Field(gt=0), "m", "distance over which position fixes remove 63 % of an odometer error"
]
CorrelationTime = Annotated[
    Positive, "s", "time over which the error of the position fixes is correlated to 1 / e"
]
Jitter = Annotated[NonNegative, "s", "standard deviation of the sampling instants"]
DropoutRate = Annotated[float, Field(ge=0, lt=0.5), "", "share of the samples that are lost"]
DropoutLength = Annotated[Count, "samples", "mean length n of a burst; the maximum is 2 n - 1"]


@dataclass(frozen=True, kw_only=True)
class SensorFaults(Settings):
    """Faults of one set of instruments; the defaults are instruments without faults."""

    dx: Annotated[PerSensor, "m", "error of the location, positive ahead"] = ()
    dy: Annotated[PerSensor, "m", "error of the location, positive to the left"] = ()
    tilt: Annotated[PerSensor, "rad", "angle between the axis and the vertical"] = ()
    gain: Annotated[PerSensor, "", "factor of the sensitivity; else 1"] = ()
    offset: Annotated[PerSensor, "m/s²", "added to every reading"] = ()
    speed: Annotated[Finite, "", "relative error of the speed signal"] = 0.0
    position_fix_length: PositionFixLength = np.inf
    position_noise: Annotated[NonNegative, "m", "standard deviation of g; needs fixes"] = 0.0
    position_correlation_time: CorrelationTime = 30.0
    jitter: Jitter = 0.0
    dropout_rate: DropoutRate = 0.0
    dropout_length: DropoutLength = 1
    seed: Annotated[tuple[int, ...], "", "of jitter and dropouts"] = (0,)

    def per_sensor(self, name: str, k: int) -> np.ndarray:
        """Return the values (k,) of a fault of k accelerometers. Raises ConfigError."""
        values = getattr(self, name) or (float(name == "gain"),) * k
        if len(values) != k:
            raise ConfigError(f"{name} is given for {len(values)} accelerometers; there are {k}")
        return np.array(values)

    def readings(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the factor (k,) on true accelerations and the constant (k,) [m/s²] of readings."""
        gain, tilt, offset = (self.per_sensor(x, k) for x in ("gain", "tilt", "offset"))
        axis_cosine = np.cos(tilt)
        return gain * axis_cosine, gain * GRAVITY * (axis_cosine - 1.0) + offset


NO_FAULTS = SensorFaults()  # instruments without faults


def gauss_markov(
    std: float, correlation_time: float, step: float, n: int, rng: np.random.Generator
) -> np.ndarray:
    """Return n samples (n,) every `step` [s] of a stationary first-order Gauss-Markov process.

    Its covariance after a time t is std² exp(-t / correlation_time), exactly, at any step.
    """
    kept = np.exp(-step / correlation_time)
    white = std * rng.standard_normal(n)
    white[1:] *= np.sqrt(1.0 - kept**2)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -kept], white))


class JitteredSampler:
    """Sampler with clock jitter and dropouts, of a signal that arrives in chunks.

    A sample of `k` channels is taken every `decimation` steps of `step` [s]; the signal is
    interpolated linearly between steps. Jitter and dropouts are drawn sample by sample, so that
    chunks give the same samples as the whole.
    """

    def __init__(self, decimation: int, step: float, faults: SensorFaults, k: int = 3):
        self.decimation, self.jitter = decimation, faults.jitter / step
        self.margin = int(np.ceil(MAX_JITTER_STDS * self.jitter))
        rate, self.dropout_length = faults.dropout_rate, faults.dropout_length
        self.dropout_probability = rate / (self.dropout_length * (1.0 - rate))
        streams = np.random.SeedSequence(faults.seed).spawn(2)
        self.jitter_rng, self.dropout_rng = map(np.random.default_rng, streams)
        self.dropout_left = -1  # samples of the current dropout; 0 directly after one, else -1
        self.buffer = np.zeros((k, 0))
        self.buffer_start = self.n_samples = 0

    def sample(self, a: np.ndarray, last: bool = False) -> np.ndarray:
        """Add a chunk `a` (k, N), and return the samples (k, n) that it completes.

        Samples near the end need the next chunk, because of jitter, unless this is the `last` one.
        """
        self.buffer = np.concatenate([self.buffer, a], axis=1)
        end = self.buffer_start + self.buffer.shape[1]
        ready = (end if last else end - self.margin) - 1
        n = max(ready // self.decimation + 1 - self.n_samples, 0) if ready >= 0 else 0
        samples = self._draw_samples(n) if n else np.zeros((len(self.buffer), 0))
        self.n_samples += n
        obsolete = max(self.n_samples * self.decimation - self.margin - self.buffer_start, 0)
        self.buffer_start += min(obsolete, self.buffer.shape[1])
        self.buffer = self.buffer[:, obsolete:]
        return samples

    def _draw_samples(self, n: int) -> np.ndarray:
        """Return the next n samples (k, n) from the buffer."""
        limit = MAX_JITTER_STDS * self.jitter
        error = np.zeros(n)
        if self.jitter > 0.0:
            error = np.clip(self.jitter * self.jitter_rng.standard_normal(n), -limit, limit)
        nominal = self.decimation * (self.n_samples + np.arange(n))
        before = nominal + np.floor(error).astype(int) - self.buffer_start
        last = self.buffer.shape[1] - 1
        x, y = (self.buffer[:, np.clip(i, 0, last)] for i in (before, before + 1))
        samples = x + (error - np.floor(error)) * (y - x)
        samples[:, self._draw_dropouts(n)] = np.nan
        return samples

    def _draw_dropouts(self, n: int) -> np.ndarray:
        """Return whether each of the next n samples (n,) is lost.

        All lengths from 1 to 2 dropout_length - 1 are equally likely; a sample parts two dropouts.
        """
        drawn, lost = self.dropout_rng.random(n), np.zeros(n, dtype=bool)
        for i in range(n if self.dropout_probability > 0.0 else 0):
            if self.dropout_left < 0 and drawn[i] < self.dropout_probability:
                share = drawn[i] / self.dropout_probability
                self.dropout_left = 1 + int(share * (2 * self.dropout_length - 1))
            lost[i] = self.dropout_left > 0
            self.dropout_left = max(self.dropout_left - 1, -1)
        return lost
