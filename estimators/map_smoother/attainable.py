"""Attainable error of a whole drive: the posterior at the truth, and the bound of van Trees.

The nonlinear vehicle, linearized about its motion over a road z, measures accelerations up to a
given frequency. With J(z) the tangent of the block means and I the precision of the noise that the
prior shapes into a road:

    attainable   (I + J' R^-1 J)^-1 at the true road: the covariance of the Gaussian (Laplace)
                 posterior there, which an estimator that knows vehicle, prior and noise attains to
                 first order
    van Trees    (I + E[J' R^-1 J])^-1, expected over the roads of the prior: no estimator
                 whatsoever has a smaller mean square error over these roads

(van Trees 1968, "Detection, Estimation, and Modulation Theory" part I, section 2.4; Gill & Levit
1995, doi:10.2307/3318681). The second is never above the mean of the first, by Jensen's inequality,
and with few roads it is overestimated, for the same reason. Unlike the bound of the linear vehicle
both contain friction, which hides slow motions and mixes frequencies, gas springs, stops and
wheels that lift off. Their power in the scored band is that of samples (`posterior_sampling`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.objective import Linearization, Means, Objective
from estimators.map_smoother.posterior_sampling import band_pass, draw_deviations, interior
from estimators.map_smoother.preconditioner import StationaryHessian, stationary_hessian
from estimators.map_smoother.preparation import SolverSettings
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.windows import whole_objective
from road_envs.analysis.information_bound import RoadPrior
from road_envs.records.record import Profile, Record, scored_band
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, eq=False)
class _ExpectedInformation:
    """Linearizations `at` several roads, whose information on the unknowns is averaged.

    It has the interface of one linearization as far as samples need it.
    """

    at: Sequence[Linearization]

    @property
    def objective(self) -> Objective:
        """The objective, which all have in common."""
        return self.at[0].objective

    def hessian_product(self, dx: np.ndarray) -> np.ndarray:
        """Return I + E[J' R^-1 J] times `dx`."""
        return np.mean([one.hessian_product(dx) for one in self.at], axis=0)

    def offset_scale(self, *noise: Any) -> np.ndarray:
        """Return that of the first, as of `Linearization.offset_scale`."""
        return self.at[0].offset_scale(*noise)

    def draw_noise(self, rng: np.random.Generator) -> list[list[np.ndarray]]:
        """Return R^-1/2 times white noise for each road."""
        return [one.draw_noise(rng) for one in self.at]

    def adjoint(self, means: Sequence[Means]) -> np.ndarray:
        """Return `x` from block means of each road, of covariance E[J' R^-1 J] if these are
        drawn noise.
        """
        pairs = zip(self.at, means, strict=True)
        return np.sum([one.adjoint(part) for one, part in pairs], axis=0) / np.sqrt(len(self.at))


def attainable_error(
    record: Record,
    truth: Profile,
    car: VehicleParameters,
    prior: RoadPrior,
    *,
    bandwidth: float = 100.0,
    instruments: str = "paper",
    noise_density: float | None = None,
) -> float:
    """Return the attainable in-band NRMSE [-], both wheel paths pooled, on the road of `truth`.

    `record` gives stations, speed and strut states. The prior's density and, on uneven roads, its
    local roughness are fitted to the truth as `map_smoother` fits them to its estimate.
    Accelerations are used up to `bandwidth` [Hz], with the noise of the `instruments` or of
    `noise_density` [(m/s²)/sqrt(Hz)]. Raises RecordError, ArithmeticError, ValueError on a flexible
    frame.
    """
    objective = _whole_drive(record, car, prior, bandwidth, instruments, noise_density)
    lin = objective.linearize(objective.from_noise(objective.road.noise_of(truth)))
    stationary = stationary_hessian(objective)  # that of the measurements, for any prior
    lin = MapSolution(lin, stationary, np.ones(1)).with_prior().linearization
    return _relative_error(lin, stationary, [lin.x])


def van_trees_error(
    record: Record,
    car: VehicleParameters,
    prior: RoadPrior,
    *,
    bandwidth: float = 100.0,
    instruments: str = "paper",
    noise_density: float | None = None,
    roads: int = 16,
) -> float:
    """Return the least in-band NRMSE [-] of any estimator, both wheel paths pooled, over the roads
    of a Gaussian `prior`.

    The information is averaged over that many `roads`; other arguments as in `attainable_error`.
    """
    objective = _whole_drive(record, car, prior, bandwidth, instruments, noise_density)
    rng = np.random.default_rng(0)
    points = [rng.standard_normal(objective.size) for _ in range(roads)]
    at = [objective.linearize(x) for x in points]
    return _relative_error(_ExpectedInformation(at), stationary_hessian(objective), points)


def _relative_error(lin: Any, stationary: StationaryHessian, points: Sequence[np.ndarray]) -> float:
    """Return the root of the mean power in the scored band of samples of the posterior of `lin`, a
    linearization or several, over that of the roads of `points`.
    """
    objective = lin.objective
    road = objective.road
    low, high = scored_band(float(objective.passes[0].inputs.v.mean()))
    inside = (road.n >= low) & (road.n <= high)
    middle, rng = interior(road.free, round(1.0 / (low * road.ds))), np.random.default_rng(0)

    def power(x: np.ndarray) -> float:
        c = band_pass(road.apply(objective.split(x)[0]), inside)[:, middle]
        return float(np.var(c, axis=1).mean())

    solution = MapSolution(lin, stationary, noise_scale=np.ones(1))
    solve = solution.inverse_hessian(*TUNING.attainable_cg)
    error = np.mean([power(dx) for dx in draw_deviations(lin, solve, rng, TUNING.attainable_draws)])
    return float(np.sqrt(error / np.mean([power(x) for x in points])))


def _whole_drive(
    record: Record,
    car: VehicleParameters,
    prior: RoadPrior,
    bandwidth: float,
    instruments: str,
    noise_density: float | None = None,
) -> Objective:
    """Return the objective of a drive as one window, with block means up to `bandwidth` [Hz]."""
    settings = SolverSettings(
        instruments=instruments, noise_density=noise_density, data_rate=2.0 * bandwidth
    )
    drive, _ = settings.prepare(record, car, readings_per_unknown=0.0)
    return whole_objective(drive, prior)
