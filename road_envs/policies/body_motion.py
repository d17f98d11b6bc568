"""What policies make of the instruments, for many cars at once: motion of the body, running RMS.

Three vertical accelerometers on a rigid body are its heave, roll and pitch acceleration. Rates come
from them by leaky integration, dv/dt = a - v / tau, 1 / tau = 2 pi `leak`: below the leak [Hz] they
say nothing. Decisions are taken once in a control interval, so means over it are enough.
"""

import numpy as np

from road_envs.policies.api import PolicyContext

SIDE_SIGNS = np.array([1.0, -1.0, 1.0, -1.0])


class BodyMotionEstimator:
    """Accelerations `a` [m/s², rad/s²] and rates `v` (N, 3) of heave, roll and pitch."""

    def __init__(self, context: PolicyContext, leak: float):
        locations = context.instruments.locations(context.car).values()
        self.context, self.decay = context, np.exp(-2.0 * np.pi * leak * context.interval)
        self.sensors_to_motion = np.linalg.inv([[1.0, y, -x] for x, y in locations])
        axles = [axle for axle in context.car.axles for _ in range(2)]
        self.motion_to_mounts = np.array(
            [[1.0, side * a.y_s, -a.x] for a, side in zip(axles, SIDE_SIGNS, strict=True)]
        )
        self.a, self.v = np.zeros((2, context.n_vehicles, 3))

    def update(self, observations: np.ndarray) -> None:
        """Go on by one interval, from observations (N, d)."""
        self.a = self.context.accelerations(observations).mean(axis=2) @ self.sensors_to_motion.T
        self.v = self.decay * (self.v + self.context.interval * self.a)

    def at_strut_mounts(self, motion: np.ndarray) -> np.ndarray:
        """A `motion` (N, 3) of the body as vertical motion (N, 4) above the struts."""
        return motion @ self.motion_to_mounts.T

    def reset(self, mask: np.ndarray) -> None:
        """Forget the cars in `mask` (N,)."""
        self.v[mask] = 0.0


class RunningRms:
    """Root of the mean square (N,) over a `window` [s]; what came before the drive counts as 0."""

    def __init__(self, context: PolicyContext, window: float):
        size = max(1, round(window / context.interval))
        self.squares, self.at = np.zeros((size, context.n_vehicles)), 0

    def add(self, x: np.ndarray) -> np.ndarray:
        """RMS (N,) of the window that ends with values `x` (N,) or (N, k)."""
        square = np.square(x) if x.ndim == 1 else np.mean(np.square(x), axis=1)
        self.squares[self.at % len(self.squares)] = square
        self.at += 1
        return np.sqrt(self.squares.mean(axis=0))

    def reset(self, mask: np.ndarray) -> None:
        """Forget the cars in `mask` (N,)."""
        self.squares[:, mask] = 0.0


def roll_from_extensions(context: PolicyContext, observations: np.ndarray) -> np.ndarray:
    """Roll (N,) [rad] of the body over its axles, the mean of both, from the struts' extensions."""
    e = context.signal("extension", observations)
    front, rear = context.car.axles
    return 0.25 * ((e[:, 0] - e[:, 1]) / front.y_s + (e[:, 2] - e[:, 3]) / rear.y_s)
