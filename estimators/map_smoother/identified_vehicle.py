"""Calibration of the estimators that have a model of the vehicle: they all identify it alike, and
over a measured road the gains of its sensors and the displacement of its odometer too. It is
remembered in the user's cache, as several estimators are often calibrated with the same drives.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from typing import Self

import numpy as np

from estimators.api import CalibrationDrive, CalibrationError, copy_with
from estimators.map_smoother.identification import identify
from estimators.map_smoother.preparation import SolverSettings
from estimators.map_smoother.vehicle_uncertainty import VehicleUncertainty
from road_envs.core.artifacts import Kind
from road_envs.core.code_digest import cache_home
from road_envs.core.config import Settings, build
from road_envs.records.accelerometers import to_plain
from road_envs.records.record import Record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters

KIND = Kind("identified vehicle", 1, ("estimators.map_smoother.identification",))


@dataclass(frozen=True, kw_only=True)
class IdentifiedVehicle:
    """A vehicle with its instruments: `gain` of each accelerometer, and `displacement` [m] that its
    odometer lacks; `covariance` as in `VehicleUncertainty`, of the parameters that have tolerances.
    """

    car: VehicleParameters
    gain: tuple[float, ...] = (1.0, 1.0, 1.0)
    displacement: float = 0.0
    covariance: tuple[tuple[float, ...], ...] = ()

    @property
    def uncertainty(self) -> VehicleUncertainty | None:
        """Uncertainty of the vehicle, None if nothing is said about it."""
        if not self.covariance:
            return None
        return VehicleUncertainty(self.car, tuple(self.car.tolerances), np.array(self.covariance))

    def correct(self, record: Record) -> Record:
        """Return the record without these errors of the instruments. Raises CalibrationError."""
        if len(record.a) != len(self.gain):
            raise CalibrationError(
                f"calibrated with {len(self.gain)} accelerometers, and the record has "
                f"{len(record.a)}: calibrate with the same"
            )
        a = record.a / np.array(self.gain)[:, None]
        return replace(record, a=a, s=record.s + self.displacement)


@dataclass(frozen=True, kw_only=True)
class CalibratedByIdentification(Settings):
    """Part of an estimator with a model of the vehicle, that of `instruments`: `calibrate`."""

    instruments: str = "paper"
    identified: IdentifiedVehicle | None = field(
        default=None, init=False, repr=False, compare=False
    )

    def calibrate(self, drives: Sequence[CalibrationDrive], car: VehicleParameters) -> Self:
        """Return a copy for the vehicle of these drives. Raises CalibrationError, ConfigError."""
        return copy_with(self, identified=_identify_once(drives, car, self.instruments))

    def as_identified(
        self, record: Record, car: VehicleParameters
    ) -> tuple[Record, VehicleParameters]:
        """Return record and vehicle as identified; as they are without calibration."""
        known = self.identified
        return (record, car) if known is None else (known.correct(record), known.car)


def _identify_once(
    drives: Sequence[CalibrationDrive], car: VehicleParameters, instruments: str
) -> IdentifiedVehicle:
    """Identify a vehicle, or return the one that the same drives have identified before."""
    sensors = load_instruments(instruments)  # by content: `str` names every field in its order
    identity = KIND.identity(asdict(car), sensors, _drives_digest(drives))
    return KIND.find_or_make(
        cache_home(),
        identity,
        lambda: asdict(_identify(drives, car, instruments)),
        partial(build, IdentifiedVehicle, where="identified vehicle"),
    )


def _identify(
    drives: Sequence[CalibrationDrive], car: VehicleParameters, instruments: str
) -> IdentifiedVehicle:
    found = identify(drives, car, SolverSettings(instruments=instruments), structure=None)
    rows = tuple(map(tuple, found.uncertainty.covariance.tolist()))
    return IdentifiedVehicle(
        car=found.car, gain=found.sensor_gains, displacement=found.displacement, covariance=rows
    )


def _drives_digest(drives: Sequence[CalibrationDrive]) -> str:
    total = hashlib.sha256()
    for drive in drives:
        record, profile = drive.record, drive.profile
        total.update(json.dumps([to_plain(record.sensors), record.low_pass]).encode())
        signals = [f.name for f in fields(record) if f.name not in ("sensors", "low_pass")]
        arrays = [getattr(record, name) for name in signals]
        arrays += [] if profile is None else [profile.s, profile.z, drive.survey_std]
        for array in map(np.asarray, arrays):
            total.update(f"{array.dtype} {array.shape}".encode())
            total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()[:32]
