"""Skyhook, on and off (Karnopp, Crosby & Harwood, J. Eng. Ind. 96, 1974): firm while the damper
slows the body down.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.policies.two_state import TwoStateDamper


@dataclass(kw_only=True)
class Skyhook(TwoStateDamper):
    """Firm where v e' > 0: a strut that extends pulls down a body that rises."""

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """The product v e'."""
        return v * e_dot
