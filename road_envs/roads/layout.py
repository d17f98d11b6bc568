"""Roads laid out from other roads: behind a run-in, one wheel path behind the other, repeated,
scaled, one after another, one on top of another.

Every surface starts at height 0 and is level before its start and after its end. So each of these
roads but the repeated and the scaled one is a sum of delayed surfaces: where one road follows
another, it starts at the height at which the other ended.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from road_envs.config import STRICT
from road_envs.roads.composite import AnyRoad, streams
from road_envs.roads.measured import laid
from road_envs.roads.surface import Surface
from road_envs.roads.validation import check_not_negative, check_positive, check_size, check_some


@dataclass(frozen=True, kw_only=True)
class RunIn:
    """A road between two level stretches."""

    __pydantic_config__ = STRICT

    road: AnyRoad
    before: Annotated[float, "m", "level stretch before the road"] = 10.0
    after: Annotated[float, "m", "level stretch after it, at the height of its end"] = 10.0

    def __post_init__(self):
        check_not_negative(self, "before", "after")

    @property
    def length(self) -> float:
        """Length [m] of the road, with both stretches."""
        return self.before + self.road.length + self.after

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the road."""
        return total([self.road.realise(rng)], [(self.before, self.before)], self.length)


@dataclass(frozen=True, kw_only=True)
class Offset:
    """A road of which one wheel path comes later than the other, as on an oblique obstacle."""

    __pydantic_config__ = STRICT

    road: AnyRoad
    left: Annotated[float, "m", "level stretch before the left wheel path"] = 0.0
    right: Annotated[float, "m", "level stretch before the right wheel path"] = 0.0

    def __post_init__(self):
        check_not_negative(self, "left", "right")

    @property
    def length(self) -> float:
        """Length [m] to the end of the later wheel path."""
        return self.road.length + max(self.left, self.right)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the road."""
        return total([self.road.realise(rng)], [(self.left, self.right)], self.length)


@dataclass(frozen=True, kw_only=True)
class Scaled:
    """A road with other heights and another length; a negative `height_factor` turns it over."""

    __pydantic_config__ = STRICT

    road: AnyRoad
    height_factor: Annotated[float, "", "scales heights"] = 1.0
    length_factor: Annotated[float, "", "scales lengths along the road"] = 1.0

    def __post_init__(self):
        check_positive(self, "length_factor")
        if not 0.0 < abs(self.height_factor) < np.inf:
            raise ValueError(f"height_factor must not be 0, got {self.height_factor}")

    @property
    def length(self) -> float:
        """Length [m] of the scaled road."""
        return self.length_factor * self.road.length

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the road."""
        surface = self.road.realise(rng)
        note = f"heights x {self.height_factor:g}, lengths x {self.length_factor:g}"
        return Surface(
            self.height_factor * surface.z,
            self.length_factor * surface.ds,
            name=f"{surface.name}, scaled",
            notes=(*surface.notes, note),
        )


@dataclass(frozen=True, kw_only=True)
class Repeated:
    """One draw of a road laid end to end, as a tile that is too short is (see `Measured`)."""

    __pydantic_config__ = STRICT

    road: AnyRoad
    length: Annotated[float, "m", "length of the road"]
    repeat: Annotated[Literal["repeat", "mirror"], "", "how the tile is laid"] = "repeat"

    def __post_init__(self):
        check_positive(self, "length")

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the tile and lay it."""
        tile = self.road.realise(rng)
        check_size(self.length, tile.ds)
        z, note = laid(tile.z, tile.ds, round(self.length / tile.ds) + 1, self.repeat)
        return Surface(z, tile.ds, name=f"{tile.name}, repeated", notes=(*tile.notes, note))


@dataclass(frozen=True, kw_only=True)
class Joined:
    """Roads one after another; each starts at the height where the one before it ends."""

    __pydantic_config__ = STRICT

    roads: tuple[AnyRoad, ...]

    def __post_init__(self):
        check_some(self.roads)

    @property
    def length(self) -> float:
        """Length [m] of all roads together."""
        return sum(road.length for road in self.roads)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the roads, each from a stream of its own."""
        starts = np.cumsum([0.0, *(road.length for road in self.roads)])[:-1]
        return total(drawn(self.roads, rng), [(s, s) for s in starts], self.length)


@dataclass(frozen=True, kw_only=True)
class Summed:
    """Roads on top of one another: their heights add up; a shorter one stays as high as it ends."""

    __pydantic_config__ = STRICT

    roads: tuple[AnyRoad, ...]

    def __post_init__(self):
        check_some(self.roads)

    @property
    def length(self) -> float:
        """Length [m] of the longest road."""
        return max(road.length for road in self.roads)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the roads, each from a stream of its own."""
        surfaces = drawn(self.roads, rng)
        return total(surfaces, [(0.0, 0.0)] * len(surfaces), self.length)


def total(
    surfaces: Sequence[Surface], delays: Sequence[tuple[float, float]], length: float
) -> Surface:
    """The sum of `surfaces`, each with its left and right path delayed [m], on the finest grid."""
    ds = min(surface.ds for surface in surfaces)
    check_size(length, ds)
    s = ds * np.arange(round(length / ds) + 1)
    z = np.zeros((2, s.size))
    for surface, pair in zip(surfaces, delays, strict=True):
        for side, delay in enumerate(pair):
            z[side] += surface.height(s - delay)[side]
    names = dict.fromkeys(surface.name for surface in surfaces)
    notes = dict.fromkeys(note for surface in surfaces for note in surface.notes)
    return Surface(z, ds, name=" + ".join(names), notes=tuple(notes))


def drawn(roads: Sequence[AnyRoad], rng: np.random.Generator) -> list[Surface]:
    """One surface of each road; a road more at the end changes none before it."""
    return [road.realise(own) for road, own in zip(roads, streams(rng, len(roads)), strict=True)]
