"""Belgian paving: a random road whose PSD has a peak at the spacing of its cobbles.

    base   G_d0 (n / n0)^-w, steeper (w_above) beyond n_above
    peak   a Gaussian of width n_sigma at n_cobble; base and peak together are `peak` times the base

Slope of the base, peak and coherence of the wheel paths (0.22 at the peak, nearly 0 from 2.3 to 4
cycles/m, isotropic below) are those of the measured cobbles in the OpenCRG sample
`belgian_block.crg`. The level follows the paving of Ngwangwa et al., section 3.2: class D from 0.2
to 3 cycles/m, classes C to A above, and a peak at 6 cycles/m.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy
from pydantic import Field

from road_envs.core.config import Finite, NonNegative, Positive
from road_envs.records.roughness import N_0, root_coherence
from road_envs.roads.iso8608 import SpectralRoad, power_law
from road_envs.roads.surface import Surface


@dataclass(frozen=True, kw_only=True)
class Belgian(SpectralRoad):
    """A random paving similar to the paper's."""

    G_d0: Annotated[Positive, "m³", "base at n0; centre of class D at 0.77 cycles/m"] = 0.00139
    w: Annotated[Positive, "", "waviness of the base"] = 2.15
    n_above: Annotated[Positive, "cycles/m", "frequency beyond which the base is steeper"] = 3.0
    w_above: Annotated[Positive, "", "waviness of the base beyond n_above"] = 5.0
    n_cobble: Annotated[Positive, "cycles/m", "cobbles per metre"] = 5.9
    n_sigma: Annotated[Positive, "cycles/m", "standard deviation of the peak"] = 0.29
    peak: Annotated[Finite, Field(gt=1), "", "density at n_cobble over that of the base"] = 6.0
    coherence: Annotated[NonNegative, "", "coherence (squared) of the paths at n_cobble"] = 0.22
    n_min: Annotated[Positive, "cycles/m", "lower end of the band [assumed]"] = 0.05

    def __post_init__(self):
        super().__post_init__()
        if self._cobble_coherence > 1.0:
            limit = (1.0 - 1.0 / self.peak) ** 2
            raise ValueError(f"coherence must be within 0 and {limit:.3g}, got {self.coherence}")

    @property
    def _cobble_coherence(self) -> float:
        """Root coherence of the peak alone, taking the base at n_cobble as incoherent."""
        return np.sqrt(self.coherence) / (1.0 - 1.0 / self.peak)

    def realise(self, rng: np.random.Generator) -> Surface:
        edges = self._cell_edges()
        n = 0.5 * (edges[1:] + edges[:-1])
        base, cobbles = self._base(edges), self._cobbles(edges)
        power = base + cobbles
        shared = root_coherence(n, self.w, self.track) * base + self._cobble_coherence * cobbles
        g = shared / np.where(power > 0.0, power, 1.0)  # the last cell can have no width
        return self._synthesise(rng, power, g, "belgian")

    def _base(self, edges: np.ndarray) -> np.ndarray:
        """Return the power [m²] of the base in each cell between `edges`."""
        low, high = np.minimum(edges, self.n_above), np.maximum(edges, self.n_above)
        above = self.G_d0 * (self.n_above / N_0) ** (self.w_above - self.w)
        return power_law(low, self.G_d0, self.w) + power_law(high, above, self.w_above)

    def _cobbles(self, edges: np.ndarray) -> np.ndarray:
        """Return the power [m²] of the peak in each cell between `edges`."""
        tiny = self.n_cobble * np.array([1.0 - 1e-6, 1.0 + 1e-6])
        top = (self.peak - 1.0) * self._base(tiny) / np.diff(tiny)
        x = (edges - self.n_cobble) / self.n_sigma
        return top * self.n_sigma * np.sqrt(2.0 * np.pi) * np.diff(scipy.special.ndtr(x))
