"""Surfaces that do not depend on a seed, of which roads of a task are made.

A road is compared by what it is made of: a piece of a surface, one between aprons, scaled or
altered is of that surface, too. Names and settings count for nothing, the heights alone.
"""

import itertools
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import numpy as np
import scipy

from leaderboard.evaluation.drive_set import DriveSet
from road_envs.roads import Road
from road_envs.roads.composite import FixedSeed, Flat
from road_envs.roads.measured import Measured

_SPACING = 0.01  # between the heights that are compared [m]; most tables have a multiple of it
_LEAST_CORRELATION = 0.98
"""Two surfaces are one from here; half sines 5 % apart in length have 0.96, raised cosines 0.95."""

_ALIKE = 0.9
"""The same of two surveys: 0.94 with noise of 1 mm on class B. Unlike ones of 3 m have up to 0.89,
directions and sides exchanged; single paths of 20 m have up to 0.67, but of 5 m up to 0.96.
"""

_LONG = 2_000  # heights, 20 m, from which single wheel paths of two surveys are compared
_LEVEL = 1e-9  # differences of rises [m] up to which a path has one slope

_NOISE, _HILL = 50, 500
"""Heights, over 0.5 and 5 m, in means without the noise of a survey, and in those of its hills."""


@dataclass(frozen=True, eq=False)
class _FixedSurface:
    """A surface that no seed varies: the `rises` (2, N) [m] of its wheel paths within _SPACING, and
    the `seed` of a draw. One that `is_surveyed` comes from a file.

    It equals a piece or a scaled copy of itself, whatever the direction and the sides, and another
    survey of the same road or of one of its wheel paths. Draws are one if their seeds are, whatever
    their roads: the same random numbers make the roads of a kind.
    """

    rises: np.ndarray
    seed: int | None = None
    is_surveyed: bool = False

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _FixedSurface):
            return NotImplemented
        if None not in (self.seed, other.seed):
            return self.seed == other.seed
        if not (self.is_surveyed and other.is_surveyed):
            return _are_alike(self.rises, other.rises, _LEAST_CORRELATION)
        is_long = min(self.rises.shape[1], other.rises.shape[1]) >= _LONG
        compare = _share_a_path if is_long else _are_alike
        return compare(self.rises, other.rises, _LEAST_CORRELATION) or compare(
            _waves(self.rises), _waves(other.rises), _ALIKE
        )


def _fixed_surfaces(roads: Iterable[Road]) -> list[_FixedSurface]:
    """Return the uneven surfaces of `roads` that no seed varies, each once."""
    found: list[_FixedSurface] = []
    for part in (part for road in roads for part in _parts(road)):
        seed = part.seed if isinstance(part, FixedSeed) else None
        if seed is None and _is_random(part):
            continue
        surface = part.realise(np.random.default_rng(0))
        s = np.arange(surface.start, surface.end + _SPACING, _SPACING)
        rises = np.diff([np.interp(s, surface.s, path) for path in surface.z])
        one = _FixedSurface(rises, seed, isinstance(part, Measured))
        if np.ptp(one.rises, axis=1).any() and one not in found:
            found.append(one)
    return found


def share_a_surface(some: Iterable[Road], others: Iterable[Road]) -> bool:
    """Return whether some roads are made of surfaces of which others are."""
    found = _fixed_surfaces(some)
    return bool(found) and any(surface in found for surface in _fixed_surfaces(others))


def shared_seeds(one: DriveSet, other: DriveSet) -> list[int]:
    """Return the seeds by which roads of both sets are drawn, those of fixed pieces of one alone as
    well: those of both are their `_fixed_surfaces`.
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
    found: list[list[_FixedSurface]] = []
    for road in drives.roads:
        surfaces = _fixed_surfaces([road])
        if surfaces and not _is_random(road):
            same = (x for x in found if len(x) == len(surfaces) and all(y in x for y in surfaces))
            if len(drives.seeds) > 1 or any(same):
                return type(road).__name__
            found.append(surfaces)
    return None


def _parts(road: Road) -> list[Road]:
    """Return the roads that a road is made of; of a draw, itself and what of it no seed varies."""
    if isinstance(road, Flat):
        return []
    inner = getattr(road, "roads", ()) or ([road.road] if hasattr(road, "road") else [])
    if not inner:
        return [road]
    parts = [part for one in inner for part in _parts(one)]
    if isinstance(road, FixedSeed) and _is_random(road.road):
        return [road, *(x for x in parts if isinstance(x, FixedSeed) or not _is_random(x))]
    return parts


def _is_random(road: Road) -> bool:
    """Return whether a road's surface depends on the seed."""
    return _varies(cast(Hashable, road))  # as it is frozen


@cache  # one of 100 km takes seconds, and is asked for several times
def _varies(road: Any) -> bool:
    first, second = (road.realise(np.random.default_rng(seed)).z for seed in (0, 1))
    return not np.array_equal(first, second)


def _waves(rises: np.ndarray) -> np.ndarray:
    """Return what waves of about 1 to 10 m have of `rises` (2, N), as two surveys agree on them."""

    def means(x: np.ndarray, number: int) -> np.ndarray:
        return np.asarray(scipy.ndimage.uniform_filter1d(x, number, axis=1, mode="nearest"))

    kept = means(means(rises, _NOISE), _NOISE)
    return kept - means(kept, _HILL)


def _share_a_path(one: np.ndarray, other: np.ndarray, least: float) -> bool:
    """Return whether a wheel path of both surfaces, of rises (2, N), is alike."""
    uneven = ([x[None] for x in rises if np.ptp(x) > _LEVEL] for rises in (one, other))
    return any(_are_alike(x, y, least) for x, y in itertools.product(*uneven))


def _are_alike(one: np.ndarray, other: np.ndarray, least: float) -> bool:
    """Return whether the rises (P, N) of P wheel paths correlate by at least that, on either side
    and in either direction: a road that is driven back falls where it rose.
    """
    ways = [other, other[:, ::-1]]
    if len(other) > 1:
        ways += [way[::-1] for way in ways]
    return any(_largest_correlation(one, way) >= least for way in ways)


def _largest_correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest correlation, without its sign, of the rises (P, N) of the shorter surface
    with as long a piece of the other, which is level beyond its ends; both less their mean, the
    slope of a hill.
    """
    short, long = sorted((one, other), key=np.size)
    short = short - short.mean(axis=1, keepdims=True)
    n = short.shape[1]

    def sums(x: np.ndarray) -> np.ndarray:
        running = np.cumsum(np.pad(x, ((0, 0), (n, n - 1))), axis=1)
        return running[:, n:] - running[:, :-n]

    shared = scipy.signal.fftconvolve(long, short[:, ::-1], axes=1).sum(axis=0)
    power = np.sum(sums(long**2) - sums(long) ** 2 / n, axis=0)
    power = np.maximum(power, 1e-6 * power.max())  # rounding errors, where a piece is level
    return float(np.max(np.abs(shared) / np.sqrt(power * np.sum(short**2))))
