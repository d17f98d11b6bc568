"""Acceleration-driven damping (Savaresi, Silani & Bittanti, J. Dyn. Syst. Meas. Control 127, 2005):
firm while the damper's force is against the body's acceleration.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.policies.two_state import TwoStateDamper


@dataclass(kw_only=True)
class AccelerationDriven(TwoStateDamper):
    """Firm where a e' > 0."""

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """The product a e'."""
        return a * e_dot
