"""Driving manoeuvres: horizontal accelerations of the centre of mass over time.

Lateral a_y is positive to the left, longitudinal a_x positive ahead [m/s²]. All manoeuvres are
continuous, because a step in a_y would need a step in the steering angle.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Protocol

import numpy as np
from pydantic import Field

from road_envs.core import config
from road_envs.core.config import Finite, NonNegative, Positive, Settings


class Manoeuvre(Protocol):
    """Horizontal accelerations of the centre of mass as functions of time."""

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return a_x and a_y (N, 2) [m/s²] at the times `t` (N,) [s]."""
        ...


def _smooth_step(x: np.ndarray) -> np.ndarray:
    """Return 0 for x < 0, 1 for x > 1 and a raised cosine in between."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(x, 0.0, 1.0))


def _lateral(a_y: np.ndarray) -> np.ndarray:
    return np.stack([np.zeros_like(a_y), a_y], axis=-1)


@dataclass(frozen=True, kw_only=True)
class SteadyTurn(Settings):
    """Turn to the left (a_y > 0): build-up, constant lateral acceleration, release."""

    a_y: Annotated[Finite, "m/s²", "lateral acceleration of the constant phase"] = 3.924
    begin: Annotated[Finite, "s", "time at which the turn begins"] = 1.0
    build_up: Annotated[Positive, "s", "duration of the build-up, and of the release"] = 1.0
    hold: Annotated[float, Field(ge=0), "s", "duration of the constant phase"] = np.inf

    def at(self, t: np.ndarray) -> np.ndarray:
        rise = _smooth_step((t - self.begin) / self.build_up)
        fall = _smooth_step((t - self.begin - self.build_up - self.hold) / self.build_up)
        return _lateral(self.a_y * (rise - fall))


@dataclass(frozen=True, kw_only=True)
class LaneChange(Settings):
    """Double lane change over the track of ISO 3888-1, as a lateral acceleration history.

    The track leads 3.5 m sideways within 30 m, 25 m straight, and 3.5 m back within 25 m. A full
    sine of amplitude A and duration T displaces by A T² / (2 pi), so each lane change is one sine
    over the length of its section at speed `v`.
    """

    v: Annotated[Positive, "m/s", "speed through the track"] = 15.0
    begin: Annotated[Finite, "s", "time at which the first section is entered"] = 1.0
    offset: Annotated[Finite, "m", "lateral offset of the lane"] = 3.5
    sections: Annotated[
        tuple[Positive, Positive, Positive],
        "m",
        "lengths: out, straight, back (ISO 3888-1:2018, table 1)",
    ] = (30.0, 25.0, 25.0)

    def at(self, t: np.ndarray) -> np.ndarray:
        out, straight, back = (length / self.v for length in self.sections)
        a_y = self._sine(t - self.begin, out) - self._sine(t - self.begin - out - straight, back)
        return _lateral(a_y)

    def _sine(self, t: np.ndarray, T: float) -> np.ndarray:
        amplitude = 2.0 * np.pi * self.offset / T**2
        return np.where((t >= 0) & (t <= T), amplitude * np.sin(2.0 * np.pi * t / T), 0.0)


@dataclass(frozen=True, kw_only=True)
class Fishhook(Settings):
    """Turn that is reversed at once: build-up, dwell, reversal, hold, release.

    It has the shape of NHTSA's fixed-timing fishhook (49 CFR 575.106), as the lateral acceleration
    that follows the steering; the J-turn of the same programme is a SteadyTurn with a short
    `build_up`.
    """

    a_y: Annotated[Finite, "m/s²", "lateral acceleration of the first turn, less the second"] = 4.5
    begin: Annotated[Finite, "s", "time at which the first turn begins"] = 1.0
    build_up: Annotated[Positive, "s", "duration of a build-up; the reversal takes two"] = 0.5
    dwell: Annotated[NonNegative, "s", "duration of the first turn"] = 0.25
    hold: Annotated[NonNegative, "s", "duration of the second turn"] = 3.0

    def at(self, t: np.ndarray) -> np.ndarray:
        reversal = self.begin + self.build_up + self.dwell
        rise = _smooth_step((t - self.begin) / self.build_up)
        fall = _smooth_step((t - reversal) / (2.0 * self.build_up))
        release = _smooth_step((t - reversal - 2.0 * self.build_up - self.hold) / self.build_up)
        return _lateral(self.a_y * (rise - 2.0 * fall + release))


@dataclass(frozen=True, kw_only=True)
class Slalom(Settings):
    """Sinusoidal lateral acceleration, with a smooth start over the first period."""

    a_y: Annotated[Finite, "m/s²", "amplitude"] = 3.0
    period: Annotated[Positive, "s", "period of the sine"] = 3.0
    begin: Annotated[Finite, "s", "time at which it begins"] = 1.0
    periods: Annotated[float, Field(gt=0), "", "number of periods"] = np.inf

    def at(self, t: np.ndarray) -> np.ndarray:
        x = (t - self.begin) / self.period
        envelope = _smooth_step(x) - _smooth_step(x - self.periods)
        return _lateral(self.a_y * envelope * np.sin(2.0 * np.pi * x))


@dataclass(frozen=True, kw_only=True)
class Braking(Settings):
    """Braking as it acts on the body only; a SpeedProfile changes the speed and has its own a_x."""

    a_x: Annotated[Finite, "m/s²", "deceleration, as a positive number"] = 4.0
    begin: Annotated[Finite, "s", "time at which the brake is applied"] = 1.0
    build_up: Annotated[Positive, "s", "duration of the build-up, and of the release"] = 0.3
    hold: Annotated[float, Field(ge=0), "s", "duration of the constant phase"] = 2.0

    def at(self, t: np.ndarray) -> np.ndarray:
        turn = SteadyTurn(a_y=self.a_x, begin=self.begin, build_up=self.build_up, hold=self.hold)
        return np.stack([-turn.at(t)[..., 1], np.zeros_like(t)], axis=-1)


@dataclass(frozen=True)
class Successive:
    """Manoeuvres one after the other in one drive: the sum of their accelerations."""

    parts: tuple[Manoeuvre, ...]

    def at(self, t: np.ndarray) -> np.ndarray:
        return np.sum([part.at(t) for part in self.parts], axis=0)


KINDS: dict[str, type] = {
    "steady_turn": SteadyTurn,
    "lane_change": LaneChange,
    "fishhook": Fishhook,
    "slalom": Slalom,
    "braking": Braking,
}


def load_manoeuvre(source: str | dict[str, Any]) -> Manoeuvre:
    """Return a manoeuvre by kind, or from a mapping of `kind` and settings. Raises ConfigError."""
    settings = {"kind": source} if isinstance(source, str) else dict(source)
    if "kind" not in settings:
        raise config.ConfigError(
            f"a manoeuvre needs a key 'kind', one of {', '.join(KINDS)}; got {settings}"
        )
    kind = config.validate_choice("manoeuvre", settings.pop("kind"), KINDS)
    return config.build(KINDS[kind], settings, kind)
