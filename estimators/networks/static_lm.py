"""Static 3-50-2 network of the paper, trained by Levenberg-Marquardt: the historical baseline.

Inputs at a station: the three vertical body accelerations (RF, LR, RR; linear trend removed, 25 Hz
low-pass) at the moment when the front axle passed it [assumed]. Outputs: the heights of the left
and right wheel path there. Tan-sigmoid hidden layer, linear outputs, no memory (Ngwangwa, Heyns,
Breytenbach & Els, sections 4 and 5). The samples of all drives at the profile stations are divided
70/15/15; above `max_samples` an evenly spaced subset is used. The default is the paper's 3964:
behind a 25 Hz filter neighbouring samples are redundant.

Limitations: a height is not a function of the accelerations at one moment, so on a new road the
correlation with the truth is about zero. Trained on a modified version of the test road it matches
the level of the profile, which is all that the paper's equation 12 measures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np

from estimators.api import copy_with, require_fitted, validate_weights
from estimators.networks import levenberg_marquardt as lm
from estimators.preprocessing import clean_record, sample_profile, spatial_accelerations
from road_envs.config import STRICT
from road_envs.data.record import SENSORS, Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters


class FittedStaticLm(NamedTuple):
    """Training result, and the mapped ranges of inputs [m/s²] and outputs [m]."""

    training: lm.LmResult
    inputs: lm.Scaling
    outputs: lm.Scaling


@dataclass(frozen=True, kw_only=True)
class StaticLm:
    """A static network; after fitting, `training` holds history and stop reason."""

    __pydantic_config__ = STRICT
    causal: ClassVar[bool] = False

    hidden: int = 50
    division: Literal["random", "block"] = "random"
    max_epochs: int = 1000
    max_fail: int = 6
    max_samples: int = 3964
    fitted_state: FittedStaticLm | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        for name in ("hidden", "max_epochs", "max_fail", "max_samples"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def training(self) -> lm.LmResult:
        """Result of the training with one value per epoch. Raises NotFittedError."""
        return require_fitted(self.fitted_state, self).training

    def fit(
        self,
        records: Sequence[Record],
        truths: Sequence[Profile],
        car: VehicleParameters,
        seed: int,
    ) -> Self:
        """Train on all drives; `seed` draws division and initial weights. Raises RecordError."""
        x = np.hstack([spatial_accelerations(clean_record(record)[0]) for record in records])
        pairs = zip(records, truths, strict=True)
        t = np.hstack(
            [sample_profile(truth, profile_stations(record.length)) for record, truth in pairs]
        )
        size = x.shape[1]
        if size > self.max_samples:
            spread = np.linspace(0, size - 1, self.max_samples).astype(int)
            x, t = x[:, spread], t[:, spread]
        inputs, outputs = lm.Scaling.fit(x), lm.Scaling.fit(t)
        rng = np.random.default_rng(seed)
        split = lm.divide(x.shape[1], self.division, rng)
        start = lm.nguyen_widrow(len(x), self.hidden, len(t), rng)
        options = lm.TrainlmOptions(max_epochs=self.max_epochs, max_fail=self.max_fail)
        training = lm.train(start, inputs.apply(x), outputs.apply(t), split, options)
        return copy_with(self, fitted_state=FittedStaticLm(training, inputs, outputs))

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return the network's output at every station. Raises RecordError, NotFittedError."""
        training, inputs, outputs = require_fitted(self.fitted_state, self)
        record, notes = clean_record(record)
        z = outputs.reverse(training.network(inputs.apply(spatial_accelerations(record))))
        return Estimate(profile_stations(record.length), z, notes=notes)

    def weights(self) -> dict[str, np.ndarray]:
        """Return the weights of both layers, the mapped ranges (low, high) of inputs and outputs,
        and the training history. Raises NotFittedError.
        """
        training, inputs, outputs = require_fitted(self.fitted_state, self)
        return {
            "hidden": training.network.hidden,
            "output": training.network.output,
            "inputs": np.array([inputs.low, inputs.high]),
            "outputs": np.array([outputs.low, outputs.high]),
            **training.to_arrays(),
        }

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return a copy with these weights. Raises ValueError."""
        size = len(SENSORS)
        shapes = {
            "hidden": (size + 1, self.hidden),
            "output": (2, self.hidden + 1),
            "inputs": (2, size),
            "outputs": (2, 2),
            **lm.HISTORY_SHAPES,
        }
        hidden, output, inputs, outputs, *history = validate_weights(weights, shapes)
        training = lm.LmResult.from_arrays(lm.TwoLayerNetwork(hidden, output), *history)
        fitted_state = FittedStaticLm(training, lm.Scaling(*inputs), lm.Scaling(*outputs))
        return copy_with(self, fitted_state=fitted_state)
