"""Trapezoidal bumps in the three layouts of the paper's Figure 2 (Ngwangwa et al., section 3.1).

    small         (b) one small bump on both wheel paths, at the same station
    large_small   (c) large, then small, on both wheel paths
    asymmetric    (d) large on the left, then small on the right

Heights (100 and 150 mm) and spacing (10.4 m; 8 m in training) are the paper's. The lengths of ramp
and top, which it shows in figures only, are assumed, as is that the spacing is between the middles
of the bumps. For training, lengths and heights are scaled by 1 ± 0.1 (section 4).
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from road_envs.core.config import Positive, Settings
from road_envs.roads.surface import SampleSpacing, Surface, check_size

Layout = Literal["small", "large_small", "asymmetric"]
LAYOUTS: dict[Layout, tuple[tuple[str, str], ...]] = {
    "small": (("small", "both"),),
    "large_small": (("large", "both"), ("small", "both")),
    "asymmetric": (("large", "left"), ("small", "right")),
}
"""Size and wheel path of the bumps, in driving order."""

SIDES = {"left": [0], "right": [1], "both": [0, 1]}
"""Row indices of the heights (2, N) of a surface."""

SAMPLE_SPACING = 0.005
"""Spacing of the samples of bumps and defects [m]."""


@dataclass(frozen=True, kw_only=True)
class Trapezoid(Settings):
    """Trapezoidal bump: ramp, flat top, and a ramp of the same length."""

    height: Annotated[Positive, "m", "of the top"]
    ramp: Annotated[Positive, "m", "length of each ramp along the road"]
    top: Annotated[Positive, "m", "length of the top"]

    def height_at(self, distance: np.ndarray) -> np.ndarray:
        """Return the height [m] at `distance` [m] from the middle, of any shape."""
        edge = 0.5 * self.top + self.ramp - np.abs(distance)
        return self.height * np.clip(edge / self.ramp, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Bumps(Settings):
    """Bumps on a level road, with level sections `run_in` and `run_out`."""

    layout: Annotated[Layout, "", "sizes and wheel paths of the bumps"]
    spacing: Annotated[Positive, "m", "between the middles of successive bumps"] = 10.4
    small: Trapezoid = field(default_factory=lambda: Trapezoid(height=0.1, ramp=0.5, top=0.4))
    large: Trapezoid = field(default_factory=lambda: Trapezoid(height=0.15, ramp=0.75, top=0.6))
    length_factor: Annotated[Positive, "", "scales ramps and tops"] = 1.0
    height_factor: Annotated[Positive, "", "scales heights"] = 1.0
    run_in: Annotated[Positive, "m", "before the first ramp"] = 10.0
    run_out: Annotated[Positive, "m", "after the last ramp"] = 10.0
    ds: SampleSpacing = SAMPLE_SPACING

    def __post_init__(self):
        super().__post_init__()
        check_size(self.length, self.ds)
        for a, b in zip(self.blocks, self.blocks[1:], strict=False):
            if 0.5 * (a.top + b.top) + a.ramp + b.ramp > self.spacing:
                raise ValueError(
                    f"bumps overlap at a spacing of {self.spacing} m; choose a larger spacing"
                )

    @property
    def blocks(self) -> list[Trapezoid]:
        """The scaled bumps in driving order."""
        x, z = self.length_factor, self.height_factor
        sizes = [getattr(self, size) for size, _ in LAYOUTS[self.layout]]
        return [Trapezoid(height=z * b.height, ramp=x * b.ramp, top=x * b.top) for b in sizes]

    @property
    def middles(self) -> np.ndarray:
        """Stations [m] of the middles of the bumps."""
        first = self.blocks[0]
        return (
            self.run_in + first.ramp + 0.5 * first.top + self.spacing * np.arange(len(self.blocks))
        )

    @property
    def length(self) -> float:
        """Length [m] of the road, run-in and run-out included."""
        last = self.blocks[-1]
        return float(self.middles[-1] + 0.5 * last.top + last.ramp + self.run_out)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Return the bumps; nothing is drawn."""
        s = self.ds * np.arange(int(np.ceil(self.length / self.ds)) + 1)
        z = np.zeros((2, s.size))
        for block, middle, (_, side) in zip(
            self.blocks, self.middles, LAYOUTS[self.layout], strict=True
        ):
            z[SIDES[side]] += block.height_at(s - middle)
        return Surface(z, self.ds, name=f"bumps {self.layout}")
