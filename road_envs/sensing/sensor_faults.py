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

Three = tuple[float, float, float]
NONE: Three = (0.0, 0.0, 0.0)

REACH = 3.0
"""No sample is further from its instant than so many standard deviations of the jitter."""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """One set of instruments as it is; by default nothing is wrong. Three values: RF, LR, RR."""

    ahead: Annotated[Three, "m", "how far ahead of its place each accelerometer sits"] = NONE
    left: Annotated[Three, "m", "how far to the left of it"] = NONE
    tilt: Annotated[Three, "rad", "angle between its axis and the vertical"] = NONE
    gain: Annotated[Three, "", "factor of its sensitivity"] = (1.0, 1.0, 1.0)
    offset: Annotated[Three, "m/s²", "what it adds to every reading"] = NONE
    speed: Annotated[float, "", "relative error of the speed signal"] = 0.0
    fix: Annotated[float, "m", "way in which position fixes bring the odometer back by 63 %"] = (
        np.inf
    )
    jitter: Annotated[float, "s", "standard deviation of the instants of the samples"] = 0.0
    lost: Annotated[float, "", "share of the samples that are lost"] = 0.0
    burst: Annotated[int, "samples", "mean length of a loss; none is twice as long"] = 1
    seed: Annotated[tuple[int, ...], "", "of jitter and losses"] = (0,)

    def __post_init__(self):
        for name in ("jitter", "lost"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not self.lost < 0.5:
            raise ValueError(f"lost must be below half of the samples, got {self.lost}")
        if not self.fix > 0:
            raise ValueError(f"fix must be positive, got {self.fix}")
        if not self.burst >= 1:
            raise ValueError(f"burst must be at least one sample, got {self.burst}")

    def readings(self, a: np.ndarray) -> np.ndarray:
        """What accelerometers report of true accelerations (3, N) [m/s²] where they sit."""
        gain, along = np.array(self.gain), np.cos(self.tilt)
        constant = gain * GRAVITY * (along - 1.0) + np.array(self.offset)
        return (gain * along)[:, None] * a + constant[:, None]


SOUND = Faults()
"""Instruments in order."""


class Sampler:
    """Takes samples out of a stream of instants, each at its own time, or loses it.

    `every` instants, `step` [s] apart, make a sample; between instants the signal is a straight
    line. Jitter and losses draw sample by sample, so that parts of a stream give what the whole
    does.
    """

    def __init__(self, every: int, step: float, faults: Faults):
        self.every, self.jitter = every, faults.jitter / step
        self.reach = int(np.ceil(REACH * self.jitter))
        self.burst = faults.burst
        self.start = faults.lost / (faults.burst * (1.0 - faults.lost))
        streams = np.random.SeedSequence(faults.seed).spawn(2)
        self.clock, self.fate = map(np.random.default_rng, streams)
        self.left = -1  # samples that the present loss will still take; 0 right behind one
        self.kept = np.zeros((3, 0))
        self.first = self.taken = 0

    def take(self, a: np.ndarray, last: bool = False) -> np.ndarray:
        """The samples (3, n) that the stream's next part `a` (3, N) completes.

        One near the end has to wait for what follows, unless this is the `last` part.
        """
        self.kept = np.concatenate([self.kept, a], axis=1)
        end = self.first + self.kept.shape[1]
        ready = (end if last else end - self.reach) - 1
        n = max(ready // self.every + 1 - self.taken, 0) if ready >= 0 else 0
        samples = self._taken(n) if n else np.zeros((3, 0))
        self.taken += n
        spare = max(self.taken * self.every - self.reach - self.first, 0)
        self.kept, self.first = self.kept[:, spare:], self.first + min(spare, self.kept.shape[1])
        return samples

    def _taken(self, n: int) -> np.ndarray:
        limit = REACH * self.jitter
        error = np.zeros(n)
        if self.jitter > 0.0:
            error = np.clip(self.jitter * self.clock.standard_normal(n), -limit, limit)
        before = self.every * (self.taken + np.arange(n)) + np.floor(error).astype(int) - self.first
        last = self.kept.shape[1] - 1
        x, y = (self.kept[:, np.clip(i, 0, last)] for i in (before, before + 1))
        samples = x + (error - np.floor(error)) * (y - x)
        samples[:, self._losses(n)] = np.nan
        return samples

    def _losses(self, n: int) -> np.ndarray:
        """Whether each of the next n samples (n,) is lost.

        All lengths from 1 to 2 burst - 1 are equally likely, and no loss follows upon another.
        """
        drawn, lost = self.fate.random(n), np.zeros(n, dtype=bool)
        for i in range(n if self.start > 0.0 else 0):
            if self.left < 0 and drawn[i] < self.start:
                self.left = 1 + int(drawn[i] / self.start * (2 * self.burst - 1))
            lost[i] = self.left > 0
            self.left = max(self.left - 1, -1)
        return lost
