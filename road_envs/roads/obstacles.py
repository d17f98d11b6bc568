"""Obstacles on a level road: the paper's bumps, half-sine bumps and dips, and potholes.

The trapezoidal bumps have the three layouts of the paper's Figure 2 (Ngwangwa et al., section 3.1):

    small         (b) one small bump on both wheel paths, at the same station
    large_small   (c) large, then small, on both wheel paths
    asymmetric    (d) large on the left, then small on the right

Heights (100 and 150 mm) and spacing (10.4 m; 8 m in training) are the paper's. The lengths of ramp
and top, which it shows in figures only, are assumed, as is that the spacing is between the middles
of the bumps. For training, lengths and heights are scaled by 1 ± 0.1 (section 4). Defects are

    half_sine   height sin(pi x / length), x from the start of the bump; a negative height is a dip
    pothole     trapezoidal hole: edge, floor at `height` < 0, edge

Half sines represent the bumps of Ngwangwa, Heyns, Labuschagne & Kululanga (J. Terramechanics 47,
2010), whose defects also grew with time. A `count` above 1 makes a row of one defect at successive
ages, each `growth` times as high as the one before it (an assumed law).

Depths and sizes of random potholes follow the distress manual of the LTPP programme (Miller &
Bellinger, FHWA-RD-03-031, 2003): at least 150 mm wide; low severity below 25 mm of depth, high
severity above 50 mm. The upper bounds and the number of potholes per metre are assumed.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from road_envs.core.config import Count, Finite, NonNegative, Positive, Settings, SmallestFirst
from road_envs.roads.surface import DEFAULT_LENGTH, RoadLength, SampleSpacing, Surface, check_size

Layout = Literal["small", "large_small", "asymmetric"]
LAYOUTS: dict[Layout, tuple[tuple[str, str], ...]] = {
    "small": (("small", "both"),),
    "large_small": (("large", "both"), ("small", "both")),
    "asymmetric": (("large", "left"), ("small", "right")),
}
"""Size and wheel path of the bumps, in driving order."""

SIDES = {"left": [0], "right": [1], "both": [0, 1]}  # rows of the heights (2, N) of a surface
SAMPLE_SPACING = 0.005  # spacing of the samples of bumps and defects [m]


@dataclass(frozen=True, kw_only=True)
class _Trapezoid(Settings):
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
    small: _Trapezoid = field(default_factory=lambda: _Trapezoid(height=0.1, ramp=0.5, top=0.4))
    large: _Trapezoid = field(default_factory=lambda: _Trapezoid(height=0.15, ramp=0.75, top=0.6))
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
    def blocks(self) -> list[_Trapezoid]:
        """The scaled bumps in driving order."""
        x, z = self.length_factor, self.height_factor
        sizes = [getattr(self, size) for size, _ in LAYOUTS[self.layout]]
        return [_Trapezoid(height=z * b.height, ramp=x * b.ramp, top=x * b.top) for b in sizes]

    @property
    def middles(self) -> np.ndarray:
        """Stations [m] of the middles of the bumps."""
        first, row = self.blocks[0], self.spacing * np.arange(len(self.blocks))
        return self.run_in + first.ramp + 0.5 * first.top + row

    @property
    def length(self) -> float:
        """Length [m] of the road, run-in and run-out included."""
        last = self.blocks[-1]
        return float(self.middles[-1] + 0.5 * last.top + last.ramp + self.run_out)

    def realise(self, rng: np.random.Generator) -> Surface:
        s = self.ds * np.arange(int(np.ceil(self.length / self.ds)) + 1)
        z = np.zeros((2, s.size))
        rows = zip(self.blocks, self.middles, LAYOUTS[self.layout], strict=True)
        for block, middle, (_, side) in rows:
            z[SIDES[side]] += block.height_at(s - middle)
        return Surface(z, self.ds, name=f"bumps {self.layout}")


MAX_DEFECT_HEIGHT = 10.0  # largest height or depth of a defect [m]

PositiveRange = Annotated[tuple[Positive, Positive], SmallestFirst]


@dataclass(frozen=True, kw_only=True)
class Defect(Settings):
    """One bump or hole, or a row of growing ones."""

    shape: Literal["half_sine", "pothole"]
    at: Annotated[Finite, "m", "station of the middle of the first"]
    length: Annotated[Finite, Field(ge=4.0 * SAMPLE_SPACING), "m", "along the road"]
    height: Annotated[Finite, "m", "of the crest, or of the floor of a hole (negative)"]
    edge: Annotated[NonNegative, "m", "length of either edge of a pothole"] = 0.0
    side: Annotated[Literal["left", "right", "both"], "", "wheel path"] = "both"
    count: Annotated[Count, Field(le=10**9), "", "number of defects in the row"] = 1
    spacing: Annotated[NonNegative, "m", "between the middles of the row"] = 0.0
    growth: Annotated[Positive, "", "height relative to the previous one"] = 1.0

    def __post_init__(self):
        super().__post_init__()
        if self.shape == "pothole" and not (self.height < 0.0 < self.edge < 0.5 * self.length):
            raise ValueError(
                "a pothole needs a height below 0 and 0 < edge < length / 2, "
                f"got height = {self.height}, edge = {self.edge}, length = {self.length}"
            )
        if self.shape == "half_sine" and (self.edge or not self.height):
            raise ValueError(
                "a half sine needs a height that is not 0 and no edge, "
                f"got height = {self.height}, edge = {self.edge}"
            )
        if self.count > 1 and self.spacing < self.length:
            raise ValueError(f"defects of {self.length} m overlap at a spacing of {self.spacing} m")
        last = np.log(abs(self.height)) + (self.count - 1) * max(0.0, np.log(self.growth))
        if not last <= np.log(MAX_DEFECT_HEIGHT):
            raise ValueError(
                f"a defect must not be higher than {MAX_DEFECT_HEIGHT:g} m, got a height of "
                f"{self.height} m and a growth of {self.growth} over {self.count} defects"
            )

    def unit_height(self, distance: np.ndarray) -> np.ndarray:
        """Return the height relative to crest or floor at `distance` [m] from the middle."""
        if self.shape == "pothole":
            hole = _Trapezoid(height=1.0, ramp=self.edge, top=self.length - 2.0 * self.edge)
            return hole.height_at(distance)
        return np.cos(np.pi * np.clip(distance / self.length, -0.5, 0.5))


@dataclass(frozen=True, kw_only=True)
class Defects(Settings):
    """Defects at given stations; the heights of overlapping defects add up."""

    defects: tuple[Defect, ...]
    length: RoadLength = DEFAULT_LENGTH
    name: Annotated[str, "", "of the surface, as results and frames show it"] = "defects"

    def __post_init__(self):
        super().__post_init__()
        check_size(self.length, SAMPLE_SPACING)
        for defect in self.defects:
            first = defect.at - 0.5 * defect.length
            last = defect.at + defect.spacing * (defect.count - 1) + 0.5 * defect.length
            if not (first >= 0.0 and last <= self.length):
                raise ValueError(
                    f"defects from {first:g} to {last:g} m are not on a road of {self.length:g} m"
                )

    def realise(self, rng: np.random.Generator) -> Surface:
        s, z = _flat_road_grid(self.length)
        for defect in self.defects:
            row = np.arange(defect.count)
            middles, heights = defect.at + defect.spacing * row, defect.height * defect.growth**row
            for middle, height in zip(middles, heights, strict=True):
                near = _footprint(s, middle, defect.length)
                z[SIDES[defect.side], near] += height * defect.unit_height(s[near] - middle)
        return Surface(z, SAMPLE_SPACING, name=self.name)


@dataclass(frozen=True, kw_only=True)
class Potholes(Settings):
    """Random potholes on either wheel path; where two overlap, the deeper one counts."""

    length: RoadLength = DEFAULT_LENGTH
    rate: Annotated[Positive, "1/m", "mean number per metre and wheel path [assumed]"] = 0.05
    depth: Annotated[PositiveRange, "m", "smallest and largest"] = (0.025, 0.075)
    size: Annotated[PositiveRange, "m", "smallest and largest length"] = (0.15, 0.8)
    edge: Annotated[Positive, "m", "length of either edge [assumed]"] = 0.05

    def __post_init__(self):
        super().__post_init__()
        check_size(self.length, SAMPLE_SPACING)
        check_size(self.rate, SAMPLE_SPACING / self.length)
        if not 2.0 * self.edge < self.size[0] or self.size[1] > self.length:
            raise ValueError(
                f"size must be more than two edges and at most the length {self.length} m, "
                f"got {self.size} with edge = {self.edge}"
            )

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw number, positions, sizes and depths of the potholes of each wheel path."""
        s, z = _flat_road_grid(self.length)
        for path in z:
            count = rng.poisson(self.rate * self.length)
            sizes = rng.uniform(*self.size, count)
            middles = 0.5 * sizes + rng.uniform(0.0, 1.0, count) * (self.length - sizes)
            depths = rng.uniform(*self.depth, count)
            for middle, size, depth in zip(middles, sizes, depths, strict=True):
                near = _footprint(s, middle, size)
                hole = _Trapezoid(height=depth, ramp=self.edge, top=size - 2.0 * self.edge)
                path[near] = np.minimum(path[near], -hole.height_at(s[near] - middle))
        return Surface(z, SAMPLE_SPACING, name="potholes")


def _flat_road_grid(length: float) -> tuple[np.ndarray, np.ndarray]:
    """Stations (N,) [m] of a road of `length` [m], and heights (2, N) of 0."""
    s = SAMPLE_SPACING * np.arange(round(length / SAMPLE_SPACING) + 1)
    return s, np.zeros((2, s.size))


def _footprint(s: np.ndarray, middle: float, length: float) -> slice:
    """Slice of the stations `s` (N,) [m] that a defect covers."""
    return slice(*np.searchsorted(s, [middle - 0.5 * length, middle + 0.5 * length]))
