"""Firm states while the lateral acceleration is large: a threshold, alone or beside the RRMS rule.

The measured lateral specific force is low-passed, and its magnitude compared with a threshold. The
RRMS rule (`rrms`) sees a turn late, after a share of its window, but not a rough road; the
threshold sees the turn at once.
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from road_envs.core.config import NonNegative, Positive, Settings
from road_envs.policies.api import PolicyContext
from road_envs.policies.fixed import Mode
from road_envs.policies.rrms import RunningRmsPolicy


class _LateralTrigger:
    """Whether the low-passed lateral force exceeds `threshold` [m/s²], or did `hold` [s] ago."""

    def __init__(self, context: PolicyContext, threshold: float, lag: float, hold: float):
        self.context, self.threshold = context, threshold
        self.decay, self.hold = np.exp(-context.interval / lag), round(hold / context.interval)
        self.a_y = np.zeros(context.n_vehicles)
        self.remaining = np.zeros(context.n_vehicles, dtype=int)

    def update(self, observations: np.ndarray) -> np.ndarray:
        """Advance by one interval; return which vehicles (N,) are in a turn."""
        measured = self.context.signal("planar", observations)[:, 1]
        self.a_y = self.decay * self.a_y + (1.0 - self.decay) * measured
        above = np.abs(self.a_y) > self.threshold
        self.remaining = np.where(above, self.hold + 1, np.maximum(self.remaining - 1, 0))
        return self.remaining > 0


@dataclass(kw_only=True)
class LateralThreshold(Settings):
    """Policy with the state `firm` on both axles while the car turns, else ride.

    Needs the observation group "planar".
    """

    threshold: Annotated[Positive, "m/s²", "of the lateral specific force"] = 0.5
    lag: Annotated[Positive, "s", "time constant of its low-pass"] = 0.05
    hold: Annotated[NonNegative, "s", "how long the firm state stays after the turn"] = 0.0
    firm: Mode = "stiff_low"
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Reset the low-pass."""
        self.context = context
        self.trigger = _LateralTrigger(context, self.threshold, self.lag, self.hold)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,) of ride or the firm state."""
        firm = np.repeat(self.trigger.update(observations)[:, None], 2, axis=1)
        return self.context.switch_axles(firm, "ride", self.firm)


@dataclass(kw_only=True)
class RrmsLateral(RunningRmsPolicy):
    """Policy that is firm by the RRMS rule or by the lateral threshold."""

    threshold: Annotated[Positive, "m/s²", "of the lateral specific force"] = 0.5
    lag: Annotated[Positive, "s", "time constant of its low-pass"] = 0.05
    hold: Annotated[NonNegative, "s", "how long the firm state stays after the turn"] = 0.0

    def reset(self, context: PolicyContext) -> None:
        """Reset the running RMS and the low-pass."""
        super().reset(context)
        self.trigger = _LateralTrigger(context, self.threshold, self.lag, self.hold)

    def firm_axles(self, observations: np.ndarray) -> np.ndarray:
        """Return which axles (N, 2) are firm."""
        turning = self.trigger.update(observations)
        return super().firm_axles(observations) | turning[:, None]
