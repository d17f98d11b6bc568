"""Random variation of the roughness along a road, for nonstationary roads.

The roughness coefficient is constant within a patch and random from patch to patch. Both wheel
paths share it, and its mean is the roughness coefficient of the road. With a gamma distribution
this is the Laplace road of Bogsjö, Podgórski & Rychlik (Veh. Syst. Dyn. 50, 2012) with the ISO
spectrum and two paths (Johannesson, Podgórski & Rychlik, Chalmers preprint 2014:4), where the
square of `spread` is called nu. A log-normal distribution has the same mean and variance, but more
very rough patches.

The variation applies to the white noise that is filtered into the road, so the road has no steps
between patches: waves much shorter than a patch have the density of the patch, longer ones an
average over neighbouring patches. Over all patches, short waves have the kurtosis 3 (1 + spread²).
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from road_envs.core.config import Finite, Settings


@dataclass(frozen=True, kw_only=True)
class RoughnessVariation(Settings):
    """Distribution of a patch's roughness coefficient relative to that of the road."""

    law: Annotated[Literal["gamma", "lognormal"], "", "distribution"] = "gamma"
    spread: Annotated[float, Field(gt=0, le=10), "", "coefficient of variation [assumed]"] = 0.7
    patch: Annotated[
        Finite, Field(ge=1), "m", "length of a patch; the first may start before the road"
    ] = 100.0

    def draw(self, rng: np.random.Generator, size: int, ds: float) -> np.ndarray:
        """Draw the factor (size,) on the density at samples with the spacing `ds` [m]."""
        start = rng.uniform(0.0, self.patch)
        k = ((start + ds * np.arange(size)) // self.patch).astype(int)
        variance = self.spread**2
        if self.law == "gamma":
            levels = rng.gamma(1.0 / variance, variance, k[-1] + 1)
        else:
            sigma = np.sqrt(np.log1p(variance))
            levels = rng.lognormal(-0.5 * sigma**2, sigma, k[-1] + 1)
        return levels[k]
