"""On-off skyhook damping (Karnopp, Crosby & Harwood, J. Eng. Ind. 96, 1974).

The damping is high while the damper decelerates the body.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.policies.two_state import TwoStateDamper


@dataclass(kw_only=True)
class Skyhook(TwoStateDamper):
    """Policy with high damping where v e' > 0: an extending strut pulls down a rising body."""

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """Return the product v e'."""
        return v * e_dot
