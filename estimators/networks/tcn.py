"""Temporal convolutional network over distance, offline and causal; one for all speeds and modes.

Network, inputs and training: `modules.py`, `inputs.py` and `trainer.py`. Five dilated layers span
9.7 m to either side offline and 19 m backwards in the causal variant, beyond the FIR windows.

Limitations: vehicles far from those of the training corpus; below 0.15 cycles/m the network adds
nothing to the FIR bank.
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from pydantic import Field

from estimators.api import LAG
from estimators.networks.sequence_estimator import SequenceEstimator
from road_envs.core.config import Count

_Dilations = Annotated[tuple[Count, ...], Field(min_length=1), "stations", "of the layers"]


@dataclass(frozen=True, kw_only=True)
class Tcn(SequenceEstimator):
    """Convolutional network over stations; offline: uses the whole drive."""

    name: ClassVar[str] = "tcn"
    causal: ClassVar[bool] = False

    dilations: _Dilations = (1, 2, 4, 8, 16)

    def network(self) -> Any:
        """Return the torch network with its initial weights."""
        from estimators.networks.modules import TemporalConvNet

        return TemporalConvNet(self.channels, self.kernel, self.dilations, self.causal)


@dataclass(frozen=True, kw_only=True)
class TcnCausal(Tcn):
    """Convolutional network over stations; causal: uses the drive until LAG beyond the station."""

    name: ClassVar[str] = "tcn_causal"
    causal: ClassVar[bool] = True
    lag: ClassVar[float | None] = LAG
