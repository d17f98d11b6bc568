"""Base of the estimators that are pretrained over distance and can be corrected for one vehicle."""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from estimators.api import require_fitted
from estimators.common.spatial_signals import SpatialSignals
from estimators.common.training_data import TrainingExample
from estimators.common.vehicle_correction import NOTE, Prediction, VehicleCorrection
from estimators.pretrained_weights import load_pretrained
from road_envs.core.config import Settings
from road_envs.records.record import Profile, Record


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

    def training_example(
        self, record: Record, truth: Profile, rigid: bool = True
    ) -> TrainingExample:
        """Return what is kept of a drive for training. Raises RecordError."""
        return TrainingExample.of(record, truth, self.causal, rigid)

    def _fitted_or_pretrained(self) -> Any:
        """Return the fitted state, or the one shipped for the default settings. Raises
        NotFittedError.
        """
        if self.fitted_state is not None:
            return self.fitted_state
        weights = load_pretrained(self.name) if self == type(self)() else None
        return self.with_weights(require_fitted(weights, self)).fitted_state

    def _corrected(
        self, z: np.ndarray, signals: SpatialSignals, predict: Callable[[], Prediction]
    ) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return m and q (2, M) [m], by the correction that serves a drive or as estimated, `z`,
        and notes.
        """
        notes: tuple[str, ...] = ()
        for correction in self.corrections:
            if correction.serves(signals):
                z, notes = correction.correct(predict()), (*notes, NOTE)
        return z, notes
