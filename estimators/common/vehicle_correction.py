"""Quick correction of a trained estimator for one vehicle, from drives of it over measured roads.

The error of the trained estimator on a known road is regressed on the motions in a window, on the
inputs of the last layer if it is a network, and on its estimate. The ridge draws the correction
towards zero, that is towards the trained weights; it is chosen by cross-validation over fifths of
the drives, and is infinite if no correction predicts any better. A correction is used in
the state of the struts and near the speed at which it was found.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from estimators.api import CalibrationDrive, CalibrationError
from estimators.common.blas import single_blas_thread
from estimators.common.least_squares import LeastSquaresSums, cross_validate
from estimators.common.odometer import calibrate_odometer
from estimators.common.spatial_signals import EDGE_STATIONS, SPACING, SpatialSignals
from estimators.common.training_data import TrainingExample

_FOLDS = 5
# Candidates, relative to the mean square of the features; infinite: no correction
_RIDGES = np.append(10.0 ** np.arange(-4.0, 2.0), np.inf)
_SPEED_RATIO = 1.15  # factor of the speed up to which a correction is used
# Stations to either side in the window of motions: 6 m. A causal window ends with its lag.
CORRECTION_REACH = 40
# Largest share of a road's mean square that cross-validation may leave; unrelated profiles leave
# all of it
_UNEXPLAINED_MAX = 0.97
NOTE = "corrected by a calibration drive of this vehicle"


class VehicleCorrection(NamedTuple):
    """`coefficients` (2, p) for m and q, of a `state` (4,) and about a mean `speed` [m/s]."""

    coefficients: np.ndarray
    state: np.ndarray
    speed: float

    def serves(self, signals: SpatialSignals) -> bool:
        """Return whether a drive is in the state and near the speed of the correction."""
        near = self.speed / _SPEED_RATIO < signals.speed < self.speed * _SPEED_RATIO
        return bool((signals.state == self.state).all() and near)

    def correct(self, prediction: "Prediction") -> np.ndarray:
        """Return the corrected m and q (2, M) [m]."""
        change = np.einsum("rp,rpm->rm", self.coefficients, prediction.all_features())
        return prediction.estimate + prediction.unit * change


class Prediction(NamedTuple):
    """An `estimate` (2, M) of m and q [m], its `short_waves` (2, M) [m], and the `features`
    (2, p, M) of m and of q in the `unit` (M,) [m].
    """

    estimate: np.ndarray
    short_waves: np.ndarray
    features: np.ndarray
    unit: np.ndarray

    def all_features(self) -> np.ndarray:
        """Return the features (2, p + 1, M), the estimate's short waves last."""
        own = (self.short_waves / self.unit)[:, None]
        return np.concatenate([self.features, own], axis=1)


@single_blas_thread()
def fit_corrections(
    drives: Sequence[CalibrationDrive],
    causal: bool,
    predict: Callable[[SpatialSignals], Prediction],
    high_pass: Callable[[np.ndarray], np.ndarray],
) -> tuple[VehicleCorrection, ...]:
    """Fit a correction to the measured roads of each condition among the `drives`.

    `predict` returns the estimate of a drive, `high_pass` the short waves of heights (2, M), in
    which errors are compared. Corrections that cross-validation does not find better than none are
    left out. Raises RecordError, CalibrationError.
    """
    found: list[VehicleCorrection] = []
    groups: dict[bytes, list[tuple[TrainingExample, CalibrationDrive]]] = {}
    for drive in drives:
        if drive.profile is not None:
            record = calibrate_odometer(drive.record, causal).record
            example = TrainingExample.of(record, drive.profile, causal)
            step = np.round(np.log(example.signals.speed) / np.log(_SPEED_RATIO))
            key = np.append(example.signals.state, step).tobytes()
            groups.setdefault(key, []).append((example, drive))
    for group in groups.values():
        sums, power = list[list[LeastSquaresSums]](), 0.0
        for example, drive in group:
            prediction = predict(example.signals)
            x, unit = prediction.all_features(), prediction.unit
            error = high_pass(example.target - prediction.estimate) / unit
            assert drive.profile is not None
            s = SPACING * (np.arange(unit.size) - EDGE_STATIONS)
            inside = np.flatnonzero((s > drive.profile.s[0]) & (s < drive.profile.s[-1]))
            power += float(np.sum((high_pass(example.target) / unit)[:, inside] ** 2))
            sums = sums or [[LeastSquaresSums.zeros(x.shape[1], 1)] * _FOLDS for _ in x]
            for row, folds in enumerate(sums):
                for k, part in enumerate(np.array_split(inside, _FOLDS)):
                    new = LeastSquaresSums.from_samples(x[row][:, part].T, error[row][part, None])
                    folds[k] = folds[k].plus(new)
        speed = float(np.mean([example.signals.speed for example, _ in group]))
        chosen = [cross_validate(folds, _RIDGES) for folds in sums]
        coefficients = np.array([each[:, 0] for _, each, _ in chosen])
        if sum(left for _, _, left in chosen) > _UNEXPLAINED_MAX * power:
            raise CalibrationError(
                f"{group[0][1].name}: a correction finds nothing of the profile in the drive; it "
                "is of another road or lane, reversed, displaced or in other units, or the "
                "vehicle is too unlike that of the training (calibrated_fir knows none)"
            )
        if coefficients.any():
            found.append(VehicleCorrection(coefficients, group[0][0].signals.state, speed))
    return tuple(found)
