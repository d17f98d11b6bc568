"""The flat road, and roads composed of other roads.

Every surface starts at height 0 and is level before its start and after its end. Most compositions
are therefore sums of delayed surfaces: a road that follows another one starts at its final height.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field

from road_envs.core.config import Finite, NonNegative, Positive, Settings, SmallestFirst
from road_envs.records.record import PROFILE_SPACING
from road_envs.roads.api import AnyRoad, with_length
from road_envs.roads.measured import tile_heights
from road_envs.roads.surface import DEFAULT_LENGTH, RoadLength, Surface, check_size

_Roads = Annotated[tuple[AnyRoad, ...], Field(min_length=1, max_length=200)]
MAX_LEVEL = 200.0  # largest level [dB] of a road relative to another, up or down: a factor of 1e10


@dataclass(frozen=True, kw_only=True)
class Flat(Settings):
    """A flat road."""

    length: RoadLength = DEFAULT_LENGTH

    def __post_init__(self):
        super().__post_init__()
        check_size(self.length, PROFILE_SPACING)

    def realise(self, rng: np.random.Generator) -> Surface:
        steps = max(3, round(self.length / PROFILE_SPACING))
        return Surface(np.zeros((2, steps + 1)), self.length / steps, name="flat")


@dataclass(frozen=True, kw_only=True)
class _Modified(Settings):
    """A road made of one other road, whose length it has, plus or times a constant."""

    road: AnyRoad

    @property
    def length(self) -> float:
        return self.road.length

    def with_length(self, length: float) -> Self:
        added = self.length - self.road.length
        return replace(self, road=with_length(self.road, length - added))


@dataclass(frozen=True, kw_only=True)
class FixedSeed(_Modified):
    """A deterministic road: the surface that `road` draws from `seed`."""

    seed: Annotated[int, Field(ge=0), "", "of the random generator"]

    def realise(self, rng: np.random.Generator) -> Surface:
        return self.road.realise(np.random.default_rng(self.seed))


@dataclass(frozen=True, kw_only=True)
class NoisyCopy(_Modified):
    """A road with added noise and a delay: the paper's training version of its Belgian paving.

    Gaussian noise with `noise` times the standard deviation of each wheel path is added on the
    paper's grid of 25.2 mm and interpolated to the samples. The road is then shifted by `delay`,
    with a level section before it, and cut to its former length (Ngwangwa et al., section 4).
    """

    noise: Annotated[NonNegative, "", "standard deviation over that of the wheel path"] = 0.1
    delay: Annotated[NonNegative, "m", "length of the level section before the road"] = 1.0

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the road and the noise, each from its own random stream."""
        road_rng, noise_rng = map(np.random.default_rng, rng.integers(2**63, size=2))
        surface = self.road.realise(road_rng)
        s, ds, start = surface.s, surface.ds, surface.start
        # on a finer grid white noise would be steps too short for a wheel to follow
        nodes = int(np.ceil(surface.length / PROFILE_SPACING)) + 4
        scale = self.noise * surface.z.std(axis=1, keepdims=True)
        noise = Surface(scale * noise_rng.standard_normal((2, nodes)), PROFILE_SPACING, start)
        z = surface.z + noise.height(s)
        delayed = Surface(z - z[:, :1], ds, start).height(s - self.delay)
        notes = (*surface.notes, f"{self.noise:.0%} RMS noise, {self.delay:g} m delay")
        return Surface(delayed, ds, start, f"{surface.name}, altered", notes)


@dataclass(frozen=True, kw_only=True)
class WithAprons(_Modified):
    """A road between two level sections."""

    before: Annotated[NonNegative, "m", "level section before the road"] = 10.0
    after: Annotated[NonNegative, "m", "level section after it, at its final height"] = 10.0

    @property
    def length(self) -> float:
        return self.before + self.road.length + self.after

    def realise(self, rng: np.random.Generator) -> Surface:
        return _superpose([self.road.realise(rng)], [(self.before, self.before)], self.length)


@dataclass(frozen=True, kw_only=True)
class Offset(_Modified):
    """A road whose wheel paths are shifted against each other, as on an oblique obstacle."""

    left: Annotated[NonNegative, "m", "level section before the left wheel path"] = 0.0
    right: Annotated[NonNegative, "m", "level section before the right wheel path"] = 0.0

    @property
    def length(self) -> float:
        return self.road.length + max(self.left, self.right)

    def realise(self, rng: np.random.Generator) -> Surface:
        return _superpose([self.road.realise(rng)], [(self.left, self.right)], self.length)


