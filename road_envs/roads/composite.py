"""The level road, and roads made of other roads.

Every surface starts at height 0 and is level before its start and after its end. So each of these
roads but the repeated and the scaled one is a sum of delayed surfaces: where one road follows
another, it starts at the height at which the other ended.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np

from road_envs.config import STRICT
from road_envs.data.record import PROFILE_SPACING
from road_envs.roads.api import AnyRoad, Road, with_length
from road_envs.roads.measured import tile_heights
from road_envs.roads.surface import Surface
from road_envs.roads.validation import (
    check_not_empty,
    check_not_negative,
    check_positive,
    check_size,
)


@dataclass(frozen=True, kw_only=True)
class Flat:
    """A level road."""

    __pydantic_config__ = STRICT

    length: Annotated[float, "m", "length of the road"] = 100.0

    def __post_init__(self):
        check_positive(self, "length")
        check_size(self.length, PROFILE_SPACING)

    def realise(self, rng: np.random.Generator) -> Surface:
        """The level surface."""
        steps = max(3, round(self.length / PROFILE_SPACING))
        return Surface(np.zeros((2, steps + 1)), self.length / steps, name="flat")


@dataclass(frozen=True, kw_only=True)
class FixedSeed:
    """One surface for ever: what `road` draws from `seed`, whoever asks."""

    __pydantic_config__ = STRICT

    road: AnyRoad
    seed: int

    def __post_init__(self):
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")

    @property
    def length(self) -> float:
        """Length [m] of the road."""
        return self.road.length

    def with_length(self, length: float) -> Road:
        """The same road with another length [m]."""
        return _resize_inner(self, length)

    def realise(self, rng: np.random.Generator) -> Surface:
        """The surface of `seed`; `rng` is not touched."""
        return self.road.realise(np.random.default_rng(self.seed))


@dataclass(frozen=True, kw_only=True)
class NoisyCopy:
    """A road with noise and a delay: how the paper makes training roads of its Belgian paving.

    Gaussian noise of `noise` times the RMS of each wheel path (about its mean) is added on the
    paper's grid of 25.2 mm and carried to the samples by the surface's own cubic: white noise on
    a finer grid would be steps that no wheel could follow. Then the road starts `delay` later,
    level until there, and loses as much at its end (Ngwangwa et al., section 4).
    """

    __pydantic_config__ = STRICT

    road: AnyRoad
    noise: Annotated[float, "", "RMS of the noise over RMS of the wheel path"] = 0.1
    delay: Annotated[float, "m", "level stretch put before the road"] = 1.0

    def __post_init__(self):
        check_not_negative(self, "noise", "delay")

    @property
    def length(self) -> float:
        """Length [m] of the road, as before the change."""
        return self.road.length

    def with_length(self, length: float) -> Road:
        """The same road with another length [m]."""
        return _resize_inner(self, length)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the road, then the noise, each from a stream of its own."""
        road_rng, noise_rng = spawn_streams(rng, 2)
        surface = self.road.realise(road_rng)
        s = surface.s
        z = surface.z + self._noise(surface, noise_rng).height(s)
        noisy = Surface(z - z[:, :1], surface.ds, surface.start)
        return Surface(
            noisy.height(s - self.delay),
            surface.ds,
            surface.start,
            f"{surface.name}, altered",
            (*surface.notes, f"{self.noise:.0%} RMS noise, {self.delay:g} m delay"),
        )

    def _noise(self, surface: Surface, rng: np.random.Generator) -> Surface:
        nodes = int(np.ceil(surface.length / PROFILE_SPACING)) + 4
        rms = surface.z.std(axis=1, keepdims=True)
        return Surface(
            self.noise * rms * rng.standard_normal((2, nodes)), PROFILE_SPACING, surface.start
        )


@dataclass(frozen=True, kw_only=True)
class WithAprons:
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

    def with_length(self, length: float) -> Road:
        """The same road with another length [m]."""
        return _resize_inner(self, length)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the road."""
        return superpose([self.road.realise(rng)], [(self.before, self.before)], self.length)


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

    def with_length(self, length: float) -> Road:
        """The same road with another length [m]."""
        return _resize_inner(self, length)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the road."""
        return superpose([self.road.realise(rng)], [(self.left, self.right)], self.length)


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

    def with_length(self, length: float) -> Road:
        """The same road with another length [m]."""
        return replace(self, road=with_length(self.road, length / self.length_factor))

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
class Tiled:
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
        z, note = tile_heights(tile.z, tile.ds, round(self.length / tile.ds) + 1, self.repeat)
        return Surface(z, tile.ds, name=f"{tile.name}, repeated", notes=(*tile.notes, note))


@dataclass(frozen=True, kw_only=True)
class Concatenated:
    """Roads one after another; each starts at the height where the one before it ends."""

    __pydantic_config__ = STRICT

    roads: tuple[AnyRoad, ...]

    def __post_init__(self):
        check_not_empty(self.roads)

    @property
    def length(self) -> float:
        """Length [m] of all roads together."""
        return sum(road.length for road in self.roads)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the roads, each from a stream of its own."""
        starts = np.cumsum([0.0, *(road.length for road in self.roads)])[:-1]
        return superpose(realise_all(self.roads, rng), [(s, s) for s in starts], self.length)


@dataclass(frozen=True, kw_only=True)
class Superposed:
    """Roads on top of one another: their heights add up; a shorter one stays as high as it ends."""

    __pydantic_config__ = STRICT

    roads: tuple[AnyRoad, ...]

    def __post_init__(self):
        check_not_empty(self.roads)

    @property
    def length(self) -> float:
        """Length [m] of the longest road."""
        return max(road.length for road in self.roads)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the roads, each from a stream of its own."""
        surfaces = realise_all(self.roads, rng)
        return superpose(surfaces, [(0.0, 0.0)] * len(surfaces), self.length)


def superpose(
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


def realise_all(roads: Sequence[AnyRoad], rng: np.random.Generator) -> list[Surface]:
    """One surface of each road; a road more at the end changes none before it."""
    return [
        road.realise(own) for road, own in zip(roads, spawn_streams(rng, len(roads)), strict=True)
    ]


def spawn_streams(rng: np.random.Generator, count: int) -> list[np.random.Generator]:
    """A generator for each of `count` causes; they follow from the state of `rng` alone."""
    return [np.random.default_rng(k) for k in rng.integers(2**63, size=count)]


def _resize_inner(road: Any, length: float) -> Road:
    """A road `length` [m] long whose inner road takes up the change."""
    added = road.length - road.road.length
    return replace(road, road=with_length(road.road, length - added))
