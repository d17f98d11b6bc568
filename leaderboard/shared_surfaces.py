"""Surfaces that do not depend on a seed, of which roads of a task are made.

A road is compared by what it is made of: a piece of a surface, one between aprons, scaled or
altered is of that surface, too.
"""

import dataclasses
from collections.abc import Iterable

import numpy as np

from leaderboard.evaluation.drive_set import DriveSet
from leaderboard.evaluation.task_files import digest_of
from road_envs.roads import Road
from road_envs.roads.composite import FixedSeed, Flat
from road_envs.roads.measured import Measured


def fixed_surfaces(roads: Iterable[Road]) -> set[str]:
    """Return descriptions of the uneven surfaces of `roads` that no seed varies."""
    return {_described(part) for road in roads for part in _parts(road) if not _is_random(part)}


def shared_seeds(one: DriveSet, other: DriveSet) -> list[int]:
    """Return the seeds by which roads of both sets are drawn, those of fixed pieces of one alone as
    well: those of both are their `fixed_surfaces`.
    """
    fixed_there, fixed_here = (
        {part.seed for road in drives.roads for part in _parts(road) if isinstance(part, FixedSeed)}
        for drives in (one, other)
    )
    of_one, of_other = one.all_seeds, other.all_seeds
    return sorted(of_one & (of_other | fixed_here) | fixed_there & of_other)


def repeated_road(drives: DriveSet) -> str | None:
    """Return the kind of an uneven road that no seed varies and that is driven twice: at several
    seeds, or as another of the list is made of the same surfaces. None if there is none.
    """
    found: list[set[str]] = []
    for road in drives.roads:
        surfaces = fixed_surfaces([road])
        if surfaces and not _is_random(road):
            if len(drives.seeds) > 1 or surfaces in found:
                return type(road).__name__
            found.append(surfaces)
    return None


def _parts(road: Road) -> list[Road]:
    """Return the roads that a road is made of: itself, if of no other."""
    if isinstance(road, Flat):
        return []
    inner = getattr(road, "roads", ()) or ([road.road] if hasattr(road, "road") else [])
    if isinstance(road, FixedSeed) or not inner:
        return [road]
    return [part for one in inner for part in _parts(one)]


def _is_random(road: Road) -> bool:
    """Return whether a road's surface depends on the seed."""
    first, second = (road.realise(np.random.default_rng(seed)).z for seed in (0, 1))
    return not np.array_equal(first, second)


def _described(road: Road) -> str:
    """Return the settings of a road but for its length, or the content of its file."""
    if isinstance(road, Measured):
        return digest_of(road.path)
    if isinstance(road, FixedSeed):
        return f"{road.seed} {[_described(part) for part in _parts(road.road)]}"
    names = [f.name for f in dataclasses.fields(road) if f.name != "length"]  # type: ignore[arg-type]
    return f"{type(road).__name__} {[(name, getattr(road, name)) for name in names]}"
