"""Gated recurrent network over distance, offline (bidirectional) and causal (forward).

One network for all speeds and modes, with inputs and training as for `tcn`. In training it warms up
on the 9 m before a crop, offline also on the 9 m after it; in use it runs over the whole drive.

Limitations: as `tcn`, with errors larger by a tenth (median NRMSE over 42 drives of the main board
0.30 against 0.27, causal 0.34 against 0.32) and fewer parameters; a training step takes several
times as long, since the stations are processed sequentially.
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from estimators.api import LAG
from estimators.networks.sequence_estimator import KernelSize, SequenceEstimator
from road_envs.core.config import Count

_WARM_UP_STATIONS = 60  # stations of warm-up


@dataclass(frozen=True, kw_only=True)
class Gru(SequenceEstimator):
    """Recurrent network over stations; offline: uses the whole drive."""

    name: ClassVar[str] = "gru"
    causal: ClassVar[bool] = False

    steps: Annotated[Count, "", "training steps"] = 1200
    kernel: KernelSize = 9

    def network(self) -> Any:
        """Return the torch network with its initial weights."""
        from estimators.networks.modules import GatedRecurrentNet

        return GatedRecurrentNet(self.channels, self.kernel, _WARM_UP_STATIONS, self.causal)


@dataclass(frozen=True, kw_only=True)
class GruCausal(Gru):
    """Recurrent network over stations; causal: uses the drive until LAG beyond the station."""

    name: ClassVar[str] = "gru_causal"
    causal: ClassVar[bool] = True
    lag: ClassVar[float | None] = LAG
