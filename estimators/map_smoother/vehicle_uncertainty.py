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

import numpy as np
from scipy.linalg import block_diag

from estimators.map_smoother.car_fit import CarFit
from estimators.map_smoother.instrument_errors import InstrumentErrors
from estimators.map_smoother.marginal_likelihood import (
    reading_sensitivities,
    varied_residuals,
)
from estimators.map_smoother.one_pass import LinearizedPass
from estimators.map_smoother.tuning import TUNING
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import parameter_space, varied_car

IDENTIFIED = "identified"
"""Source of the tolerances of a vehicle that was identified: its posterior standard deviations."""


@dataclass(frozen=True, eq=False)
class VehicleUncertainty:
    """Errors of an identified `car` and its instruments: `covariance` (P + R, P + R) of the
    logarithms of the P parameters `names`, and behind them of the errors of the instruments in the
    units of `InstrumentErrors`. `is_prior`: no drive has been compared with the car yet. Errors of
    the road count `inflation` times.
    """

    car: VehicleParameters
    names: tuple[str, ...]
    covariance: np.ndarray
    is_prior: bool = False
    inflation: float = 1.0

    @classmethod
    def of_tolerances(
        cls, car: VehicleParameters, sensors: tuple[str, ...]
    ) -> "VehicleUncertainty":
        """Return that of a vehicle as described, by the tolerances that its file states, and of
        accelerometers `sensors` as by their data sheet. Raises ConfigError.

        What an identification left open is what drives do not show: no other one tells it, either.
        """
        space, errors = parameter_space(car), InstrumentErrors(sensors)
        variance = np.concatenate([space.std**2, _unfitted_variance(errors)])
        identified = all(tolerance.source == IDENTIFIED for tolerance in car.tolerances.values())
        return cls(car, space.names, np.diag(variance), is_prior=not identified)

    @classmethod
    def of_fit(cls, fit: CarFit) -> "VehicleUncertainty":
        """Return that of a fit to drives.

        Instruments that were not fitted err as their prior says, but for the odometer, of which
        nothing is known.
        """
        space, errors = fit.space, fit.instrument_errors
        unit = np.ones(fit.x.size)
        unit[: space.size] = space.std
        covariance = unit[:, None] * fit.covariance * unit
        if fit.x.size == space.size:
            covariance = block_diag(covariance, np.diag(_unfitted_variance(errors)))
        return cls(fit.car, space.names, covariance)

    def draw_changes(self, lin: LinearizedPass, white: np.ndarray) -> np.ndarray:
        """Return samples of G dp (N, S, J) [m/s²]: by how much the block means of a drive are
        mispredicted at `lin`, which is a linearization with `car`.

        `white` (N, P + R) is standard normal. Raises ArithmeticError.
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
    """Return the variances (R,) of errors of the instruments that were not fitted: as by their
    prior, but for the odometer, of which nothing is known.
    """
    variance = (np.arange(len(errors.names)) < errors.n_fixed).astype(float)
    gains = slice(len(errors.sensors))
    variance[gains] = (TUNING.gain_std / errors.std[gains]) ** 2
    return variance
