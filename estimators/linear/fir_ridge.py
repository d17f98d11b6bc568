"""FIR filter over distance: a height is a weighted sum of the accelerations around its station.

Shipped for all speeds and modes as a bank (`fir_bank.py`), with taps that depend on speed and strut
states and act on the motions of the body.

`fit` instead fits the drives of one speed and one mode, as the paper trains its network:

    z_k(s) = sum_j sum_i taps[k, j, i] a_j(s + i d)        |i d| <= reach

a_j are the three processed accelerations (RF, LR, RR) over the station of the front axle. They are
band-limited to 25 Hz, over distance to 25 Hz / v, so the tap spacing is d = v / 50 Hz, rounded down
to profile stations. Beyond the record the vehicle is assumed to be at rest.

The taps minimise the squared error on the training roads plus ridge x mean(a²) x sum(taps²). The
normal equations are summed over all drives, separately for the five fifths of every drive; the
ridge is chosen by cross-validation over these folds.

Accelerometers do not observe long waves (acceleration falls with n² v²), and the window is too
short for them: the target is the truth high-passed at 0.05 cycles/m (second-order Butterworth,
forward and backward), so longer waves are not estimated. There is no intercept: a mirrored drive
gives the mirrored road.

Limitations: large strokes, where the struts are far from linear; after `fit`, other speeds and
modes. A window of 3 m instead of 12 m increases the error by a factor of 1.3 to 2, since it
contains too little of the body's motion and of the rear axle's passage.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field

from estimators.api import CalibrationDrive, Profiles, Records, copy_with, validate_weights
from estimators.common.blas import single_blas_thread
from estimators.common.least_squares import LeastSquaresSums, cross_validate
from estimators.common.odometer import calibrate_odometer
from estimators.common.pretrained import (
    LONG_WAVE_NOTE,
    STATIONS_BEHIND,
    Prediction,
    Predictor,
    SpatialEstimator,
    TrainingExample,
)
from estimators.common.spatial_signals import SpatialSignals, without_long_waves
from estimators.linear.fir_bank import FirBank
from estimators.preprocessing import clean_record, sample_profile, spatial_accelerations
from road_envs.records.record import (
    F_C,
    PROFILE_SPACING,
    SENSORS,
    Estimate,
    Record,
    profile_stations,
)
from road_envs.vehicle.parameters import VehicleParameters

_FOLDS = 5
RIDGES = 10.0 ** np.arange(-6, 1)  # candidates, relative to the mean square of the accelerations


class _Taps(NamedTuple):
    """`taps` (2, 3, T) [s²] by wheel path, sensor and offset, `stride` profile stations apart; mean
    `speed` [m/s] of the training drives and the selected `ridge`.
    """

    taps: np.ndarray
    stride: int
    speed: float
    ridge: float


@dataclass(frozen=True, kw_only=True)
class FirRidge(SpatialEstimator):
    """Linear window over distance: the shipped bank; or, once fitted, one window of `reach` [m]
    to either side of the station. With `shipped=False` it must be fitted.
    """

    causal: ClassVar[bool] = False
    name: ClassVar[str] = "fir_ridge"
    refit_per_case: ClassVar[bool] = True
    uses_seed: ClassVar[bool] = False

    reach: Annotated[float, Field(gt=0, le=100), "m", "of the window"] = 12.0
    shipped: bool = True

    @single_blas_thread()  # small products: as in the LM training
    def fit(self, records: Records, truths: Profiles, car: VehicleParameters, seed: int) -> Self:
        """Fit taps to the speed and mode of these drives; `seed` is unused. Raises RecordError."""
        records = [clean_record(record)[0] for record in records]
        speed = float(np.mean([record.v.mean() for record in records]))
        stride = max(1, int(speed / (2.0 * F_C) / PROFILE_SPACING))
        half = self._half_taps(stride)
        folds = [LeastSquaresSums.zeros(len(SENSORS) * (2 * half + 1))] * _FOLDS
        for record, truth in zip(records, truths, strict=True):
            X = _sliding_windows(record, stride, half)
            z = sample_profile(truth, profile_stations(record.length))
            Z = without_long_waves(z)[:, ::stride].T
            parts = zip(folds, np.array_split(X, _FOLDS), np.array_split(Z, _FOLDS), strict=True)
            folds = [sums.plus(LeastSquaresSums.from_samples(x, z)) for sums, x, z in parts]
        ridge, coefficients, _ = cross_validate(folds, RIDGES)
        taps = coefficients.T.reshape(2, len(SENSORS), 2 * half + 1)
        return copy_with(self, fitted_state=_Taps(taps, stride, speed, ridge))

    def pretrain(
        self,
        drives: Sequence[TrainingExample],
        car: VehicleParameters,
        seed: int,
        progress: Callable[[str, float], None] = lambda text, share: None,
        checkpoint: object = None,
    ) -> Self:
        """Fit a bank for all speeds and modes; deterministic, takes less than a minute."""
        progress("fitting the FIR bank", 0.0)
        all_signals, targets, _ = zip(*drives, strict=True)
        bank = FirBank.fit(all_signals, targets, STATIONS_BEHIND, STATIONS_BEHIND)
        return copy_with(self, fitted_state=bank)

    def predictor(self, car: VehicleParameters) -> Predictor:
        """Return the function that estimates a drive by the bank. Raises NotFittedError."""
        bank = self._fitted_or_pretrained()

        def predict(signals: SpatialSignals) -> Prediction:
            no_layer = np.empty((2, 0, signals.size))
            return Prediction(bank(signals), np.ones(signals.size), 1.0, no_layer)

        return predict

    def calibrate(self, drives: Sequence[CalibrationDrive], car: VehicleParameters) -> Self:
        """Return a copy with a correction of the bank for the vehicle of the drives over measured
        roads; fitted taps stay. Raises RecordError, CalibrationError, NotFittedError.
        """
        is_bank = isinstance(self._fitted_or_pretrained(), FirBank)
        return super().calibrate(drives, car) if is_bank else self

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return the weighted sums. Raises RecordError, NotFittedError."""
        model = self._fitted_or_pretrained()
        if isinstance(model, FirBank):
            return super().estimate(record, car)
        record, notes = clean_record(record)
        odometer = calibrate_odometer(record)
        record = odometer.record
        taps, stride, speed, _ = model
        stations, half = profile_stations(record.length), taps.shape[2] // 2
        a = spatial_accelerations(record, half * stride)
        z = np.zeros((2, stations.size))
        for i in range(taps.shape[2]):
            z += taps[:, :, i] @ a[:, i * stride : i * stride + stations.size]
        notes, driven = (*notes, LONG_WAVE_NOTE), float(record.v.mean())
        if abs(driven - speed) > 0.1 * speed:
            notes += (f"fitted at {speed:.1f} m/s, driven at {driven:.1f} m/s",)
        return odometer.describe(Estimate(stations, z, notes=notes))

    def weights(self) -> dict[str, np.ndarray]:
        """Return `bank` (16, knots, 3, T); or, if fitted to one speed, `taps` (2, 3, T) and the
        scalars `stride`, `speed`, `ridge`. Raises NotFittedError.
        """
        model = self._fitted_or_pretrained()
        if isinstance(model, FirBank):
            return {"bank": model.taps}
        return {name: np.asarray(x) for name, x in model._asdict().items()}

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return a copy with these weights. Raises ValueError."""
        if "bank" in weights:
            shape = FirBank.shape(STATIONS_BEHIND, STATIONS_BEHIND)
            (taps,) = validate_weights(weights, {"bank": shape})
            return copy_with(self, fitted_state=FirBank(taps.astype(np.float16), STATIONS_BEHIND))
        shapes = {"taps": (2, len(SENSORS), None), "stride": (), "speed": (), "ridge": ()}
        taps, stride, speed, ridge = validate_weights(weights, shapes)
        if stride < 1 or taps.shape[2] != 2 * self._half_taps(int(stride)) + 1:
            raise ValueError(f"{taps.shape[2]} taps do not fit a window of {self.reach} m")
        return copy_with(self, fitted_state=_Taps(taps, int(stride), float(speed), float(ridge)))

    def _half_taps(self, stride: int) -> int:
        """Return the number of taps on one side of the station."""
        return int(self.reach / (stride * PROFILE_SPACING))


def _sliding_windows(record: Record, stride: int, half: int) -> np.ndarray:
    """Return the regressors (N, 3 (2 half + 1)) [m/s²] at every `stride`-th station."""
    a = spatial_accelerations(record, half * stride)
    windows = np.lib.stride_tricks.sliding_window_view(a, 2 * half * stride + 1, axis=1)
    return np.concatenate(list(windows[:, ::stride, ::stride]), axis=1)
