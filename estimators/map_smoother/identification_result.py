"""Result of an identification: the vehicle, what stays unknown of it, and sentences about both."""

from dataclasses import dataclass, replace

import numpy as np

from estimators.map_smoother.car_fit import CarFit
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.vehicle_uncertainty import IDENTIFIED, VehicleUncertainty
from road_envs.vehicle.parameters import Tolerance, VehicleParameters


@dataclass(frozen=True, eq=False)
class Unexplained:
    """Power of the residual over that of the instruments' noise, and its spectrum (F,) over `f`
    (F,) [Hz], mean of the three sensors.
    """

    power: float
    f: np.ndarray
    spectrum: np.ndarray


@dataclass(frozen=True, eq=False)
class IdentificationResult:
    """The `fit`, the identified `car` and its `uncertainty`, and what the described and the
    identified vehicle leave `unexplained` in the held-out part of each drive.
    """

    fit: CarFit
    car: VehicleParameters
    uncertainty: VehicleUncertainty
    unexplained: tuple[tuple[Unexplained, Unexplained], ...]

    @property
    def std(self) -> np.ndarray:
        return self.fit.std

    @property
    def left(self) -> float:
        """Power that the identified vehicle leaves unexplained, mean of the held-out parts."""
        return float(np.mean([fitted.power for _, fitted in self.unexplained]))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters (P,), errors of the instruments last."""
        return (*self.fit.space.names, *self.fit.instrument_errors.names)[: self.fit.x.size]

    @property
    def sensor_gains(self) -> tuple[float, ...]:
        """Gain of each accelerometer; 1 over unmeasured roads, where none is identified."""
        readings, errors = self.fit.instrument_errors, self.fit.x[self.fit.space.size :]
        gains = np.exp(readings.std * errors) if errors.size else np.ones(len(readings.names))
        return tuple(gains[: len(readings.sensors)].tolist())

    @property
    def displacement(self) -> float:
        """Distance [m] that the odometer lacks, mean of the drives; 0 over unmeasured roads."""
        errors = self.fit.x[self.fit.space.size :]
        if errors.size == 0:
            return 0.0
        found = (self.fit.instrument_errors.std * errors)[-2:]
        s = [solution.linearization.passes[0].source.inputs.s for solution in self.fit.solutions]
        travelled = float(np.mean([np.mean(x - x[0]) for x in s]))
        return float(found[0] + travelled * found[1])

    @property
    def factors(self) -> np.ndarray:
        """Fitted value over described value of each parameter of the vehicle."""
        space = self.fit.space
        return np.exp(space.std * self.fit.x[: space.size])

    @property
    def notes(self) -> list[str]:
        """Sentences on parameters that the drives do not determine, and on doubtful results."""
        size = self.fit.space.size
        x, std, names = self.fit.x[:size], self.std[:size], self.names
        open_ = ", ".join(names[i] for i in np.flatnonzero(std > TUNING.undetermined))
        far = ", ".join(names[i] for i in np.flatnonzero(np.abs(x) > TUNING.far))
        notes = []
        if _is_another_kind(self.fit):
            notes.append(
                "the drives contradict each other about the vehicle, and it is far from its "
                "description: it is of another kind, as with a solid axle for independent wheels; "
                "its tolerances are left as described, so heights and IRI stay as uncertain"
            )
        if open_:
            notes.append(f"not determined by the drives, kept as described: {open_}")
        if far:
            notes.append(f"more than {TUNING.far:g} tolerances from the description: {far}")
        if self.fit.x.size > size:
            notes.append(
                "errors of the instruments are not in the vehicle's file; calibrate of an "
                "estimator corrects gains and odometer, and leaves accelerometers at the places "
                "of their sheet"
            )
        if any(fitted.power > described.power for described, fitted in self.unexplained):
            notes.append("on held-out readings the identified vehicle is no better: do not use it")
        return notes


def _is_another_kind(fit: CarFit) -> bool:
    return bool(fit.contradiction > TUNING.contradiction and (np.abs(fit.x) > TUNING.far).any())


def posterior_of(
    fit: CarFit, car: VehicleParameters
) -> tuple[VehicleParameters, VehicleUncertainty]:
    """Return the vehicle fitted in place of `car`, with the posterior standard deviations as its
    tolerances, and what stays unknown of it; of a vehicle of another kind as in its description.
    """
    space, source = fit.space, IDENTIFIED
    if _is_another_kind(fit):
        fit = replace(fit, covariance=np.eye(fit.x.size))
        source = "as described, since the drives are those of another kind of vehicle"
    std = space.std * np.minimum(fit.std[: space.size], 1.0)
    found = {
        name: Tolerance(relative=relative, source=source)
        for name, relative in zip(space.names, std.tolist(), strict=True)
    }
    name = car.name if car.name.endswith("identified") else f"{car.name} identified"
    identified = replace(fit.car, name=name, tolerances=found)
    return identified, VehicleUncertainty.of_fit(fit)
