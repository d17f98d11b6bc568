"""What the instruments report of a drive, and the paper's processing of it (section 6).

body acceleration at the sensor -> noise -> clipping at the range -> anti-alias -> samples
samples -> constant trend removed -> 25 Hz low-pass                         (`process`)
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from road_envs import config
from road_envs.processing import butterworth, run_sections
from road_envs.record import SENSORS
from road_envs.simulate import Trajectory
from road_envs.vehicle import VehicleParameters

ALIAS_ORDER = 4


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where on the body an accelerometer sits."""

    __pydantic_config__ = config.STRICT

    axle: Annotated[Literal["front", "rear"], "", "axle from which `ahead` is measured"]
    ahead: Annotated[float, "m", "ahead of that axle; negative behind it"]
    y: Annotated[float, "m", "left of the centre line"]

    def __post_init__(self):
        if not np.isfinite([self.ahead, self.y]).all():
            raise ValueError(f"a place must be finite, got ahead {self.ahead}, y {self.y}")

    def x(self, car: VehicleParameters) -> float:
        """Ahead of the body's centre of mass [m]."""
        return (car.front if self.axle == "front" else car.rear).x + self.ahead


@dataclass(frozen=True, kw_only=True)
class Places:
    """The paper's three accelerometers."""

    __pydantic_config__ = config.STRICT

    RF: Place
    LR: Place
    RR: Place


@dataclass(frozen=True, kw_only=True)
class Instruments:
    """Accelerometers, their logger and the speed signal of one car."""

    __pydantic_config__ = config.STRICT

    name: str
    accelerometers: Places
    fs: Annotated[float, "Hz", "sampling rate"]
    f_alias: Annotated[float, "Hz", "cut-off of the anti-alias filter"]
    range: Annotated[float, "m/s²", "clipping level, either way"]
    noise_density: Annotated[float, "(m/s²)/sqrt(Hz)", "one-sided; std = density sqrt(rate / 2)"]
    speed_error: Annotated[float, "", "standard deviation of the relative error of speed"]
    sources: dict[str, str]

    def __post_init__(self):
        for name in ("fs", "f_alias", "range"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("noise_density", "speed_error"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.f_alias >= 0.5 * self.fs:
            raise ValueError(f"f_alias {self.f_alias} must be below fs / 2 = {0.5 * self.fs}")


def load_instruments(name: str | Path) -> Instruments:
    """Instruments by shipped name or YAML path. Raises ConfigError."""
    return config.load(Instruments, "sensors", name)


class Logger:
    """The instruments at work on one drive: holds the filter's memory and the noise's generator.

    `step` [s] is the integrator's; a sample is taken every 1 / (fs step) steps. Raises ConfigError
    if that is not a whole number.
    """

    def __init__(
        self,
        instruments: Instruments,
        car: VehicleParameters,
        step: float,
        rng: np.random.Generator,
    ):
        every = 1.0 / (instruments.fs * step)
        if every < 0.999 or abs(every - round(every)) > 1e-6:
            raise config.ConfigError(
                f"sampling at {instruments.fs} Hz needs a whole number of integrator steps between "
                f"samples; a step of {step} s makes {every:.3f}"
            )
        self.every = round(every)
        self.range = instruments.range
        self.noise_std = instruments.noise_density * np.sqrt(0.5 / step)
        places = [getattr(instruments.accelerometers, name) for name in SENSORS]
        self.places = [(p.x(car), p.y) for p in places]
        self.sos = butterworth(ALIAS_ORDER, instruments.f_alias, 1.0 / step)
        self.memory = np.zeros((self.sos.shape[0], 3, 2))
        self.taken = 0
        self.rng = rng
        self.speed_gain = 1.0 + instruments.speed_error * rng.standard_normal()

    def sense(self, trajectory: Trajectory) -> np.ndarray:
        """Samples (3, n) [m/s²] of RF, LR, RR that fall into `trajectory`, in order."""
        a = np.array([trajectory.body_acceleration(x, y) for x, y in self.places])
        if self.noise_std > 0.0:  # drawn instant by instant, so that chunks draw what a whole does
            a += self.noise_std * self.rng.standard_normal(a.shape[::-1]).T
        a = np.clip(a, -self.range, self.range)
        run_sections(self.sos, self.memory, a, a)
        samples = a[:, -self.taken % self.every :: self.every]
        self.taken += a.shape[1]
        return samples
