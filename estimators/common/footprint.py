"""Enveloping of the road by tyres: the mean over the contact length, on the nodes of the road.

The weights of a node are the overlap of its cell with a uniform contact, as long as gives them the
second moment L² / 12 of the contact length L. A wave of spatial frequency n is then scaled by
sin(pi n L) / (pi n L) up to terms of the order (n L)^4 (`road_envs.roads.surface.enveloped`).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.ndimage import convolve1d
from scipy.optimize import brentq


@dataclass(frozen=True, eq=False)
class Footprint:
    """Moving average of coefficients (2, K) by symmetric `weights` (2 m + 1,); level ends."""

    weights: np.ndarray

    @classmethod
    @cache
    def of(cls, contact_length: float, ds: float) -> "Footprint":
        """Return the footprint of a `contact_length` [m] on nodes `ds` [m] apart."""
        variance = (contact_length / ds) ** 2 / 12.0
        if variance == 0.0:
            return cls(np.ones(1))

        def excess(half: float) -> float:
            cell, weights = _overlaps(half)
            return float(weights @ cell**2) - variance

        return cls(_overlaps(brentq(excess, 0.5, contact_length / ds + 1.0))[1])

    def apply(self, c: np.ndarray) -> np.ndarray:
        """Return the enveloped coefficients."""
        if self.weights.size == 1:
            return c
        return np.asarray(convolve1d(c, self.weights, axis=1, mode="nearest"))

    def apply_transpose(self, c: np.ndarray) -> np.ndarray:
        """Apply the transpose of `apply`."""
        m = self.weights.size // 2
        if m == 0:
            return c
        wide = convolve1d(np.pad(c, ((0, 0), (m, m))), self.weights, axis=1, mode="constant")
        out = np.array(wide[:, m:-m])
        out[:, 0] += wide[:, :m].sum(axis=1)
        out[:, -1] += wide[:, -m:].sum(axis=1)
        return out


def _overlaps(half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return cells (2 m + 1,) and their shares of a contact from -`half` to `half` [nodes]."""
    m = int(np.ceil(half - 0.5))
    cell = np.arange(-m, m + 1)
    overlap = np.minimum(cell + 0.5, half) - np.maximum(cell - 0.5, -half)
    return cell, overlap / (2.0 * half)
