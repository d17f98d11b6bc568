"""A temporal convolutional network over distance, offline and causal; one for all speeds and modes.

The network, what it reads and how it learns stand in `networks.py`, `sequence.py` and
`teaching.py`. Five dilated layers see 9.7 m to either side offline, 19 m back causally, beyond what
the linear windows before them have gathered.

Known to fail: on cars that differ much from those it was taught with; below 0.15 cycles/m, where it
adds nothing to the linear windows.
"""

import abc
from dataclasses import dataclass
from typing import Any, ClassVar

from estimators.networks.inputs import LAG, N_CONDITIONS, N_INPUTS
from estimators.networks.sequence_estimator import SequenceEstimator


@dataclass(frozen=True, kw_only=True)
class _Convolutional(SequenceEstimator, abc.ABC):
    channels: int = 48
    kernel: int = 5
    dilations: tuple[int, ...] = (1, 2, 4, 8, 16)

    def __post_init__(self):
        super().__post_init__()
        if self.kernel < 3 or self.kernel % 2 == 0:
            raise ValueError(f"kernel must be odd and at least 3, got {self.kernel}")
        if not self.dilations or min(self.dilations) < 1:
            raise ValueError(f"dilations must be at least 1, got {self.dilations}")

    def network(self) -> Any:
        """The torch network before it has learnt anything."""
        from estimators.networks.modules import TemporalConvNet

        size = self.channels, self.kernel, self.dilations
        return TemporalConvNet(N_INPUTS, N_CONDITIONS, *size, self.causal)


@dataclass(frozen=True, kw_only=True)
class Tcn(_Convolutional):
    """Sees the whole drive."""

    name: ClassVar[str] = "tcn"
    causal: ClassVar[bool] = False


@dataclass(frozen=True, kw_only=True)
class TcnCausal(_Convolutional):
    """Sees no further than the front axle is when it is LAG past the station."""

    name: ClassVar[str] = "tcn_causal"
    causal: ClassVar[bool] = True
    lag: ClassVar[float | None] = LAG
