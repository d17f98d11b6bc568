"""Data sheet of the instruments: locations, sampling, range and noise.

Estimators may use it; `data_logger.py` simulates the instruments.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from road_envs.core import config
from road_envs.core.config import NonNegative, Positive, Settings
from road_envs.records.accelerometers import Accelerometer, Layout
from road_envs.records.record import Record
from road_envs.vehicle.parameters import VehicleParameters

ANTIALIAS_ORDER = 4  # order of the Butterworth filter before the sampler [assumed]


class SensorLocation(NamedTuple):
    """Place `x` ahead and `y` left of the centre of mass [m], on the body or on an `axle`.

    `axle` is 0 for the front axle, 1 for the rear one and None for the body.
    """

    x: float
    y: float
    axle: int | None = None


@dataclass(frozen=True, kw_only=True)
class Instruments(Settings):
    """Accelerometers, logger and speed signal of one vehicle."""

    name: str
    accelerometers: Layout
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

    def locations(self, car: VehicleParameters) -> dict[str, SensorLocation]:
        """Return the location of each sensor on `car`."""
        return {name: _location(sensor, car) for name, sensor in self.accelerometers.items()}

    @property
    def noiseless(self) -> "Instruments":
        """The instruments without any noise, of each sensor as well, and without error of speed."""
        sensors = {name: replace(x, noise_density=None) for name, x in self.accelerometers.items()}
        return replace(self, accelerometers=sensors, noise_density=0.0, speed_error=0.0)

    @property
    def layout(self) -> dict[str, Accelerometer]:
        """The accelerometers, each with its range, as a record carries them."""
        sensors = zip(self.accelerometers.items(), self.ranges.tolist(), strict=True)
        return {name: replace(sensor, range=limit) for (name, sensor), limit in sensors}

    @property
    def ranges(self) -> np.ndarray:
        """Clipping level (k,) [m/s²] of each accelerometer."""
        own = [sensor.range for sensor in self.accelerometers.values()]
        return np.array([self.range if x is None else x for x in own], dtype=float)

    @property
    def noise_densities(self) -> np.ndarray:
        """Noise density (k,) [(m/s²)/sqrt(Hz)] of each accelerometer."""
        own = [sensor.noise_density for sensor in self.accelerometers.values()]
        return np.array([self.noise_density if x is None else x for x in own], dtype=float)

    def noise_rms(self, fs: float) -> float:
        """Return the RMS [m/s²] of the accelerometers' noise, sampled at `fs` [Hz]."""
        return float(np.sqrt(0.5 * fs * np.mean(self.noise_densities**2)))

    def response(self, f: np.ndarray) -> np.ndarray:
        """Return the complex response [-] of the anti-alias filter at `f` [Hz], any shape.

        It is the analogue Butterworth filter, which delays slow signals by 2.613 / (2 pi f_alias).
        """
        s = 1j * np.asarray(f, dtype=float) / self.f_alias
        k = np.arange(1, ANTIALIAS_ORDER + 1)
        poles = np.exp(0.5j * np.pi * (2 * k + ANTIALIAS_ORDER - 1) / ANTIALIAS_ORDER)
        return 1.0 / np.prod(s[..., None] - poles, axis=-1)


def _location(sensor: Accelerometer, car: VehicleParameters) -> SensorLocation:
    axles = {"front": car.front.x, "rear": car.rear.x}
    if sensor.mounted == "body":
        return SensorLocation(axles.get(sensor.axle or "", 0.0) + sensor.ahead, sensor.y)
    axle = 0 if sensor.mounted == "front axle" else 1
    return SensorLocation(car.axles[axle].x, sensor.y, axle)


def on_axle(locations: Mapping[str, SensorLocation]) -> bool:
    """Return whether any of the sensors is mounted on an axle."""
    return any(location.axle is not None for location in locations.values())


def load_instruments(name: str | Path) -> Instruments:
    """Load instruments by shipped name or YAML path. Raises ConfigError."""
    return config.load(Instruments, "sensors", name)


def instruments_of(record: Record, name: str | Path) -> Instruments:
    """Load instruments, with the accelerometers of `record` where it has them.

    Raises ConfigError, also if their number is not that of the record.
    """
    instruments = load_instruments(name)
    if record.sensors is not None:
        return replace(instruments, accelerometers=dict(record.sensors))
    if (k := len(instruments.accelerometers)) != len(record.a):
        raise config.ConfigError(
            f"the record has {len(record.a)} accelerations, but the instruments {name} have {k} "
            f"accelerometers ({', '.join(instruments.accelerometers)})"
        )
    return instruments
