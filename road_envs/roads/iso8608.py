"""Random road with the one-sided displacement PSD of ISO 8608:2016

    G_d(n) = G_d(n0) (n / n0)^-w      n0 = 0.1 cycles/m

It is a sum of cosines with random phases. The spectral line of a cell [n - dn/2, n + dn/2] has the
integral of G_d over the cell, so that the expected variance is that of the band for any spacing.
The lines are closer than 1/length, so that the road is not periodic in its length.

The two wheel paths, `track` apart, are the sum and the difference of two independent roads with the
densities (1 ± g) G_d / 2. Each path then has the density G_d, their cross-spectrum is g G_d and
their coherence g²; `roughness.root_coherence` gives g of an isotropic surface.

With a `variation` the lines are correlated: they are the Fourier transform of white noise whose
variance follows the roughness along the road.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from road_envs.core.config import Finite, Positive, Settings
from road_envs.records.roughness import CLASSES, N_0, TRACK, TrackWidth, root_coherence
from road_envs.roads.surface import DEFAULT_LENGTH, RoadLength, SampleSpacing, Surface, check_size

RoadClass = Literal["A", "B", "C", "D", "E", "F", "G", "H"]


@dataclass(frozen=True, kw_only=True)
class RoughnessVariation(Settings):
    """Distribution of a patch's roughness coefficient relative to that of the road, their mean.

    Both wheel paths share it. With a gamma distribution this is the Laplace road of Bogsjö,
    Podgórski & Rychlik (Veh. Syst. Dyn. 50, 2012) with the ISO spectrum and two paths (Johannesson,
    Podgórski & Rychlik, Chalmers preprint 2014:4), where the square of `spread` is called nu. A
    log-normal one has the same mean and variance, but more very rough patches.

    It applies to the white noise that is filtered into the road, which has no steps between
    patches: waves much shorter than a patch have the density of the patch, longer ones an average
    over neighbouring patches. Over all patches, short waves have the kurtosis 3 (1 + spread²).
    """

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


@dataclass(frozen=True, kw_only=True)
class SpectralRoad(Settings):
    """A road that is a sum of cosines within a band, both wheel paths on one grid."""

    length: RoadLength = DEFAULT_LENGTH
    n_min: Annotated[Positive, "cycles/m", "lower end of the band"] = 0.01
    n_max: Annotated[Positive, "cycles/m", "upper end of the band"] = 10.0
    track: TrackWidth = TRACK
    ds: SampleSpacing = 0.01

    def __post_init__(self):
        super().__post_init__()
        check_size(self._period, self.ds, "period (twice the length, or more for long waves)")
        if self.length < 4.0 * self.ds:
            raise ValueError(
                f"length must be at least 4 ds = {4.0 * self.ds:g} m, got {self.length} m"
            )
        if not self.n_min < self.n_max <= 0.5 / self.ds:
            raise ValueError(
                f"the band must satisfy n_min < n_max <= 1 / (2 ds) = {0.5 / self.ds:g} cycles/m, "
                f"got n_min = {self.n_min}, n_max = {self.n_max}"
            )

    @property
    def _period(self) -> float:
        """Period [m]: at least two road lengths and eight of the longest waves."""
        return max(2.0 * self.length, 8 / self.n_min)

    def _spectral_lines(self) -> tuple[int, int, int]:
        """Return the samples per period and the indices of the first and last spectral line."""
        size = _smooth_number(int(np.ceil(self._period / self.ds)))
        last = min(round(self.n_max * size * self.ds), (size - 1) // 2)
        return size, round(self.n_min * size * self.ds), last

    def _cell_edges(self) -> np.ndarray:
        """Return the edges (K + 1,) [cycles/m] of the spectral cells within [n_min, n_max]."""
        size, first, last = self._spectral_lines()
        edges = (np.arange(first, last + 2) - 0.5) / (size * self.ds)
        edges[0], edges[-1] = self.n_min, self.n_max
        return edges

    def _synthesise(
        self, rng, power, g, name: str, variation: RoughnessVariation | None = None
    ) -> Surface:
        """Draw both wheel paths from `power` (K,) [m²] and root coherence `g` (K,) of the lines.

        Each path starts at height 0: the datum of a road has no effect on the vehicle.
        """
        size, first, last = self._spectral_lines()
        if variation is None:
            unit = np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, (2, power.size)))
        else:
            level = variation.draw(rng, size, self.ds)
            noise = np.sqrt(level / size) * rng.standard_normal((2, size))
            unit = np.fft.rfft(noise)[:, first : last + 1]
        parts = np.sqrt(power * np.array([1.0 + g, 1.0 - g])) * unit
        lines = np.zeros((2, size // 2 + 1), dtype=complex)
        lines[:, first : last + 1] = [parts[0] + parts[1], parts[0] - parts[1]]
        z = 0.5 * size * np.fft.irfft(lines, size)[:, : round(self.length / self.ds) + 1]
        return Surface(z - z[:, :1], self.ds, name=name)


@dataclass(frozen=True, kw_only=True)
class Iso8608(SpectralRoad):
    """A Gaussian road, stationary without a `variation`; give either `road_class` or `G_d0`."""

    road_class: Annotated[RoadClass | None, "", "ISO class, taken at its geometric mean"] = None
    G_d0: Annotated[Positive | None, "m³", "displacement PSD at n0"] = None
    w: Annotated[Positive, "", "waviness"] = 2.0
    coherence: Annotated[Literal["isotropic", "full", "none"], "", "between the wheel paths"] = (
        "isotropic"
    )
    variation: Annotated[RoughnessVariation | None, "", "of the roughness along the road"] = None

    def __post_init__(self):
        super().__post_init__()
        if (self.road_class is None) == (self.G_d0 is None):
            raise ValueError(
                f"give exactly one of road_class and G_d0, got {self.road_class} and {self.G_d0}"
            )

    @property
    def density(self) -> float:
        """G_d(n0) [m³] as given, or of the class."""
        return CLASSES[self.road_class] if self.road_class else float(self.G_d0 or 0.0)

    def realise(self, rng: np.random.Generator) -> Surface:
        name = f"iso8608 {self.road_class or f'G_d0={self.G_d0:g}'}"
        return self._synthesise(rng, *_cell_spectra(self), name, self.variation)


@lru_cache(maxsize=16)
def _cell_spectra(road: Iso8608) -> tuple[np.ndarray, np.ndarray]:
    """Power and root coherence of the cells, which all realisations of a road share."""
    edges = road._cell_edges()
    power = power_law(edges, road.density, road.w)
    g = np.full(power.size, 1.0 if road.coherence == "full" else 0.0)
    if road.coherence == "isotropic":
        g = root_coherence(0.5 * (edges[1:] + edges[:-1]), road.w, road.track)
    for array in (power, g):
        array.flags.writeable = False
    return power, g


def power_law(edges: np.ndarray, G_d0: float, w: float) -> np.ndarray:
    """Return the integrals (K,) [m²] of G_d0 (n / n0)^-w between `edges` (K + 1,) [cycles/m]."""
    if w == 1.0:
        return G_d0 * N_0 * np.diff(np.log(edges))
    return G_d0 * N_0 * np.diff((edges / N_0) ** (1.0 - w)) / (1.0 - w)


def _smooth_number(least: int) -> int:
    """`scipy.fft.next_fast_len`, an import of which takes a sixth of the time to a first step."""
    odd = (3**i * 5**j for i in range(least.bit_length()) for j in range(least.bit_length()))
    return min(factor << (-(-least // factor) - 1).bit_length() for factor in odd)
