"""Base class of the estimators with one small network trained by Levenberg-Marquardt."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np

from estimators.api import copy_with, require_fitted, validate_weights
from estimators.networks import levenberg_marquardt as lm
from estimators.preprocessing import clean_record, sample_profile, spatial_accelerations
from road_envs.core.config import Count, Settings
from road_envs.records.record import SENSORS, Profile, Record, profile_stations

PATHS = 2


class FittedNetwork(NamedTuple):
    """Training result, scalings of inputs and outputs, and a NARX network's loop `errors`."""

    training: lm.LmResult
    inputs: lm.Scaling
    outputs: lm.Scaling
    errors: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class LmEstimator(Settings):
    """Settings, training and storage; after fitting, `training` holds history and stop reason."""

    causal: ClassVar[bool] = False  # the processed accelerations are not
    range_name: ClassVar[str]
    """Name of the mapped range of the heights among the weights."""

    n_errors: ClassVar[int] = 0
    hidden: Annotated[Count, "", "hidden units"]
    max_epochs: Annotated[Count, "", "most epochs"]
    max_fail: Annotated[Count, "", "epochs without a smaller validation error"] = 6
    max_samples: Annotated[Count, "", "training samples; of more an even selection"] = 3964
    fitted_state: FittedNetwork | None = field(default=None, init=False, repr=False, compare=False)

    @property
    def n_regressors(self) -> int:
        return len(SENSORS)

    @property
    def training(self) -> lm.LmResult:
        """Result of the training with one value per epoch. Raises NotFittedError."""
        return require_fitted(self.fitted_state, self).training

    def weights(self) -> dict[str, np.ndarray]:
        """Return the weights of both layers, the mapped ranges (low, high) of inputs and outputs,
        the errors of both loops if there are any, and the training history. Raises NotFittedError.
        """
        training, inputs, outputs, errors = require_fitted(self.fitted_state, self)
        return {
            "hidden": training.network.hidden,
            "output": training.network.output,
            "inputs": np.array([inputs.low, inputs.high]),
            self.range_name: np.array([outputs.low, outputs.high]),
            **({"loops": np.array(errors)} if errors else {}),
            **training.to_arrays(),
        }

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return a copy with these weights. Raises ValueError."""
        shapes = {
            "hidden": (self.n_regressors + 1, self.hidden),
            "output": (PATHS, self.hidden + 1),
            "inputs": (2, len(SENSORS)),
            self.range_name: (2, PATHS),
            **lm.HISTORY_SHAPES,
            **({"loops": (self.n_errors,)} if self.n_errors else {}),
        }
        hidden, output, inputs, outputs, curves, stop, *errors = validate_weights(weights, shapes)
        training = lm.LmResult.from_arrays(lm.TwoLayerNetwork(hidden, output), curves, stop)
        ranges = lm.Scaling(*inputs), lm.Scaling(*outputs)
        state = FittedNetwork(training, *ranges, *(tuple(part.tolist()) for part in errors))
        return copy_with(self, fitted_state=state)

    def _train(
        self, x: np.ndarray, t: np.ndarray, division: Literal["random", "block"], seed: int
    ) -> lm.LmResult:
        if t.shape[1] > self.max_samples:
            spread = np.linspace(0, t.shape[1] - 1, self.max_samples).astype(int)
            x, t = x[:, spread], t[:, spread]
        rng = np.random.default_rng(seed)
        split = lm.Split.divide(t.shape[1], division, rng)
        start = lm.nguyen_widrow(len(x), self.hidden, len(t), rng)
        options = lm.TrainlmOptions(max_epochs=self.max_epochs, max_fail=self.max_fail)
        return lm.train(start, x, t, split, options)

    @staticmethod
    def _training_data(
        records: Sequence[Record], truths: Sequence[Profile]
    ) -> tuple[list[np.ndarray], list[np.ndarray], lm.Scaling, lm.Scaling]:
        """Return accelerations (3, M) and true heights (2, M) of each drive at the profile
        stations, and the scalings of both. Raises RecordError.
        """
        a = [spatial_accelerations(clean_record(record)[0]) for record in records]
        pairs = zip(records, truths, strict=True)
        z = [sample_profile(truth, profile_stations(record.length)) for record, truth in pairs]
        return a, z, lm.Scaling.fit(np.hstack(a)), lm.Scaling.fit(np.hstack(z))