@dataclass(frozen=True, kw_only=True)
class Scaled(_Modified):
    """A road with scaled heights and lengths; a negative `height_factor` inverts it."""

    height_factor: Annotated[Finite, "", "scales heights"] = 1.0
    length_factor: Annotated[Positive, "", "scales lengths along the road"] = 1.0

    def __post_init__(self):
        super().__post_init__()
        if self.height_factor == 0.0:
            raise ValueError("height_factor must not be 0")

    @property
    def length(self) -> float:
        return self.length_factor * self.road.length

    def with_length(self, length: float) -> Self:
        return replace(self, road=with_length(self.road, length / self.length_factor))

    def realise(self, rng: np.random.Generator) -> Surface:
        surface = self.road.realise(rng)
        note = f"heights x {self.height_factor:g}, lengths x {self.length_factor:g}"
        z, ds = self.height_factor * surface.z, self.length_factor * surface.ds
        return Surface(z, ds, name=f"{surface.name}, scaled", notes=(*surface.notes, note))


@dataclass(frozen=True, kw_only=True)
class RandomLevel(_Modified):
    """A road of random level, uniform in dB: 6 dB double its heights and are one ISO class.

    The same seed draws the same inner road at every level.
    """

    level: Annotated[
        tuple[Finite, Finite], SmallestFirst, "dB", "limits of the level relative to the road's"
    ]

    def __post_init__(self):
        super().__post_init__()
        if max(map(abs, self.level)) > MAX_LEVEL:
            raise ValueError(f"level must be within {MAX_LEVEL:g} dB, got {list(self.level)}")

    def realise(self, rng: np.random.Generator) -> Surface:
        surface = self.road.realise(rng)
        decibels = rng.uniform(*self.level)
        notes = (*surface.notes, f"level {decibels:+.1f} dB")
        return replace(surface, z=10.0 ** (decibels / 20.0) * surface.z, notes=notes)


@dataclass(frozen=True, kw_only=True)
class Tiled(Settings):
    """One draw of a road repeated end to end, like a short tile of `Measured`."""

    road: AnyRoad
    length: RoadLength
    repeat: Annotated[Literal["repeat", "mirror"], "", "how the tile is continued"] = "repeat"

    def realise(self, rng: np.random.Generator) -> Surface:
        tile = self.road.realise(rng)
        check_size(self.length, tile.ds)
        z, note = tile_heights(tile.z, tile.ds, round(self.length / tile.ds) + 1, self.repeat)
        return Surface(z, tile.ds, name=f"{tile.name}, repeated", notes=(*tile.notes, note))


@dataclass(frozen=True, kw_only=True)
class Concatenated(Settings):
    """Consecutive roads; each starts at the final height of the one before it."""

    roads: _Roads

    @property
    def length(self) -> float:
        return sum(road.length for road in self.roads)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the roads, each from its own random stream."""
        starts = np.cumsum([0.0, *(road.length for road in self.roads)])[:-1]
        return _superpose(_realise_all(self.roads, rng), [(s, s) for s in starts], self.length)


@dataclass(frozen=True, kw_only=True)
class Superposed(Settings):
    """Sum of the heights of several roads; a shorter one is continued at its final height."""

    roads: _Roads

    @property
    def length(self) -> float:
        return max(road.length for road in self.roads)

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the roads, each from its own random stream."""
        surfaces = _realise_all(self.roads, rng)
        return _superpose(surfaces, [(0.0, 0.0)] * len(surfaces), self.length)


def _superpose(
    surfaces: Sequence[Surface], delays: Sequence[tuple[float, float]], length: float
) -> Surface:
    """Return the sum of `surfaces` on the finest of their grids, `length` [m] long.

    `delays` [m] shift the left and the right wheel path of each surface.
    """
    ds = min(surface.ds for surface in surfaces)
    check_size(length * len(surfaces), ds)  # each is interpolated over the whole length
    s = ds * np.arange(round(length / ds) + 1)
    z = np.zeros((2, s.size))
    for surface, pair in zip(surfaces, delays, strict=True):
        for side, delay in enumerate(pair):
            z[side] += surface.height(s - delay)[side]
    names = dict.fromkeys(surface.name for surface in surfaces)
    notes = dict.fromkeys(note for surface in surfaces for note in surface.notes)
    return Surface(z, ds, name=" + ".join(names), notes=tuple(notes))


def _realise_all(roads: Sequence[AnyRoad], rng: np.random.Generator) -> list[Surface]:
    """Surfaces of the roads; appending a road does not change the draws before it."""
    seeds = rng.integers(2**63, size=len(roads))
    return [road.realise(np.random.default_rng(k)) for road, k in zip(roads, seeds, strict=True)]
