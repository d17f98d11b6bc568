"""SH-ADD (Savaresi & Spelta, J. Dyn. Syst. Meas. Control 129, 2007): skyhook at low frequencies,
acceleration-driven damping at high ones; a² - alpha² v² tells which it is.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.policies.two_state import TwoStateDamper


@dataclass(kw_only=True)
class SkyhookAdd(TwoStateDamper):
    """Crosses over at `crossover` [Hz], alpha = 2 pi crossover."""

    crossover: float = 1.9

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """Here v e' where a² <= alpha² v², else a e' / alpha, as velocities both."""
        alpha = 2.0 * np.pi * self.crossover
        return np.where(np.abs(a) <= alpha * np.abs(v), v, a / alpha) * e_dot
