"""Recurrent network (NARX) of the same authors, 2010: height from accelerations and past heights.

    z_k = W2 tanh(W1 [a_k ... a_k-delays, z_k-1 ... z_k-delays] + b1) + b2

at the profile stations, 20 hidden units, one output per wheel path (Ngwangwa, Heyns, Labuschagne &
Kululanga, J. Terramechanics 47, 2010). Trained series-parallel: the fed-back heights are the true
ones, so training is that of a static network (`levenberg_marquardt.py`). In use it runs in
parallel: its own outputs are fed back, starting on the level apron. The number of delays and all
else is assumed as in `static_lm`.

With true heights fed back the error is small, because a profile changes little between stations;
this figure is not attainable in use. Open-loop and closed-loop errors are measured on the held-out
part of the training roads, stored with the weights and reported in the notes of each estimate.

Limitations: fed-back errors accumulate; on a new road the estimate is no better than a level one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Self

import numpy as np

from estimators.api import Profiles, Records, copy_with, require_fitted
from estimators.networks import levenberg_marquardt as lm
from estimators.networks.lm_estimator import PATHS, FittedNetwork, LmEstimator
from estimators.preprocessing import clean_record, spatial_accelerations
from road_envs.core.config import Count
from road_envs.kernels._numba import kernel
from road_envs.records.record import SENSORS, Estimate, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters

# Fraction of each training drive, at its end, on which both loops are evaluated
_HELD_OUT_SHARE = 0.15


@dataclass(frozen=True, kw_only=True)
class Narx(LmEstimator):
    """The paper's network with `delays` of its heights fed back; `training` holds the history."""

    range_name: ClassVar[str] = "heights"
    n_errors: ClassVar[int] = 2
    hidden: Annotated[Count, "", "hidden units"] = 20
    max_epochs: Annotated[Count, "", "most epochs"] = 300
    delays: Annotated[Count, "", "past stations among the inputs"] = 2

    @property
    def n_regressors(self) -> int:
        return len(SENSORS) * (self.delays + 1) + PATHS * self.delays

    def fit(self, records: Records, truths: Profiles, car: VehicleParameters, seed: int) -> Self:
        """Train series-parallel; `seed` draws division and initial weights. Raises RecordError."""
        a, z, inputs, outputs = self._training_data(records, truths)
        drives = [(inputs.apply(x), outputs.apply(y)) for x, y in zip(a, z, strict=True)]
        parts = [(x[:, : _n_training(y)], y[:, : _n_training(y)]) for x, y in drives]
        samples = [_series_parallel(*part, self.delays) for part in parts]
        x, t = (np.hstack(part) for part in zip(*samples, strict=True))
        training = self._train(x, t, "random", seed)
        errors = self._loop_errors(training.network, outputs, drives)
        return copy_with(self, fitted_state=FittedNetwork(training, inputs, outputs, errors))

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Run the network in parallel on its own outputs. Raises RecordError, NotFittedError."""
        training, inputs, outputs, errors = require_fitted(self.fitted_state, self)
        record, notes = clean_record(record)
        x = inputs.apply(spatial_accelerations(record))
        before = np.repeat(outputs.apply(np.zeros((PATHS, 1))), self.delays, axis=1)
        layers = training.network.hidden, training.network.output
        z = outputs.reverse(_run_parallel(*layers, x, before))
        loop_note = (
            f"relative error on held-out training roads {errors[1]:.2f} in closed loop, as here; "
            f"{errors[0]:.2f} with the true heights fed back, which is not attainable in use"
        )
        return Estimate(profile_stations(record.length), z, notes=(*notes, loop_note))

    def _loop_errors(
        self, network: lm.TwoLayerNetwork, outputs: lm.Scaling, drives: Sequence
    ) -> tuple[float, float]:
        """Return the relative errors of the held-out heights in open and closed loop."""
        wrong, level = np.zeros(2), 0.0
        for x, y in drives:
            first = _n_training(y)
            begin = first - self.delays
            regressors, t = _series_parallel(x[:, begin:], y[:, begin:], self.delays)
            layers = network.hidden, network.output
            closed = _run_parallel(*layers, x[:, first:], y[:, begin:first])
            truth = outputs.reverse(t)
            for k, z in enumerate((network(regressors), closed)):
                wrong[k] += np.sum((outputs.reverse(z) - truth) ** 2)
            level += np.sum((truth - truth.mean(axis=1, keepdims=True)) ** 2)
        open_loop, closed_loop = np.sqrt(wrong / level) if level > 0.0 else (0.0, 0.0)
        return float(open_loop), float(closed_loop)


def _series_parallel(x: np.ndarray, z: np.ndarray, delays: int) -> tuple[np.ndarray, np.ndarray]:
    """Return regressors (3 (delays + 1) + 2 delays, M - delays) and targets (2, M - delays) of
    mapped accelerations `x` (3, M) and true heights `z` (2, M), newest accelerations first.
    """
    M = x.shape[1]
    sensed = [x[:, delays - k : M - k] for k in range(delays + 1)]
    past = [z[:, delays - k : M - k] for k in range(1, delays + 1)]
    return np.concatenate([*sensed, *past]), z[:, delays:]


@kernel
def _run_parallel(hidden, output, x, before):
    """Return the outputs (2, M), which are fed back, for mapped accelerations `x` (3, M) and the
    initial heights `before` (2, delays); accelerations before the first equal the first.
    """
    (paths, delays), sensors, units = before.shape, x.shape[0], hidden.shape[1]
    z = np.empty((paths, x.shape[1]))
    for k in range(x.shape[1]):
        for i in range(paths):
            z[i, k] = output[i, units]
        for j in range(units):
            net = hidden[hidden.shape[0] - 1, j]
            row = 0
            for d in range(delays + 1):
                for i in range(sensors):
                    net += hidden[row, j] * x[i, max(k - d, 0)]
                    row += 1
            for d in range(1, delays + 1):
                for i in range(paths):
                    past = z[i, k - d] if k >= d else before[i, delays + k - d]
                    net += hidden[row, j] * past
                    row += 1
            unit = np.tanh(net)
            for i in range(paths):
                z[i, k] += output[i, j] * unit
    return z


def _n_training(z: np.ndarray) -> int:
    return z.shape[1] - int(_HELD_OUT_SHARE * z.shape[1])
