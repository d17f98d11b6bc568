"""What is wrong with one set of instruments: mounting, gain, offset, a clock that jitters, losses.

An accelerometer whose axis stands off the vertical by an angle reads, less the gravity g that its
maker took away,

    gain ((a + g) cos(tilt) - g) + offset

of the vertical acceleration a at the place where it really sits. Its samples are taken a little
before or after their instant, while the record tells the nominal one, and some are lost, all
sensors' at once, in bursts: they are NaN in the record. The odometer adds up the speed signal with
its error; where the position is fixed from outside now and then, the odometer's error e goes with
the way d as de/dd = speed - e / fix.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from road_envs.vehicle.parameters import GRAVITY

PerSensor = tuple[float, float, float]
ZEROS: PerSensor = (0.0, 0.0, 0.0)

MAX_JITTER_STDS = 3.0
"""No sample is further from its instant than so many standard deviations of the jitter."""


@dataclass(frozen=True, kw_only=True)
class SensorFaults:
    """One set of instruments as it is; by default nothing is wrong. Three values: RF, LR, RR."""

    dx: Annotated[PerSensor, "m", "how far ahead of its place each accelerometer sits"] = ZEROS
    dy: Annotated[PerSensor, "m", "how far to the left of it"] = ZEROS
    tilt: Annotated[PerSensor, "rad", "angle between its axis and the vertical"] = ZEROS
    gain: Annotated[PerSensor, "", "factor of its sensitivity"] = (1.0, 1.0, 1.0)
    offset: Annotated[PerSensor, "m/s²", "what it adds to every reading"] = ZEROS
    speed: Annotated[float, "", "relative error of the speed signal"] = 0.0
    position_fix_length: Annotated[
        float, "m", "way in which position fixes bring the odometer back by 63 %"
    ] = np.inf
    jitter: Annotated[float, "s", "standard deviation of the instants of the samples"] = 0.0
    dropout_rate: Annotated[float, "", "share of the samples that are lost"] = 0.0
    dropout_length: Annotated[int, "samples", "mean length of a loss; none is twice as long"] = 1
    seed: Annotated[tuple[int, ...], "", "of jitter and losses"] = (0,)

    def __post_init__(self):
        for name in ("jitter", "dropout_rate"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not self.dropout_rate < 0.5:
            raise ValueError(
                f"dropout_rate must be below half of the samples, got {self.dropout_rate}"
            )
        if not self.position_fix_length > 0:
            raise ValueError(
                f"position_fix_length must be positive, got {self.position_fix_length}"
            )
        if not self.dropout_length >= 1:
            raise ValueError(
                f"dropout_length must be at least one sample, got {self.dropout_length}"
            )

    def apply(self, a: np.ndarray) -> np.ndarray:
        """What accelerometers report of true accelerations (3, N) [m/s²] where they sit."""
        gain, axis_cosine = np.array(self.gain), np.cos(self.tilt)
        constant = gain * GRAVITY * (axis_cosine - 1.0) + np.array(self.offset)
        return (gain * axis_cosine)[:, None] * a + constant[:, None]


NO_FAULTS = SensorFaults()
"""Instruments in order."""


class JitteredSampler:
    """Takes samples out of a stream of instants, each at its own time, or loses it.

    `decimation` instants, `step` [s] apart, make a sample; between instants the signal is a
    straight line. Jitter and losses draw sample by sample, so that parts of a stream give what the
    whole does.
    """

    def __init__(self, decimation: int, step: float, faults: SensorFaults):
        self.decimation, self.jitter = decimation, faults.jitter / step
        self.margin = int(np.ceil(MAX_JITTER_STDS * self.jitter))
        self.dropout_length = faults.dropout_length
        rate, length = faults.dropout_rate, faults.dropout_length
        self.dropout_probability = rate / (length * (1.0 - rate))
        streams = np.random.SeedSequence(faults.seed).spawn(2)
        self.jitter_rng, self.dropout_rng = map(np.random.default_rng, streams)
        self.dropout_left = -1  # samples that the present loss will still take; 0 right behind one
        self.buffer = np.zeros((3, 0))
        self.buffer_start = self.n_samples = 0

    def sample(self, a: np.ndarray, last: bool = False) -> np.ndarray:
        """The samples (3, n) that the stream's next part `a` (3, N) completes.

        One near the end has to wait for what follows, unless this is the `last` part.
        """
        self.buffer = np.concatenate([self.buffer, a], axis=1)
        end = self.buffer_start + self.buffer.shape[1]
        ready = (end if last else end - self.margin) - 1
        n = max(ready // self.decimation + 1 - self.n_samples, 0) if ready >= 0 else 0
        samples = self._draw_samples(n) if n else np.zeros((3, 0))
        self.n_samples += n
        spare = max(self.n_samples * self.decimation - self.margin - self.buffer_start, 0)
        self.buffer, self.buffer_start = (
            self.buffer[:, spare:],
            self.buffer_start + min(spare, self.buffer.shape[1]),
        )
        return samples

    def _draw_samples(self, n: int) -> np.ndarray:
        limit = MAX_JITTER_STDS * self.jitter
        error = np.zeros(n)
        if self.jitter > 0.0:
            error = np.clip(self.jitter * self.jitter_rng.standard_normal(n), -limit, limit)
        before = (
            self.decimation * (self.n_samples + np.arange(n))
            + np.floor(error).astype(int)
            - self.buffer_start
        )
        last = self.buffer.shape[1] - 1
        x, y = (self.buffer[:, np.clip(i, 0, last)] for i in (before, before + 1))
        samples = x + (error - np.floor(error)) * (y - x)
        samples[:, self._draw_dropouts(n)] = np.nan
        return samples

    def _draw_dropouts(self, n: int) -> np.ndarray:
        """Whether each of the next n samples (n,) is lost.

        All lengths from 1 to 2 burst - 1 are equally likely, and no loss follows upon another.
        """
        drawn, lost = self.dropout_rng.random(n), np.zeros(n, dtype=bool)
        for i in range(n if self.dropout_probability > 0.0 else 0):
            if self.dropout_left < 0 and drawn[i] < self.dropout_probability:
                self.dropout_left = 1 + int(
                    drawn[i] / self.dropout_probability * (2 * self.dropout_length - 1)
                )
            lost[i] = self.dropout_left > 0
            self.dropout_left = max(self.dropout_left - 1, -1)
        return lost
