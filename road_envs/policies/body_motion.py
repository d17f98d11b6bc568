"""Signals that policies derive from the instruments, for many vehicles at once.

Three or more vertical accelerometers on a rigid body determine its heave, roll and pitch
acceleration. Leaky integration gives the rates, dv/dt = a - v / tau with 1 / tau = 2 pi `leak`;
frequencies below `leak` [Hz] are attenuated. Policies decide once per control interval, so means
over it suffice.
"""

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.policies.api import PolicyContext

MIN_LEVER = 0.1  # least singular value of the sensors' levers [m]: with less, noise hides rotations


class BodyMotionEstimator:
    """Estimator of the body's motion by leaky integration with corner `leak` [Hz]: accelerations
    `a` (N, 3) [m/s², rad/s²] and rates `v` (N, 3) [m/s, rad/s] of heave, roll and pitch.
    """

    def __init__(self, context: PolicyContext, leak: float):
        places = context.instruments.locations(context.car)
        self.context, self.decay = context, np.exp(-2.0 * np.pi * leak * context.interval)
        self.on_body = [i for i, place in enumerate(places.values()) if place.axle is None]
        rows = np.array([[1.0, place.y, -place.x] for place in places.values()])[self.on_body]
        if np.linalg.matrix_rank(rows, tol=MIN_LEVER) < 3:
            raise ConfigError(
                "this policy needs three accelerometers on the body that are not in one line, to "
                f"resolve heave, roll and pitch; there are {', '.join(places)}"
            )
        self.sensors_to_motion = np.linalg.inv(rows) if len(rows) == 3 else np.linalg.pinv(rows)
        mounts = [[1.0, y, -a.x] for a in context.car.axles for y in (a.y_s, -a.y_s)]
        self.motion_to_mounts = np.array(mounts)
        self.a, self.v = np.zeros((2, context.n_vehicles, 3))

    def update(self, observations: np.ndarray) -> None:
        """Advance by one interval, from observations (N, d)."""
        means = self.context.accelerations(observations)[:, self.on_body].mean(axis=2)
        self.a = means @ self.sensors_to_motion.T
        self.v = self.decay * (self.v + self.context.interval * self.a)

    def at_strut_mounts(self, motion: np.ndarray) -> np.ndarray:
        """Return a `motion` (N, 3) of the body as vertical motion (N, 4) above the struts."""
        return motion @ self.motion_to_mounts.T

    def reset(self, mask: np.ndarray) -> None:
        """Reset the vehicles in `mask` (N,)."""
        self.v[mask] = 0.0


class RunningRms:
    """Root mean square over a sliding `window` [s]; values before the drive count as 0."""

    def __init__(self, context: PolicyContext, window: float):
        size = max(1, round(window / context.interval))
        self.squares, self.at = np.zeros((size, context.n_vehicles)), 0

    def add(self, x: np.ndarray) -> np.ndarray:
        """Add values `x` (N,) or (N, k), and return the RMS (N,) of the window that ends here."""
        square = np.square(x) if x.ndim == 1 else np.mean(np.square(x), axis=1)
        self.squares[self.at % len(self.squares)] = square
        self.at += 1
        return np.sqrt(self.squares.mean(axis=0))

    def reset(self, mask: np.ndarray) -> None:
        self.squares[:, mask] = 0.0
