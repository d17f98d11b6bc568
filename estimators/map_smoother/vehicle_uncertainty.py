"""Uncertainty of an identified vehicle and its instruments, as errors of a road.

A road is the most probable one of the vehicle p that was identified. If p is wrong by dp, the
accelerations that the vehicle predicts on that road are wrong by G dp, and the road is displaced as
by errors of the measurements of that size:

    dx = A^-1 J' R^-1 G dp,      A = I + J' R^-1 J,      G = d a / d p

So samples of dp with the covariance of the identification, added to samples of the noise, give
samples of the road under the joint posterior of road, vehicle and instruments
(`posterior_sampling.py`).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import block_diag

from estimators.map_smoother.car_fit import CarFit
from estimators.map_smoother.instrument_errors import InstrumentErrors
from estimators.map_smoother.marginal_likelihood import reading_sensitivities, varied_residuals
from estimators.map_smoother.one_pass import LinearizedPass
from estimators.map_smoother.tuning import TUNING
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import parameter_space, varied_car

IDENTIFIED = "identified"
"""Source of the tolerances of a vehicle that was identified: its posterior standard deviations."""


@dataclass(frozen=True, eq=False)
class VehicleUncertainty:
    """Errors of a `car` and its instruments: `covariance` (P + R, P + R) of the logarithms of the P
    parameters `names`, and behind them of the R errors of `InstrumentErrors`. `is_prior`: no drive
    has been compared with the car yet. Errors of the road count `inflation` times.
    """

    car: VehicleParameters
    names: tuple[str, ...]
    covariance: np.ndarray
    is_prior: bool = False
    inflation: float = 1.0

    @classmethod
    def of_tolerances(cls, car: VehicleParameters, sensors: tuple[str, ...]) -> Self:
        """Errors of a `car` by the tolerances that its file states, and of its accelerometers
        `sensors` by their data sheet. Tolerances that an identification left are no prior: what its
        drives did not show, no other drive shows, either. Raises ConfigError.
        """
        space, errors = parameter_space(car), InstrumentErrors(sensors)
        variance = np.concatenate([space.std**2, _unfitted_variance(errors)])
        identified = all(tolerance.source == IDENTIFIED for tolerance in car.tolerances.values())
        return cls(car, space.names, np.diag(variance), is_prior=not identified)

    @classmethod
    def of_fit(cls, fit: CarFit) -> Self:
        """Errors that a fit leaves; of unfitted instruments as of `_unfitted_variance`."""
        space, errors = fit.space, fit.instrument_errors
        unit = np.ones(fit.x.size)
        unit[: space.size] = space.std
        covariance = unit[:, None] * fit.covariance * unit
        if fit.x.size == space.size:
            covariance = block_diag(covariance, np.diag(_unfitted_variance(errors)))
        return cls(fit.car, space.names, covariance)

    def draw_changes(self, lin: LinearizedPass, white: np.ndarray) -> np.ndarray:
        """Samples of G dp (N, S, J) [m/s²], the errors of the block means that `car` predicts at
        `lin`; `white` (N, P + R) is standard normal. Raises ArithmeticError.
        """
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        of_car, of_instruments = np.split(white @ root.T, [len(self.names)], axis=1)
        factors = np.exp(TUNING.difference * of_car).tolist()
        cars = [varied_car(self.car, dict(zip(self.names, x, strict=True))) for x in factors]
        left = varied_residuals(lin, [lin.source.with_car(car) for car in cars])
        read = reading_sensitivities(lin, lin.source, np.zeros(of_instruments.shape[1]))
        by_car = (lin.residual - left) / TUNING.difference
        return by_car + np.tensordot(of_instruments, read, axes=1)


def _unfitted_variance(errors: InstrumentErrors) -> np.ndarray:
    """Variances (R,) of errors of instruments that were not fitted: of gains by their data sheet,
    of places by their prior; odometer and speed, of which nothing is known, have none.
    """
    variance, gains = np.ones(len(errors.names)), slice(len(errors.sensors))
    variance[gains] = (TUNING.gain_std / errors.std[gains]) ** 2
    variance[-2:] = 0.0
    return variance
