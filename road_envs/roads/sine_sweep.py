"""A sine whose waves grow shorter or longer along the road: how the vehicle answers each of them.

    z(s) = A(s) sin(phi(s))      phi' = 2 pi n(s)

over the length L of the road. The spatial frequency n goes from n_start to n_end evenly in s
("linear") or in its logarithm ("logarithmic", as many octaves a metre everywhere):

    linear        phi = 2 pi (n_start s + (n_end - n_start) s² / (2 L))
    logarithmic   phi = 2 pi n_start L / b (e^(b s / L) - 1),     b = ln(n_end / n_start)

and the amplitude goes geometrically from `amplitude` to `amplitude_end`: a logarithmic sweep with
amplitude_end = amplitude n_start / n_end has the same greatest slope everywhere. Over a `taper`
at both ends the sine rises out of, and returns to, the level road in half a cosine. With
n_start = n_end it is a plain sine: a washboard, or with the wheel paths in antiphase a twist.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from road_envs.config import STRICT
from road_envs.roads.surface import Surface
from road_envs.roads.validation import check_not_negative, check_positive, check_size

PathSigns = Literal["in_phase", "antiphase", "left", "right"]
SIGNS: dict[PathSigns, tuple[float, float]] = {
    "in_phase": (1.0, 1.0),
    "antiphase": (1.0, -1.0),
    "left": (1.0, 0.0),
    "right": (0.0, 1.0),
}
"""What the left and the right wheel path have of the sine."""

MIN_SAMPLES_PER_WAVE = 8
"""A wave has at least this many samples."""


@dataclass(frozen=True, kw_only=True)
class SineSweep:
    """A sine of changing frequency and amplitude."""

    __pydantic_config__ = STRICT

    length: Annotated[float, "m", "length of the road"] = 100.0
    n_start: Annotated[float, "cycles/m", "spatial frequency at the start"]
    n_end: Annotated[float, "cycles/m", "spatial frequency at the end"]
    progress: Annotated[Literal["linear", "logarithmic"], "", "from one to the other"] = (
        "logarithmic"
    )
    amplitude: Annotated[float, "m", "at the start"]
    amplitude_end: Annotated[float, "m", "at the end"]
    paths: Annotated[PathSigns, "", "which wheel paths, and how"] = "in_phase"
    taper: Annotated[float, "m", "from level to the full amplitude, and back"] = 2.0
    ds: Annotated[float, "m", "spacing of the samples"] = 0.01

    def __post_init__(self):
        check_positive(self, "length", "n_start", "n_end", "amplitude", "amplitude_end", "ds")
        check_not_negative(self, "taper")
        check_size(self.length, self.ds)
        if not 2.0 * self.taper <= self.length:
            raise ValueError(f"tapers of {self.taper} m do not fit into {self.length} m")
        if not max(self.n_start, self.n_end) * MIN_SAMPLES_PER_WAVE * self.ds <= 1.0:
            raise ValueError(
                f"n_start and n_end must be at most 1 / ({MIN_SAMPLES_PER_WAVE} ds) = "
                f"{1.0 / (MIN_SAMPLES_PER_WAVE * self.ds):g} cycles/m, "
                f"got {self.n_start} and {self.n_end}"
            )

    def realise(self, rng: np.random.Generator) -> Surface:
        """The sweep; there is nothing to draw."""
        s = self.ds * np.arange(round(self.length / self.ds) + 1)
        z = self.height(s)
        return Surface(np.outer(SIGNS[self.paths], z), self.ds, name="sine sweep")

    def height(self, s: np.ndarray) -> np.ndarray:
        """Height [m] of the sine at the stations `s` [m] from 0 to the length, any shape."""
        envelope = self.amplitude * (self.amplitude_end / self.amplitude) ** (s / self.length)
        return envelope * self._taper(s) * np.sin(self._phase(s))

    def _phase(self, s: np.ndarray) -> np.ndarray:
        b = np.log(self.n_end / self.n_start)
        if b == 0.0:
            cycles = self.n_start * s
        elif self.progress == "linear":
            cycles = self.n_start * s + (self.n_end - self.n_start) * s**2 / (2.0 * self.length)
        else:
            cycles = self.n_start * self.length / b * np.expm1(b * s / self.length)
        return 2.0 * np.pi * cycles

    def _taper(self, s: np.ndarray) -> np.ndarray:
        if self.taper == 0.0:
            return np.ones_like(s)
        inside = np.clip(np.minimum(s, self.length - s) / self.taper, 0.0, 1.0)
        return 0.5 - 0.5 * np.cos(np.pi * inside)
