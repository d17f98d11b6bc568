"""Firm states in turns: by the running RMS, by a threshold of lateral acceleration, by either.

The running-RMS rule (RRMS) compares lateral with vertical acceleration: Els, "The ride comfort vs.
handling compromise for off-road vehicles", thesis, Pretoria 2006. It sees a turn late, after a
share of its window, but not a rough road; the threshold sees the turn at once.
"""

import abc
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from road_envs.core.config import NonNegative, Positive, Settings
from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator, RunningRms
from road_envs.policies.fixed import Mode


@dataclass(kw_only=True)
class _FirmInTurns(Settings, abc.ABC):
    """Policy with the state `firm` on both axles in a turn, else ride; it observes "planar"."""

    firm: Annotated[Mode, "", "state of both axles in a turn"] = "handling"
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        self.context = context

    def act(self, observations: np.ndarray) -> np.ndarray:
        firm = np.repeat(self.turning(observations)[:, None], 2, axis=1)
        return self.context.switch_axles(firm, "ride", self.firm)

    @abc.abstractmethod
    def turning(self, observations: np.ndarray) -> np.ndarray:
        """Advance by one interval; return which vehicles (N,) are in a turn."""


@dataclass(kw_only=True)
class RunningRmsPolicy(_FirmInTurns):
    """Policy that is firm while the lateral RMS exceeds `ratio` times the RMS of heave."""

    window: Annotated[Positive, "s", "window of both RMS"] = 1.0
    ratio: Annotated[Positive, "", "lateral RMS over the RMS of heave"] = 1.0

    def reset(self, context: PolicyContext) -> None:
        super().reset(context)
        self.body = BodyMotionEstimator(context, leak=1.0)
        self.lateral, self.vertical = (RunningRms(context, self.window) for _ in range(2))

    def turning(self, observations: np.ndarray) -> np.ndarray:
        samples = self.context.accelerations(observations).transpose(0, 2, 1)
        vertical = self.vertical.add(samples @ self.body.sensors_to_motion[0])
        lateral = self.lateral.add(self.context.signal("planar", observations)[:, 1])
        return lateral > self.ratio * vertical


@dataclass(kw_only=True)
class LateralThreshold(_FirmInTurns):
    """Policy that is firm while the low-passed lateral force is large, or was `hold` ago."""

    threshold: Annotated[Positive, "m/s²", "of the lateral specific force"] = 0.5
    lag: Annotated[Positive, "s", "time constant of its low-pass"] = 0.05
    hold: Annotated[NonNegative, "s", "how long the firm state stays after the turn"] = 0.0

    def reset(self, context: PolicyContext) -> None:
        super().reset(context)
        self.a_y = np.zeros(context.n_vehicles)
        self.remaining = np.zeros(context.n_vehicles, dtype=int)

    def turning(self, observations: np.ndarray) -> np.ndarray:
        decay = np.exp(-self.context.interval / self.lag)
        measured = self.context.signal("planar", observations)[:, 1]
        self.a_y = decay * self.a_y + (1.0 - decay) * measured
        hold = round(self.hold / self.context.interval)
        above = np.abs(self.a_y) > self.threshold
        self.remaining = np.where(above, hold + 1, np.maximum(self.remaining - 1, 0))
        return self.remaining > 0


@dataclass(kw_only=True)
class RrmsLateral(RunningRmsPolicy, LateralThreshold):
    """Policy that is firm by the RRMS rule or by the lateral threshold."""

    def turning(self, observations: np.ndarray) -> np.ndarray:
        return LateralThreshold.turning(self, observations) | super().turning(observations)
