"""SH-ADD damping (Savaresi & Spelta, J. Dyn. Syst. Meas. Control 129, 2007).

Skyhook at low frequencies and acceleration-driven damping at high ones; the sign of
a² - alpha² v² selects between them.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.policies.two_state import TwoStateDamper


@dataclass(kw_only=True)
class SkyhookAdd(TwoStateDamper):
    """Policy with the crossover frequency `crossover` [Hz], alpha = 2 pi crossover."""

    crossover: float = 1.9

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """Return v e' where a² <= alpha² v², else a e' / alpha, both in (m/s)²."""
        alpha = 2.0 * np.pi * self.crossover
        return np.where(np.abs(a) <= alpha * np.abs(v), v, a / alpha) * e_dot
