"""Acceleration-driven damping (Savaresi, Silani & Bittanti, J. Dyn. Syst. Meas. Control 127, 2005).

The damping is high while the damper force opposes the acceleration of the body.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.policies.two_state import TwoStateDamper


@dataclass(kw_only=True)
class AccelerationDriven(TwoStateDamper):
    """Policy with high damping where a e' > 0."""

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """Return the product a e'."""
        return a * e_dot
