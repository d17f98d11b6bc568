"""Policies with two damper states, chosen axle by axle from an on-off control law.

The law gives a value for each strut from the velocity v of the body above it, integrated from the
accelerometers, its acceleration a (positive upwards) and the measured rate of extension e'. An axle
is in the high state while the sum over its two struts is positive.
"""

import abc
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from road_envs.core.config import Positive, Settings
from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator


@dataclass(kw_only=True)
class _TwoStateDamper(Settings, abc.ABC):
    """Policy with state `high` where the law is positive, else ride; it observes "struts". `bias`
    shifts the threshold by a share of the running mean magnitude of the sum; a positive one makes
    `high` more frequent.
    """

    high: Literal["handling", "soft_high"] = "soft_high"
    leak: Annotated[Positive, "Hz", "corner of the integration of body rates"] = 0.2
    bias: float = 0.0
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        self.context, self.body = context, BodyMotionEstimator(context, self.leak)
        self.mean_magnitude = np.zeros((context.n_vehicles, 2))
        self.decay = np.exp(-context.interval)  # time constant of 1 s

    def act(self, observations: np.ndarray) -> np.ndarray:
        self.body.update(observations)
        v, a = self.body.at_strut_mounts(self.body.v), self.body.at_strut_mounts(self.body.a)
        work = self.law(v, a, self.context.signal("extension_rate", observations).astype(float))
        axles = work.reshape(-1, 2, 2).sum(axis=2)
        self.mean_magnitude = self.decay * self.mean_magnitude + (1.0 - self.decay) * np.abs(axles)
        firm = axles + self.bias * self.mean_magnitude > 0
        return self.context.switch_axles(firm, "ride", self.high)

    @abc.abstractmethod
    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """Return a value for each strut (N, 4) from v [m/s], a [m/s²] and e' [m/s], all (N, 4)."""


@dataclass(kw_only=True)
class Skyhook(_TwoStateDamper):
    """Policy with high damping where v e' > 0: an extending strut pulls down a rising body.
    Karnopp, Crosby & Harwood, J. Eng. Ind. 96, 1974.
    """

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        return v * e_dot


@dataclass(kw_only=True)
class Groundhook(_TwoStateDamper):
    """Policy with high damping where (v - e') e' < 0: an extending strut lifts a falling wheel.
    Valasek, Novak, Sika & Vaculin, Vehicle Syst. Dyn. 28, 1997.
    """

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        return (e_dot - v) * e_dot


@dataclass(kw_only=True)
class AccelerationDriven(_TwoStateDamper):
    """Policy with high damping where a e' > 0: the damper force opposes the acceleration. Savaresi,
    Silani & Bittanti, J. Dyn. Syst. Meas. Control 127, 2005.
    """

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        return a * e_dot


@dataclass(kw_only=True)
class SkyhookAdd(_TwoStateDamper):
    """Policy of skyhook at low frequencies and acceleration-driven damping at high ones. They cross
    over at `crossover` [Hz], alpha = 2 pi crossover: Savaresi & Spelta, J. Dyn. Syst. Meas. Control
    129, 2007.
    """

    crossover: float = 1.9

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        alpha = 2.0 * np.pi * self.crossover
        return np.where(np.abs(a) <= alpha * np.abs(v), v, a / alpha) * e_dot
