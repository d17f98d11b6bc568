"""Speed profiles: speed over time, its integral and its derivative.

s(t) = integral of v,   v(t) piecewise linear,   a_x(t) = dv/dt piecewise constant
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from road_envs.core.config import Finite, NonNegative, Settings

MAX_SPEED_KMH = 200.0  # largest speed [km/h] at which a drive is simulated


@dataclass(frozen=True, kw_only=True)
class SpeedProfile(Settings):
    """Speed [m/s] at times [s] from 0 on, linear between them and constant after the last.

    Raises ValueError unless the times start at 0 and increase, no speed is negative and the last
    one is positive, without which a drive would never reach the end of its road.
    """

    t: Annotated[tuple[Finite, ...], "s", "times, the first 0"]
    v: Annotated[tuple[NonNegative, ...], "m/s", "speed at each time"]

    def __post_init__(self):
        super().__post_init__()
        if len(self.t) != len(self.v):
            raise ValueError(f"t and v must be of one length, got {self.t} and {self.v}")
        if not self.t or self.t[0] != 0.0 or not (np.diff(self.t) > 0).all():
            raise ValueError(f"the times t must start at 0 and increase, got {self.t}")
        if self.v[-1] == 0.0:
            raise ValueError(f"the speeds v must be positive at the end, got {self.v}")

    @property
    def is_constant(self) -> bool:
        """Whether it is one speed at all times."""
        return len(self.v) == 1

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return distance [m], speed [m/s] and acceleration [m/s²] (N,) at times `t` (N,) [s]."""
        if self.is_constant:
            return t * self.v[0], np.full(np.shape(t), self.v[0]), np.zeros(np.shape(t))
        knots, v = np.array(self.t), np.array(self.v)
        a = np.append(np.diff(v) / np.diff(knots), 0.0)
        s = np.append(0.0, np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(knots)))
        i = np.searchsorted(knots, t, side="right") - 1
        dt = t - knots[i]
        return s[i] + dt * (v[i] + 0.5 * a[i] * dt), v[i] + a[i] * dt, a[i]

    def arrival_time(self, distance: float) -> float:
        """Return the time [s] at which `distance` [m] has been covered."""
        knots = np.array(self.t)
        distances = self.at(knots)[0]
        i = int(np.searchsorted(distances, distance, side="right")) - 1
        _, (v,), (a,) = self.at(knots[i : i + 1])
        remaining = distance - distances[i]
        # this form of the root of v dt + a dt² / 2 = remaining has no cancellation for small a
        return float(
            knots[i] + 2.0 * remaining / (v + np.sqrt(max(v * v + 2.0 * a * remaining, 0.0)))
        )
