"""A measured surface as a road: OpenCRG and ERD files, or tables of distance and height.

From a grid the wheel paths are taken `track` apart about the line `centre`, between the sections
by linear interpolation; a path that would touch a missing height is refused, or bridged along the
track when asked. Station 0 is the first sample, and both paths start at 0.

A surface shorter than the road wanted is a tile, laid end to end: mirrored, or repeated after the
line from its first to its last height has been taken away, so that the ends meet.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from road_envs.config import STRICT
from road_envs.roads.formats import erd, opencrg, table
from road_envs.roads.formats.opencrg import CurvedGrid, SurfaceFileError, error_context, read_bytes
from road_envs.roads.formats.table import WheelPaths
from road_envs.roads.surface import Surface
from road_envs.roads.validation import check_positive, check_size

DEFAULT_MIN_LENGTH = 2.794
"""The default of `min_length` [m]."""
SURFACE_SUFFIXES = (".crg", ".erd", ".parquet", ".csv", ".txt", ".dat")
SIDE_NAMES = ("left", "right")


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A file as a road. Raises SurfaceFileError at once if the file cannot be used."""

    __pydantic_config__ = STRICT

    path: Annotated[str, "", "the file; in a YAML file relative to that file"]
    length: Annotated[float, "m", "length of the road; 0: that of the surface"] = 0.0
    repeat: Annotated[Literal["none", "repeat", "mirror"], "", "how a short tile is laid"] = "none"
    centre: Annotated[float | None, "m", "v midway between the paths; none: of the grid"] = None
    track: Annotated[float, "m", "distance of the wheel paths"] = 1.5
    bridge_gaps: Annotated[bool, "", "interpolate along the track where heights miss"] = False
    min_length: Annotated[float, "m", "a shorter surface is refused"] = DEFAULT_MIN_LENGTH

    def __post_init__(self):
        check_positive(self, "track", "min_length")
        with error_context(self.path):
            natural = self._tile.length
            if natural < self.min_length:
                raise SurfaceFileError(
                    f"the surface is {natural:.2f} m long, shorter than the {self.min_length:g} m "
                    "that a vehicle stands on (min_length)"
                )
            object.__setattr__(self, "length", self.length or natural)
            if self.repeat == "none" and self.length > natural * (1.0 + 1e-9):
                raise SurfaceFileError(
                    f"the surface is {natural:.2f} m long, shorter than the {self.length:g} m "
                    "wanted; set repeat to mirror or repeat"
                )
        check_positive(self, "length")
        check_size(self.length, self._tile.ds)

    def realise(self, rng: np.random.Generator) -> Surface:
        """The surface; there is nothing to draw."""
        tile = self._tile
        size = round(self.length / tile.ds) + 1
        z, notes = tile.z[:, :size], tile.notes
        if size > tile.z.shape[1]:
            z, note = tile_heights(tile.z, tile.ds, size, self.repeat)
            notes = (*notes, note)
        return Surface(z - z[:, :1], tile.ds, name=tile.name, notes=notes)

    @cached_property
    def _tile(self) -> Surface:
        """The file as it is."""
        z, ds, notes = self._read()
        if z.shape[1] < 4:
            raise SurfaceFileError(f"at least 4 stations are wanted, got {z.shape[1]}")
        z, gap_notes = fill_gaps(z, ds, self.bridge_gaps)
        if np.allclose(z[0], z[1], rtol=0.0, atol=1e-9):
            notes = (*notes, "left and right wheel path are the same")
        return Surface(z, ds, name=Path(self.path).stem, notes=(*notes, *gap_notes))

    def _read(self) -> WheelPaths:
        match Path(self.path).suffix.lower():
            case ".crg":
                grid = opencrg.parse(read_bytes(self.path))
                return wheel_paths(grid, self.centre, self.track)
            case ".erd":
                return erd.read(self.path)
            case ".parquet":
                return table.parse_parquet(read_bytes(self.path))
            case ".csv" | ".txt" | ".dat":
                return table.parse_text(read_bytes(self.path))
        raise SurfaceFileError(f"a surface file ends in {', '.join(SURFACE_SUFFIXES)}")


def wheel_paths(grid: CurvedGrid, centre: float | None, track: float) -> WheelPaths:
    """Both wheel paths, half a `track` [m] to either side of v = `centre` [m]."""
    v = grid.v
    middle = 0.5 * (v[0] + v[-1]) if centre is None else centre
    z = np.empty((2, len(grid.z)))
    for side, at in enumerate((middle + 0.5 * track, middle - 0.5 * track)):
        if not v[0] - 1e-9 <= at <= v[-1] + 1e-9:
            raise SurfaceFileError(
                f"the {SIDE_NAMES[side]} wheel path at v = {at:.3g} m is off the grid, "
                f"which spans {v[0]:.3g} to {v[-1]:.3g} m"
            )
        k = int(np.clip(np.searchsorted(v, at) - 1, 0, v.size - 2))
        share = round((at - v[k]) / (v[k + 1] - v[k]), 9)
        parts = [w * grid.z[:, k + j] for j, w in enumerate((1.0 - share, share)) if w]
        z[side] = sum(parts)
    start = (f"station 0 is u = {grid.u_start:g} m",) if grid.u_start else ()
    return z, grid.du, (*start, *grid.notes)


def fill_gaps(z: np.ndarray, ds: float, allowed: bool) -> tuple[np.ndarray, list[str]]:
    """Wheel paths `z` (2, N) with missing heights interpolated, if `allowed`; and notes."""
    z, notes = z.copy(), []
    k = np.arange(z.shape[1])
    for side, path in zip(SIDE_NAMES, z, strict=True):
        missing = np.isnan(path)
        count = int(missing.sum())
        if not count:
            continue
        first = ds * int(np.argmax(missing))
        if not allowed or count == path.size:
            raise SurfaceFileError(
                f"{count} of {path.size} heights of the {side} wheel path are missing, the first "
                f"at station {first:.2f} m; choose another centre or set bridge_gaps"
            )
        path[missing] = np.interp(k[missing], k[~missing], path[~missing])
        edges = np.flatnonzero(np.diff(np.r_[False, missing, False]))
        longest = ds * int((edges[1::2] - edges[::2]).max())
        notes.append(
            f"bridged {count} heights of the {side} wheel path, at most {longest:.2f} m at once"
        )
    return z, notes


def tile_heights(z: np.ndarray, ds: float, size: int, repeat: str) -> tuple[np.ndarray, str]:
    """A tile `z` (2, N) laid end to end to `size` samples, and a note of how."""
    steps = z.shape[1] - 1
    times = -(-(size - 1) // steps)
    k = np.arange(size)
    what = f"{steps * ds:.2f} m tile {{}} {times} times to {(size - 1) * ds:g} m"
    if repeat == "mirror":
        k %= 2 * steps
        return z[:, np.minimum(k, 2 * steps - k)], what.format("mirrored")
    rise = z[:, -1:] - z[:, :1]
    closed = z - rise * np.linspace(0.0, 1.0, steps + 1)
    left, right = 1e3 * rise[:, 0]
    note = f"{what.format('repeated')}, its rise of {left:.1f} and {right:.1f} mm taken away"
    return closed[:, k % steps], note
