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

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np

from estimators.api import Profiles, Records, copy_with, require_fitted
from estimators.networks.lm_estimator import FittedNetwork, LmEstimator
from estimators.preprocessing import clean_record, spatial_accelerations
from road_envs.core.config import Count
from road_envs.records.record import Estimate, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class StaticLm(LmEstimator):
    """The paper's static network. After fitting, `training` holds history and stop reason."""

    range_name: ClassVar[str] = "outputs"
    hidden: Annotated[Count, "", "hidden units"] = 50
    max_epochs: Annotated[Count, "", "most epochs"] = 1000
    division: Literal["random", "block"] = "random"

    def fit(self, records: Records, truths: Profiles, car: VehicleParameters, seed: int) -> Self:
        """Train on all drives; `seed` draws division and initial weights. Raises RecordError."""
        a, z, inputs, outputs = self._training_data(records, truths)
        samples = inputs.apply(np.hstack(a)), outputs.apply(np.hstack(z))
        training = self._train(*samples, self.division, seed)
        return copy_with(self, fitted_state=FittedNetwork(training, inputs, outputs))

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return the network's output at every station. Raises RecordError, NotFittedError."""
        training, inputs, outputs, _ = require_fitted(self.fitted_state, self)
        record, notes = clean_record(record)
        z = outputs.reverse(training.network(inputs.apply(spatial_accelerations(record))))
        return Estimate(profile_stations(record.length), z, notes=notes)
