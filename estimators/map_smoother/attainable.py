"""Error that no estimator of the whole drive can undercut by much: the posterior at the truth.

The nonlinear vehicle, linearized about its motion over the true road, measures accelerations up to
a given frequency. The road's deviation from the truth then has the Gaussian (Laplace) posterior

    covariance = (I + J' R^-1 J)^-1

with J the tangent of the block means and the road's own prior. Its power in the scored band, by
samples of it (`posterior_sampling`), is what an estimator that knows vehicle, prior and noise
attains to first order. Unlike the bound of the linear vehicle it contains friction, which hides
slow motions and mixes frequencies, gas springs, stops and wheels that lift off.
"""

import numpy as np

from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.objective import Objective, linearize
from estimators.map_smoother.posterior_sampling import band_pass, draw_deviation, interior
from estimators.map_smoother.preconditioner import stationary_hessian
from estimators.map_smoother.windows import initial_window_state, window_objective
from estimators.preprocessing import mask_record
from road_envs.analysis.information_bound import RoadPrior
from road_envs.data.record import Profile, Record, scored_band
from road_envs.sensing.instruments import instruments_of
from road_envs.vehicle.parameters import VehicleParameters

CG_ITERATIONS, CG_TOLERANCE = 400, 1e-3
"""Of one sample; the error in the band has converged within a per cent."""


def attainable_error(
    record: Record,
    truth: Profile,
    car: VehicleParameters,
    prior: RoadPrior,
    *,
    bandwidth: float = 100.0,
    instruments: str = "paper",
    noise_density: float | None = None,
    draws: int = 2,
    seed: int = 0,
) -> float:
    """Return the attainable in-band NRMSE [-], both wheel paths pooled, of a road with `prior`.

    `record` gives stations, speed and strut states, `truth` the road. Accelerations are used up to
    `bandwidth` [Hz], with the noise of the `instruments` or of `noise_density`
    [(m/s²)/sqrt(Hz)]. Raises RecordError, ArithmeticError, ValueError on a flexible frame.
    """
    objective = whole_drive(record, car, prior, bandwidth, instruments, noise_density)
    road = objective.road
    u = road.noise_of(truth)
    x = np.pad(u.ravel(), (0, objective.size - u.size))
    lin = linearize(objective, x, objective.information)
    solution = MapSolution(lin, stationary_hessian(objective), noise_scale=1.0)
    solve = solution.inverse_hessian(CG_ITERATIONS, CG_TOLERANCE)
    low, high = scored_band(float(objective.inputs.v.mean()))
    inside = (road.n >= low) & (road.n <= high)
    middle, rng = interior(road.free, round(1.0 / (low * road.ds))), np.random.default_rng(seed)
    power = 0.0
    for _ in range(draws):
        dx = draw_deviation(lin, solve, rng)
        error = band_pass(road.apply(objective.split(dx)[0]), inside)[:, middle]
        power += float(np.var(error, axis=1).mean()) / draws
    true = band_pass(road.apply(u), inside)[:, middle]
    return float(np.sqrt(power / np.var(true, axis=1).mean()))


def whole_drive(
    record: Record,
    car: VehicleParameters,
    prior: RoadPrior,
    bandwidth: float,
    instruments: str,
    noise_density: float | None = None,
) -> Objective:
    """Return the objective of a drive as one window, with block means up to `bandwidth` [Hz]."""
    sensors = instruments_of(record, instruments)
    record, valid, _ = mask_record(record, sensors)
    estimator = MapSmoother(
        instruments=instruments, noise_density=noise_density, data_rate=2.0 * bandwidth
    )
    model = estimator.measurement_model(record, car, sensors)
    drive = estimator.prepare_drive(record, valid, car, sensors, readings_per_unknown=0.0)
    blocks = drive.a.shape[1] // drive.block_size
    return window_objective(model, drive, prior, initial_window_state(drive), 0, blocks)
