"""Estimators trained over distance for all speeds and modes, which can be corrected for a vehicle.

The error of the trained estimator on a known road is regressed on the motions in a window, on the
inputs of the last layer if it is a network, and on its estimate. The ridge draws the correction
towards zero, that is towards the trained weights; it is chosen by cross-validation over fifths of
the drives, and is infinite if no correction predicts any better. A correction is used in
the state of the struts and near the speed at which it was found.
"""

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from estimators.api import LAG, CalibrationDrive, CalibrationError, copy_with, require_fitted
from estimators.common.blas import single_blas_thread
from estimators.common.least_squares import LeastSquaresSums, cross_validate
from estimators.common.odometer import calibrate_odometer
from estimators.common.spatial_signals import (
    EDGE_STATIONS,
    FILTER_REACH,
    N_HIGH_PASS,
    SPACING,
    SpatialSignals,
    keep_short_waves,
    motion_windows,
    target_profile,
    upsample,
    wheel_paths,
)
from estimators.preprocessing import clean_record
from estimators.pretrained_weights import load_pretrained
from road_envs.core.config import Settings
from road_envs.records.record import Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters

SPEED_RANGE = 1.35, 20.5  # lowest and highest speed [m/s] of the training drives
STATIONS_BEHIND = 80  # of the FIR window before the estimated one, offline also after it: 12 m
# Stations ahead of the estimated one in a causal window; the filters use the rest of LAG
STATIONS_AHEAD = int((LAG - 2.0 * FILTER_REACH) / SPACING)
_STATION_MARGIN = 256  # stations read beyond either end of the road
LONG_WAVE_NOTE = f"waves longer than {1.0 / N_HIGH_PASS:.0f} m are not estimated"
_FOLDS = 5
# Candidates, relative to the mean square of the features; infinite: no correction
_RIDGES = np.append(10.0 ** np.arange(-4.0, 2.0), np.inf)
_SPEED_RATIO = 1.15  # factor of the speed up to which a correction is used
_CORRECTION_REACH = 40  # stations to either side in the window of motions; a causal one has its lag
# Largest share of a road's mean square that cross-validation may leave; unrelated profiles leave
# all of it
_UNEXPLAINED_MAX = 0.97
NOTE = "corrected by a calibration drive of this vehicle"


class TrainingExample(NamedTuple):
    """A drive over distance, m and q (2, M) [m] of its road, and whether the body is `rigid`."""

    signals: SpatialSignals
    target: np.ndarray
    rigid: bool = True

    @classmethod
    def of(
        cls, record: Record, truth: Profile, causal: bool, rigid: bool = True
    ) -> "TrainingExample":
        """Return the training example of a drive in single precision. Raises RecordError."""
        record, _ = clean_record(record)
        signals = SpatialSignals.of(record, _STATION_MARGIN, causal)
        arrays = {k: x.astype(np.float32) for k, x in signals._asdict().items() if k != "margin"}
        target = target_profile(truth, record.length).astype(np.float32)
        return cls(signals._replace(**arrays), target, rigid)


class Prediction(NamedTuple):
    """An `estimate` (2, M) of m and q [m], what corrections of it are computed from, the standard
    deviation `std` (M,) [m] of both wheel paths if it is known, and notes.

    Corrections are in the `unit` (M,) [m], motions in the `motion_unit` [m/s²], one or for each
    station (M,); `hidden` (2, C, M) is what the last layer of a network multiplies.
    """

    estimate: np.ndarray
    unit: np.ndarray
    motion_unit: np.ndarray | float
    hidden: np.ndarray
    std: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    def features(self, signals: SpatialSignals, causal: bool) -> np.ndarray:
        """Return the features (2, p, M) of a correction; the estimate's short waves are the last.

        Those of m and of q are the same motions, since the vehicle's body may be asymmetric.
        """
        ahead = STATIONS_AHEAD if causal else _CORRECTION_REACH
        windows = motion_windows(signals, _CORRECTION_REACH, ahead, causal)
        x = np.concatenate(list(windows), axis=1).T / self.motion_unit
        own = (keep_short_waves(self.estimate, causal) / self.unit)[:, None]
        return np.concatenate([self.hidden, np.array([x, x]), own], axis=1)


class VehicleCorrection(NamedTuple):
    """`coefficients` (2, p) for m and q, of a `state` (4,) and about a mean `speed` [m/s]."""

    coefficients: np.ndarray
    state: np.ndarray
    speed: float

    def serves(self, signals: SpatialSignals) -> bool:
        """Return whether a drive is in the state and near the speed of the correction."""
        near = self.speed / _SPEED_RATIO < signals.speed < self.speed * _SPEED_RATIO
        return bool((signals.state == self.state).all() and near)

    def correct(self, prediction: Prediction, signals: SpatialSignals, causal: bool) -> np.ndarray:
        """Return the corrected m and q (2, M) [m]."""
        features = prediction.features(signals, causal)
        change = np.einsum("rp,rpm->rm", self.coefficients, features)
        return prediction.estimate + prediction.unit * change


Predictor = Callable[[SpatialSignals], Prediction]


