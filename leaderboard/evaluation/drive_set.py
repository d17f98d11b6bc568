"""Sets of drives: roads, seeds and families of training and test."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from road_envs.core.config import Settings
from road_envs.roads import Road, with_length
from road_envs.roads.api import AnyRoad
from road_envs.vehicle.parameters import DEFAULT_STEP, Step

SEED_STRIDE = 10_000  # offset between the seeds of one road of a list and those of the next


@dataclass(frozen=True, kw_only=True)
class DriveSet(Settings):
    """Every road at every seed, seed by seed; only the first `number` if it is given."""

    roads: Annotated[tuple[AnyRoad, ...], Field(min_length=1)]
    seeds: Annotated[tuple[Annotated[int, Field(ge=0, lt=2**62)], ...], Field(min_length=1)]
    number: int | None = None
    length: float | None = None  # [m]; else each road's own
    step: Step = DEFAULT_STEP
    noise: bool = True  # of the instruments
    families: tuple[str, ...] = ()  # one for each road, to report scores by family
    design: tuple[tuple[int, ...], ...] = ()  # drives of each condition; empty: all in each

    def __post_init__(self):
        super().__post_init__()
        if self.families and len(self.families) != len(self.roads):
            raise ValueError(
                f"families must name one family for each of the {len(self.roads)} roads, "
                f"got {len(self.families)}"
            )
        total = len(self.roads) * len(self.seeds)
        if len(self.all_seeds) < total:
            raise ValueError(
                "seeds must differ, also from those of another road of the list, which are higher "
                f"by multiples of {SEED_STRIDE}; got {list(self.seeds)}"
            )
        if self.number is not None and not 1 <= self.number <= total:
            raise ValueError(f"number of drives must be 1 to {total}, got {self.number}")
        drives = set(range(total if self.number is None else self.number))
        repeats = any(len(set(indices)) < len(indices) for indices in self.design)
        if self.design and (repeats or set().union(*self.design) != drives):
            raise ValueError(
                f"design must use each of the drives 0 to {max(drives)} under some condition, and "
                f"none twice under one, got {[list(indices) for indices in self.design]}"
            )

    @property
    def roads_and_seeds(self) -> list[tuple[Road, int]]:
        """Roads to drive, each with the seed of its realisation."""
        # equal seeds would give correlated roads, so the k-th road of the list adds k * SEED_STRIDE
        pairs = [
            (at_length(road, self.length), seed + k * SEED_STRIDE)
            for seed in self.seeds
            for k, road in enumerate(self.roads)
        ]
        return pairs[: self.number]

    @property
    def all_seeds(self) -> set[int]:
        """Every seed that `roads_and_seeds` could contain, for any `number`."""
        return {seed + k * SEED_STRIDE for seed in self.seeds for k in range(len(self.roads))}

    @property
    def strata(self) -> list[list[int]]:
        """Indices in `roads_and_seeds` by family, in which a bootstrap resamples them."""
        return [self.indices_of_family(name) for name in dict.fromkeys(self.families)]

    def indices_of_family(self, family: str) -> list[int]:
        """Return the indices in `roads_and_seeds` of the roads of a family."""
        kinds = [self.families[k % len(self.roads)] for k in range(len(self.roads_and_seeds))]
        return [k for k, kind in enumerate(kinds) if kind == family]


def at_length(road: Road, length: float | None) -> Road:
    """Return the road at another length [m], if one is given."""
    return road if length is None else with_length(road, length)
