"""Sine sweep: a road with a sine of changing wavelength, for the response of the vehicle.

    z(s) = A(s) sin(phi(s))      phi' = 2 pi n(s)

Over the length L of the road, the spatial frequency n goes from n_start to n_end linearly in s
("linear") or with a constant number of octaves per metre ("logarithmic"):

    linear        phi = 2 pi (n_start s + (n_end - n_start) s² / (2 L))
    logarithmic   phi = 2 pi n_start L / b (e^(b s / L) - 1),     b = ln(n_end / n_start)

The amplitude changes geometrically from `amplitude` to `amplitude_end`; a logarithmic sweep with
amplitude_end = amplitude n_start / n_end has a constant maximum slope. A raised-cosine `taper` at
both ends joins the sine to the level road. With n_start = n_end the road is a plain sine: a
washboard, or a twist course if the wheel paths are in antiphase.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from road_envs.core.config import NonNegative, Positive, Settings
from road_envs.roads.surface import DEFAULT_LENGTH, RoadLength, SampleSpacing, Surface, check_size

SIGNS = {"in_phase": (1, 1), "antiphase": (1, -1), "left": (1, 0), "right": (0, 1)}
"""Factors of the sine on the left and the right wheel path."""


@dataclass(frozen=True, kw_only=True)
class SineSweep(Settings):
    """A sine with a changing spatial frequency and amplitude."""

    length: RoadLength = DEFAULT_LENGTH
    n_start: Annotated[Positive, "cycles/m", "spatial frequency at the start"]
    n_end: Annotated[Positive, "cycles/m", "spatial frequency at the end"]
    progress: Annotated[Literal["linear", "logarithmic"], "", "of the frequency"] = "logarithmic"
    amplitude: Annotated[Positive, "m", "at the start"]
    amplitude_end: Annotated[Positive, "m", "at the end"]
    paths: Annotated[
        Literal["in_phase", "antiphase", "left", "right"], "", "wheel paths and their phase"
    ] = "in_phase"
    taper: Annotated[NonNegative, "m", "length of the taper at either end"] = 2.0
    ds: SampleSpacing = 0.01

    def __post_init__(self):
        super().__post_init__()
        check_size(self.length, self.ds)
        if not 2.0 * self.taper <= self.length:
            raise ValueError(
                f"two tapers of {self.taper} m do not fit into a length of {self.length} m"
            )
        if not max(self.n_start, self.n_end) * 8 * self.ds <= 1.0:
            raise ValueError(
                f"n_start and n_end must be at most 1 / (8 ds) = {1.0 / (8 * self.ds):g} cycles/m, "
                f"got {self.n_start} and {self.n_end}"
            )

    def realise(self, rng: np.random.Generator) -> Surface:
        z = self.height(self.ds * np.arange(round(self.length / self.ds) + 1))
        return Surface(np.outer(SIGNS[self.paths], z), self.ds, name="sine sweep")

    def height(self, s: np.ndarray) -> np.ndarray:
        """Return the height [m] of the sine at stations `s` [m] in [0, length], of any shape."""
        envelope = self.amplitude * (self.amplitude_end / self.amplitude) ** (s / self.length)
        taper = 1.0
        if self.taper > 0.0:
            inside = np.clip(np.minimum(s, self.length - s) / self.taper, 0.0, 1.0)
            taper = 0.5 - 0.5 * np.cos(np.pi * inside)
        b = np.log(self.n_end / self.n_start)
        if b == 0.0:
            cycles = self.n_start * s
        elif self.progress == "linear":
            cycles = self.n_start * s + (self.n_end - self.n_start) * s**2 / (2.0 * self.length)
        else:
            cycles = self.n_start * self.length / b * np.expm1(b * s / self.length)
        return envelope * taper * np.sin(2.0 * np.pi * cycles)
