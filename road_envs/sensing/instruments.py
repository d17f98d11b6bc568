"""Data sheet of the instruments: locations, sampling, range and noise.

Estimators may use it; `data_logger.py` simulates the instruments.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from road_envs import config
from road_envs.config import Finite, NonNegative, Positive, Settings
from road_envs.data.record import SENSORS
from road_envs.vehicle.parameters import VehicleParameters

ANTIALIAS_ORDER = 4
"""Order of the Butterworth filter before the sampler [assumed]."""


@dataclass(frozen=True, kw_only=True)
class SensorLocation(Settings):
    """Location of an accelerometer on the body."""

    axle: Annotated[Literal["front", "rear"], "", "axle from which `ahead` is measured"]
    ahead: Annotated[Finite, "m", "ahead of that axle; negative behind it"]
    y: Annotated[Finite, "m", "left of the centre line"]

    def x(self, car: VehicleParameters) -> float:
        """Return the position ahead of the body's centre of mass [m]."""
        return (car.front if self.axle == "front" else car.rear).x + self.ahead


@dataclass(frozen=True, kw_only=True)
class SensorLocations(Settings):
    """Locations of the paper's three accelerometers."""

    RF: SensorLocation
    LR: SensorLocation
    RR: SensorLocation


@dataclass(frozen=True, kw_only=True)
class Instruments(Settings):
    """Accelerometers, logger and speed signal of one vehicle."""

    name: str
    accelerometers: SensorLocations
    fs: Annotated[Positive, "Hz", "sampling rate"]
    f_alias: Annotated[Positive, "Hz", "cut-off of the anti-alias filter"]
    range: Annotated[float, Field(gt=0), "m/s²", "clipping level, either way"]
    noise_density: Annotated[
        NonNegative, "(m/s²)/sqrt(Hz)", "one-sided; std = density sqrt(rate / 2)"
    ]
    speed_error: Annotated[NonNegative, "", "standard deviation of the relative error of speed"]
    sources: dict[str, str]

    def __post_init__(self):
        super().__post_init__()
        if self.f_alias >= 0.5 * self.fs:
            raise ValueError(f"f_alias {self.f_alias} must be below fs / 2 = {0.5 * self.fs}")

    def locations(self, car: VehicleParameters) -> dict[str, tuple[float, float]]:
        """Return (x, y) [m] of each sensor, ahead and left of the body's centre of mass."""
        locations = {name: getattr(self.accelerometers, name) for name in SENSORS}
        return {name: (location.x(car), location.y) for name, location in locations.items()}

    def response(self, f: np.ndarray) -> np.ndarray:
        """Return the complex response [-] of the anti-alias filter at `f` [Hz], any shape.

        It is that of the analogue Butterworth filter, which delays slow signals by
        2.613 / (2 pi f_alias).
        """
        s = 1j * np.asarray(f, dtype=float) / self.f_alias
        k = np.arange(1, ANTIALIAS_ORDER + 1)
        poles = np.exp(0.5j * np.pi * (2 * k + ANTIALIAS_ORDER - 1) / ANTIALIAS_ORDER)
        return 1.0 / np.prod(s[..., None] - poles, axis=-1)


def load_instruments(name: str | Path) -> Instruments:
    """Load instruments by shipped name or YAML path. Raises ConfigError."""
    return config.load(Instruments, "sensors", name)
