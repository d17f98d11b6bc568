"""Roads from measured surfaces: OpenCRG and ERD files, or tables of distance and height.

The wheel paths of a grid are `track` apart and symmetric about the line `centre`, with linear
interpolation between the long sections. A path with missing heights is an error unless gaps are to
be interpolated along it. Station 0 is the first sample, and both paths start at height 0. A surface
that is shorter than the road is used as a tile: mirrored, or repeated after subtraction of the line
from its first to its last height, so that the ends meet.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from road_envs.core.config import Finite, NonNegative, Positive, Settings
from road_envs.core.reading import parsing, regular
from road_envs.records.roughness import TRACK, TrackWidth
from road_envs.roads.formats import erd, opencrg, table
from road_envs.roads.formats.opencrg import CurvedGrid, SurfaceFileError, require
from road_envs.roads.formats.table import WheelPaths
from road_envs.roads.surface import Surface, check_size

SURFACE_SUFFIXES = (".crg", ".erd", ".parquet", ".csv", ".txt", ".dat")
SIDE_NAMES = ("left", "right")


@dataclass(frozen=True, kw_only=True)
class Measured(Settings):
    """A surface file as a road. The file is read on construction; raises SurfaceFileError."""

    path: Annotated[str, "", "the file; relative to the YAML file that names it"]
    length: Annotated[NonNegative, "m", "length of the road; 0: length of the surface"] = 0.0
    repeat: Annotated[Literal["none", "repeat", "mirror"], "", "use of a short surface"] = "none"
    centre: Annotated[Finite | None, "m", "v midway between the paths; default: of the grid"] = None
    track: TrackWidth = TRACK
    bridge_gaps: Annotated[bool, "", "interpolate missing heights along the path"] = False
    min_length: Annotated[Positive, "m", "least length of the surface"] = 2.794  # a wheelbase

    def __post_init__(self):
        super().__post_init__()
        with parsing(self.path, SurfaceFileError, "damaged"):
            natural = self._tile.length
            if natural < self.min_length:
                raise SurfaceFileError(
                    f"the surface is {natural:.2f} m long, shorter than min_length = "
                    f"{self.min_length:g} m"
                )
            object.__setattr__(self, "length", self.length or natural)
            if self.repeat == "none" and self.length > natural * (1.0 + 1e-9):
                raise SurfaceFileError(
                    f"the surface is {natural:.2f} m long, shorter than length = "
                    f"{self.length:g} m; set repeat to mirror or repeat"
                )
        check_size(self.length, self._tile.ds)

    def realise(self, rng: np.random.Generator) -> Surface:
        tile = self._tile
        size = round(self.length / tile.ds) + 1
        z, notes = tile.z[:, :size], tile.notes
        if size > tile.z.shape[1]:
            z, note = tile_heights(tile.z, tile.ds, size, self.repeat)
            notes = (*notes, note)
        return Surface(z - z[:, :1], tile.ds, name=tile.name, notes=notes)

    @cached_property
    def _tile(self) -> Surface:
        """The surface in the file, with gaps interpolated if allowed."""
        z, ds, notes, _ = self._contents
        require(z.shape[1] >= 4, f"at least 4 stations are required, got {z.shape[1]}")
        z, gap_notes = _fill_gaps(z, ds, self.bridge_gaps)
        if np.allclose(z[0], z[1], rtol=0.0, atol=1e-9):
            notes = (*notes, "left and right wheel path are the same")
        return Surface(z, ds, name=Path(self.path).stem, notes=(*notes, *gap_notes))

    @property
    def first_station(self) -> float:
        """Station [m] of the first sample in the file, which is station 0 of the road."""
        return self._contents.start

    @cached_property
    def _contents(self) -> WheelPaths:
        match Path(self.path).suffix.lower():
            case ".crg":
                grid = opencrg.parse(regular(self.path).read_bytes())
                return _wheel_paths(grid, self.centre, self.track)
            case ".erd":
                return erd.read(self.path)
            case ".parquet":
                return table.parse_parquet(regular(self.path).read_bytes())
            case ".csv" | ".txt" | ".dat":
                return table.parse_text(regular(self.path).read_bytes())
        raise SurfaceFileError(
            f"the name of a surface file must end in {', '.join(SURFACE_SUFFIXES)}"
        )


def _wheel_paths(grid: CurvedGrid, centre: float | None, track: float) -> WheelPaths:
    """Return both wheel paths of a grid, half a `track` [m] to either side of v = `centre` [m]."""
    v = grid.v
    middle = 0.5 * (v[0] + v[-1]) if centre is None else centre
    z = np.empty((2, len(grid.z)))
    for side, v_path in enumerate((middle + 0.5 * track, middle - 0.5 * track)):
        if not v[0] - 1e-9 <= v_path <= v[-1] + 1e-9:
            raise SurfaceFileError(
                f"the {SIDE_NAMES[side]} wheel path at v = {v_path:.3g} m is off the grid, "
                f"which spans {v[0]:.3g} to {v[-1]:.3g} m; choose another centre or track"
            )
        k = int(np.clip(np.searchsorted(v, v_path) - 1, 0, v.size - 2))
        share = round((v_path - v[k]) / (v[k + 1] - v[k]), 9)
        # a section of weight 0 is skipped, as its heights may be missing (NaN)
        z[side] = sum(w * grid.z[:, k + j] for j, w in enumerate((1.0 - share, share)) if w)
    start = (f"station 0 is u = {grid.u_start:g} m",) if grid.u_start else ()
    return WheelPaths(z, grid.du, (*start, *grid.notes), grid.u_start)


def _fill_gaps(z: np.ndarray, ds: float, allowed: bool) -> tuple[np.ndarray, list[str]]:
    """Return wheel paths `z` (2, N) with missing heights interpolated, if `allowed`, and notes."""
    z, notes = z.copy(), []
    k = np.arange(z.shape[1])
    for side, path in zip(SIDE_NAMES, z, strict=True):
        missing = np.isnan(path)
        if not (count := int(missing.sum())):
            continue
        first = ds * int(np.argmax(missing))
        if not allowed or count == path.size:
            raise SurfaceFileError(
                f"{count} of {path.size} heights of the {side} wheel path are missing, the first "
                f"at station {first:.2f} m; to interpolate them, describe the road in a YAML file "
                "with kind: measured, path: ... and bridge_gaps: true, or choose another centre"
            )
        path[missing] = np.interp(k[missing], k[~missing], path[~missing])
        edges = np.flatnonzero(np.diff(np.r_[False, missing, False]))
        longest = ds * int((edges[1::2] - edges[::2]).max())
        filled = f"interpolated {count} missing heights of the {side} wheel path"
        notes.append(f"{filled}, longest gap {longest:.2f} m")
    return z, notes


def tile_heights(z: np.ndarray, ds: float, size: int, repeat: str) -> tuple[np.ndarray, str]:
    """Return a tile `z` (2, N) repeated or mirrored to `size` samples, and a note."""
    steps = z.shape[1] - 1
    times = -(-(size - 1) // steps)
    k = np.arange(size)
    note = f"{steps * ds:.2f} m tile {{}} {times} times to {(size - 1) * ds:g} m"
    if repeat == "mirror":
        k %= 2 * steps
        return z[:, np.minimum(k, 2 * steps - k)], note.format("mirrored")
    rise = z[:, -1:] - z[:, :1]
    closed = z - rise * np.linspace(0.0, 1.0, steps + 1)
    left, right = 1e3 * rise[:, 0]
    removed = f", its rise of {left:.1f} and {right:.1f} mm removed"
    return closed[:, k % steps], note.format("repeated") + removed
