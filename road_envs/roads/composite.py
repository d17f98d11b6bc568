"""What a road is, the level road, and roads made of another road."""

from dataclasses import dataclass
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from pydantic import PlainValidator

from road_envs.config import STRICT
from road_envs.data.record import GRID
from road_envs.roads.surface import Surface
from road_envs.roads.validation import check_not_negative, check_positive, check_size


@runtime_checkable
class Road(Protocol):
    """A frozen description of a road, from station 0 to `length` [m], that can be realised."""

    @property
    def length(self) -> float: ...

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw one surface; same road and same generator state, same surface."""
        ...


def _load(source: Any) -> Road:
    from road_envs.roads import load_road

    return load_road(source)


AnyRoad = Annotated[Road, PlainValidator(_load), "", "a road: shipped name, path or mapping"]


def streams(rng: np.random.Generator, count: int) -> list[np.random.Generator]:
    """A generator for each of `count` causes; they follow from the state of `rng` alone."""
    return [np.random.default_rng(k) for k in rng.integers(2**63, size=count)]


@dataclass(frozen=True, kw_only=True)
class Flat:
    """A level road."""

    __pydantic_config__ = STRICT

    length: Annotated[float, "m", "length of the road"] = 100.0

    def __post_init__(self):
        check_positive(self, "length")
        check_size(self.length, GRID)

    def realise(self, rng: np.random.Generator) -> Surface:
        """The level surface."""
        steps = max(3, round(self.length / GRID))
        return Surface(np.zeros((2, steps + 1)), self.length / steps, name="flat")


@dataclass(frozen=True, kw_only=True)
class Fixed:
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

    def realise(self, rng: np.random.Generator) -> Surface:
        """The surface of `seed`; `rng` is not touched."""
        return self.road.realise(np.random.default_rng(self.seed))


@dataclass(frozen=True, kw_only=True)
class Altered:
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

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw the road, then the noise, each from a stream of its own."""
        road_rng, noise_rng = streams(rng, 2)
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
        nodes = int(np.ceil(surface.length / GRID)) + 4
        rms = surface.z.std(axis=1, keepdims=True)
        return Surface(self.noise * rms * rng.standard_normal((2, nodes)), GRID, surface.start)
