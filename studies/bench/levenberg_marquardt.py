"""Levenberg-Marquardt training against peer implementations, on one network and one data set.

The paper's 3-50-2 network is trained on the 3964 samples of a scenario, without validation and from
the same initial weights. The benchmark is the CPU time until the training error is that of this
project after EPOCHS; a peer that needs more than TIME_LIMIT counts with that time. The MINPACK
routine of SciPy gets the analytic Jacobian; torch-levenberg-marquardt computes its own with
`torch.func`. All use one thread: the training here takes no more, so that several run side by side.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from estimators.networks import levenberg_marquardt as lm
from estimators.preprocessing import sample_profile, spatial_accelerations
from road_envs.core.extras import optional_import
from road_envs.drives.recording import simulate_record
from road_envs.records.record import profile_stations
from road_envs.roads import load_road
from road_envs.sensing.data_logger import load_instruments
from road_envs.vehicle.parameters import load_vehicle
from studies.bench.integrators import CAR, PeerError
from studies.bench.speed import cpu_time

HIDDEN = 50
EPOCHS = 20
TIME_LIMIT = 60.0  # [s] of CPU


class Samples(NamedTuple):
    """Scaled inputs (3, N) and targets (2, N), and the initial weights."""

    x: np.ndarray
    t: np.ndarray
    start: lm.TwoLayerNetwork


class _StopTraining(Exception):  # noqa: N818 - control flow: SciPy has no callback
    """Raised to stop SciPy at the target error or at TIME_LIMIT."""


def samples(seed: int = 1) -> Samples:
    """Return a training scenario of the paper: altered Belgian paving, ride mode, 14.5 km/h."""
    surface = load_road("belgian_training").realise(np.random.default_rng(seed))
    record, truth = simulate_record(
        surface,
        vehicle=load_vehicle(CAR),
        speed_kmh=14.5,
        mode="ride",
        instruments=load_instruments("ideal"),
        seed=seed,
    )
    x, t = spatial_accelerations(record), sample_profile(truth, profile_stations(record.length))
    start = lm.nguyen_widrow(len(x), HIDDEN, len(t), np.random.default_rng(seed))
    return Samples(lm.Scaling.fit(x).apply(x), lm.Scaling.fit(t).apply(t), start)


def train_ours(given: Samples, epochs: int) -> lm.LmResult:
    """Train with this project, on all samples."""
    empty = np.array([], dtype=int)
    split = lm.Split(np.arange(given.t.shape[1]), empty, empty)
    return lm.train(given.start, given.x, given.t, split, lm.TrainlmOptions(max_epochs=epochs))


def time_ours(given: Samples) -> float:
    """Return the median CPU time [s] of some trainings of EPOCHS, after a first one."""
    return cpu_time(lambda: train_ours(given, EPOCHS), 3)


def time_scipy(given: Samples, error: float) -> float:
    """Return the CPU time [s] of `least_squares` until the mean squared `error` is reached."""
    begin = time.process_time()

    def residuals(p: np.ndarray) -> np.ndarray:
        residual = (_network(given, p)(given.x) - given.t).ravel()
        if np.mean(residual**2) <= error or time.process_time() - begin > TIME_LIMIT:
            raise _StopTraining
        return residual

    start = np.concatenate([given.start.hidden.ravel(), given.start.output.ravel()])
    try:
        least_squares(
            residuals, start, jac=lambda p: jacobian(_network(given, p), given.x), method="lm"
        )
    except _StopTraining:
        return time.process_time() - begin
    return TIME_LIMIT


def time_torch(given: Samples, error: float) -> float:
    """Return the CPU time [s] of torch-levenberg-marquardt. Raises PeerError if it is missing."""
    try:
        with optional_import("a neural network"):
            import torch
        from torch_levenberg_marquardt.training import LevenbergMarquardtModule
    except ImportError as missing:
        raise PeerError(f"torch-levenberg-marquardt is not installed: {missing}") from None
    first, second = torch.nn.Linear(3, HIDDEN), torch.nn.Linear(HIDDEN, 2)
    model = torch.nn.Sequential(first, torch.nn.Tanh(), second).double()
    hidden, output = given.start.hidden, given.start.output
    with torch.no_grad():
        first.weight.copy_(torch.from_numpy(hidden[:-1].T.copy()))
        first.bias.copy_(torch.from_numpy(hidden[-1].copy()))
        second.weight.copy_(torch.from_numpy(output[:, :-1].copy()))
        second.bias.copy_(torch.from_numpy(output[:, -1].copy()))
    x, t = (torch.from_numpy(part.T.copy()) for part in (given.x, given.t))
    peer, threads = LevenbergMarquardtModule(model), torch.get_num_threads()
    torch.set_num_threads(1)
    begin = time.process_time()
    try:
        while (elapsed := time.process_time() - begin) < TIME_LIMIT:
            _, loss, stopped, _ = peer.training_step(x, t)
            if float(loss) <= error:
                return time.process_time() - begin
            if stopped:
                break
        return max(elapsed, TIME_LIMIT)
    finally:
        torch.set_num_threads(threads)


PEERS: dict[str, Callable[[Samples, float], float]] = {
    "SciPy least_squares 'lm' (analytic Jacobian)": time_scipy,
    "torch-levenberg-marquardt": time_torch,
}


def jacobian(network: lm.TwoLayerNetwork, x: np.ndarray) -> np.ndarray:
    """Return the derivatives (2 N, P) of the outputs by the weights, the first output first."""
    ones = np.ones((1, x.shape[1]))
    inputs = np.vstack([x, ones])
    active = np.tanh(network.hidden.T @ inputs)
    units = np.vstack([active, ones])
    slope = 1.0 - active**2
    rows = []
    for k, weights in enumerate(network.output):
        hidden = inputs[:, None, :] * (weights[:-1, None] * slope)[None]
        output = np.zeros((*network.output.shape, x.shape[1]))
        output[k] = units
        rows.append(
            np.concatenate([hidden.reshape(-1, x.shape[1]), output.reshape(-1, x.shape[1])])
        )
    return np.concatenate(rows, axis=1).T


def _network(given: Samples, p: np.ndarray) -> lm.TwoLayerNetwork:
    hidden, output = given.start.hidden, given.start.output
    return lm.TwoLayerNetwork(
        p[: hidden.size].reshape(hidden.shape), p[hidden.size :].reshape(output.shape)
    )