@dataclass(frozen=True, kw_only=True)
class SpatialEstimator(Settings, abc.ABC):
    """Result of a fit or shipped weights, and the corrections of `calibrate`."""

    name: ClassVar[str]
    causal: ClassVar[bool]

    fitted_state: Any = field(default=None, init=False, repr=False, compare=False)
    corrections: tuple[VehicleCorrection, ...] = field(
        default=(), init=False, repr=False, compare=False
    )

    @abc.abstractmethod
    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return a copy with these weights. Raises ValueError."""

    @abc.abstractmethod
    def predictor(self, car: VehicleParameters) -> Predictor:
        """Return what estimates a drive of the vehicle. Raises NotFittedError."""

    def training_example(
        self, record: Record, truth: Profile, rigid: bool = True
    ) -> TrainingExample:
        """Return what is kept of a drive for training. Raises RecordError."""
        return TrainingExample.of(record, truth, self.causal, rigid)

    def calibrate(self, drives: Sequence[CalibrationDrive], car: VehicleParameters) -> Self:
        """Return a copy with a correction for the vehicle of the drives over measured roads; others
        are not used. Raises RecordError, CalibrationError, NotFittedError.
        """
        corrections = fit_corrections(drives, self.causal, self.predictor(car))
        return copy_with(self, corrections=corrections)

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return both wheel paths, with standard deviations of their waves above 0.15 cycles/m if
        the estimator knows them. Raises RecordError, NotFittedError.
        """
        record, notes = clean_record(record)
        odometer = calibrate_odometer(record, self.causal)
        record = odometer.record
        signals = SpatialSignals.of(record, _STATION_MARGIN, self.causal)
        found = self.predictor(car)(signals)
        z, stations, z_std = found.estimate, profile_stations(record.length), None
        for correction in self.corrections:
            if correction.serves(signals):
                z, notes = correction.correct(found, signals, self.causal), (*notes, NOTE)
        if found.std is not None:
            at = SPACING * (np.arange(found.std.size) - EDGE_STATIONS)
            z_std = np.tile(np.interp(stations, at, found.std), (2, 1))
        notes = (*notes, LONG_WAVE_NOTE, *_validity_notes(signals), *found.notes)
        z = wheel_paths(upsample(z, stations.size))
        return odometer.describe(Estimate(stations, z, z_std, notes))

    def _fitted_or_pretrained(self) -> Any:
        """Return the fitted state, or the one shipped for the default settings. Raises
        NotFittedError.
        """
        if self.fitted_state is not None:
            return self.fitted_state
        weights = load_pretrained(self.name) if self == type(self)() else None
        return self.with_weights(require_fitted(weights, self)).fitted_state


def _validity_notes(signals: SpatialSignals) -> list[str]:
    """Return notes on speeds and strut states outside the training data."""
    notes = []
    v, states = signals.v[signals.inside], signals.states[signals.inside]
    slowest, fastest = SPEED_RANGE
    if v.min() < slowest or v.max() > fastest:
        notes.append(
            f"driven at {3.6 * v.min():.0f} to {3.6 * v.max():.0f} km/h, "
            f"trained at {3.6 * slowest:.0f} to {3.6 * fastest:.0f} km/h"
        )
    if np.any((states > 0.0) & (states < 1.0)):
        notes.append(
            "left and right struts in different states, or a mode change: both states are blended"
        )
    return notes


@single_blas_thread()
def fit_corrections(
    drives: Sequence[CalibrationDrive], causal: bool, predict: Predictor
) -> tuple[VehicleCorrection, ...]:
    """Fit a correction of what `predict` returns to the measured roads of each condition among the
    `drives`, by the short waves of its errors.

    Corrections that cross-validation does not find better than none are left out. Raises
    RecordError, CalibrationError.
    """
    found: list[VehicleCorrection] = []
    groups: dict[bytes, list[tuple[TrainingExample, str, Profile]]] = {}
    for drive in drives:
        if drive.profile is not None:
            record = calibrate_odometer(drive.record, causal).record
            example = TrainingExample.of(record, drive.profile, causal)
            step = np.round(np.log(example.signals.speed) / np.log(_SPEED_RATIO))
            key = np.append(example.signals.state, step).tobytes()
            groups.setdefault(key, []).append((example, drive.name, drive.profile))
    for group in groups.values():
        sums, power = list[list[LeastSquaresSums]](), 0.0
        for (signals, target, _), _, profile in group:
            prediction = predict(signals)
            x, unit = prediction.features(signals, causal), prediction.unit
            error = keep_short_waves(target - prediction.estimate, causal) / unit
            # only stations of the measured road count; EDGE_STATIONS of them lie before station 0
            s = SPACING * (np.arange(unit.size) - EDGE_STATIONS)
            inside = np.flatnonzero((s > profile.s[0]) & (s < profile.s[-1]))
            short = keep_short_waves(target.astype(float), causal) / unit
            power += float(np.sum(short[:, inside] ** 2))
            # sums[row][k]: row m or q, fold k, a fifth of the stations of every drive
            sums = sums or [[LeastSquaresSums.zeros(x.shape[1], 1)] * _FOLDS for _ in x]
            for row, folds in enumerate(sums):
                for k, part in enumerate(np.array_split(inside, _FOLDS)):
                    new = LeastSquaresSums.from_samples(x[row][:, part].T, error[row][part, None])
                    folds[k] = folds[k].plus(new)
        speed = float(np.mean([example.signals.speed for example, _, _ in group]))
        chosen = [cross_validate(folds, _RIDGES) for folds in sums]
        coefficients = np.array([each[:, 0] for _, each, _ in chosen])
        if sum(left for _, _, left in chosen) > _UNEXPLAINED_MAX * power:
            raise CalibrationError(
                f"{group[0][1]}: a correction finds nothing of the profile in the drive; it "
                "is of another road or lane, reversed, displaced or in other units, or the "
                "vehicle is too unlike that of the training (calibrated_fir knows none)"
            )
        if coefficients.any():
            found.append(VehicleCorrection(coefficients, group[0][0].signals.state, speed))
    return tuple(found)
