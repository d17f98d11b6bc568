"""Groundhook, on and off (Valasek, Novak, Sika & Vaculin, Vehicle Syst. Dyn. 28, 1997): firm while
the damper slows the wheel down.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.policies.two_state import TwoStateDamper


@dataclass(kw_only=True)
class Groundhook(TwoStateDamper):
    """Firm where (v - e') e' < 0: a strut that extends pushes up a wheel that falls."""

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """-(v - e') e', v - e' being the axle's velocity under the strut."""
        return (e_dot - v) * e_dot
