"""A gated recurrent network over distance, offline (both ways) and causal (forward).

One for all speeds and modes; what it reads and how it learns is as for `tcn`. In teaching it warms
up on 9 m before the stations that it answers for, and offline on as much after them; on a drive
it runs through.

Known to fail: as `tcn`, than which it errs more by a tenth (median NRMSE over 42 drives of the main
board 0.30 for 0.27, causal 0.34 for 0.32), with fewer numbers; in teaching it takes several times
as long a step, since it goes station by station.
"""

import abc
from dataclasses import dataclass
from typing import Any, ClassVar

from estimators.networks.inputs import LAG, N_CONDITIONS, N_INPUTS
from estimators.networks.sequence_estimator import SequenceEstimator

WARM_UP_STATIONS = 60
"""Stations of warming up."""


@dataclass(frozen=True, kw_only=True)
class _Recurrent(SequenceEstimator, abc.ABC):
    steps: int = 1200
    channels: int = 48
    kernel: int = 9

    def __post_init__(self):
        super().__post_init__()
        if self.kernel < 3 or self.kernel % 2 == 0:
            raise ValueError(f"kernel must be odd and at least 3, got {self.kernel}")

    def network(self) -> Any:
        """The torch network before it has learnt anything."""
        from estimators.networks.modules import GatedRecurrentNet

        size = self.channels, self.kernel, WARM_UP_STATIONS
        return GatedRecurrentNet(N_INPUTS, N_CONDITIONS, *size, self.causal)


@dataclass(frozen=True, kw_only=True)
class Gru(_Recurrent):
    """Sees the whole drive."""

    name: ClassVar[str] = "gru"
    causal: ClassVar[bool] = False


@dataclass(frozen=True, kw_only=True)
class GruCausal(_Recurrent):
    """Sees no further than the front axle is when it is LAG past the station."""

    name: ClassVar[str] = "gru_causal"
    causal: ClassVar[bool] = True
    lag: ClassVar[float | None] = LAG
