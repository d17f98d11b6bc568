"""On-off groundhook damping (Valasek, Novak, Sika & Vaculin, Vehicle Syst. Dyn. 28, 1997).

The damping is high while the damper decelerates the wheel.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.policies.two_state import TwoStateDamper


@dataclass(kw_only=True)
class Groundhook(TwoStateDamper):
    """Policy with high damping where (v - e') e' < 0: an extending strut lifts a falling wheel."""

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """Return -(v - e') e', where v - e' is the velocity of the axle under the strut."""
        return (e_dot - v) * e_dot
