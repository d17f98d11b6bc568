"""Long drives section by section, and estimates of sections that are kept until a report is done.

A drive is cut at equal distances into sections of about _SECTION, each of which is estimated as a
drive of its own from _RUN_IN before it to _RUN_OUT behind it. Their stations are those of the whole
drive, and each road goes on at the height at which the one before it ends. So memory is that of one
section, and a report that is interrupted has lost no more than the section at which it was.

Where the vehicle is fitted to the drive it is fitted to each section, which takes as long as the
estimate of some kilometres: these sections are longer.
"""

import base64
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimators.api import Estimator, HasInstruments, check_estimate, copy_with
from estimators.common.odometer import Odometer, calibrate_odometer
from estimators.map_smoother.estimator import MapSmoother
from estimators.preprocessing import LATE_START
from leaderboard.entries.entries import make_entry
from leaderboard.entries.entry import EntryError
from road_envs.core.artifacts import Kind
from road_envs.core.atomic_io import remove_stale_partials
from road_envs.records.record import (
    PROFILE_SPACING,
    DistanceScale,
    Estimate,
    Record,
    profile_stations,
)
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters

_SECTION, _FITTED_SECTION = 2000.0, 10_000.0  # lengths [m], about; the second with a fitted vehicle
_RUN_IN, _RUN_OUT = 150.0, 50.0  # [m] before and behind a section that are estimated with it
KEPT = "unfinished"  # folder of kept sections in that of a report
_KIND = Kind("drive section", 2, ("leaderboard.drive_report.sections", "estimators.registry"))
_ARRAYS = ("z", "z_std", "unsure", "draws")  # kept as arrays, by station in the last axis


class _DriveSection(NamedTuple):
    """A section of a drive: its samples `begin` to `end` (excluded), the index `first` of the
    station that is the first of its own road, and the index `start` of the one at which it begins.
    """

    begin: int
    end: int
    first: int
    start: int

    def of(self, record: Record) -> Record:
        """Return the record of the section, whose road begins at its own station 0."""
        part, shift = record.select(slice(self.begin, self.end)), PROFILE_SPACING * self.first
        end = record.length if self.end == record.t.size else float(part.s[-1])
        return replace(part, t=part.t - part.t[0], s=part.s - shift, length=end - shift)


def split(record: Record, wheelbase: float, length: float = _SECTION) -> list[_DriveSection]:
    """Return the sections of a record, one if it is short or its odometer is not finite."""
    whole = [_DriveSection(0, record.t.size, 0, 0)]
    if not np.isfinite(record.s).all():
        return whole
    s = np.maximum.accumulate(record.s)
    begin, end = max(float(s[0]), 0.0), min(float(s[-1]), record.length)
    if (count := round((end - begin) / length)) < 2:
        return whole
    edges = np.linspace(begin, end, count + 1)[1:-1]
    begins, ends = np.searchsorted(s, edges - _RUN_IN), np.searchsorted(s, edges + _RUN_OUT)
    firsts = ((s[begins] - wheelbase) / PROFILE_SPACING).astype(int)
    starts = np.round(edges / PROFILE_SPACING).astype(int)
    columns = [begins, [*ends[1:], record.t.size], firsts, starts]
    rows = [_DriveSection(*map(int, row)) for row in zip(*columns, strict=True)]
    return [whole[0]._replace(end=int(ends[0])), *rows]


def join(parts: Sequence[Estimate], sections: Sequence[_DriveSection], length: float) -> Estimate:
    """Return the estimate of a road of `length` [m] from those of its sections.

    Notes that differ in their numbers alone are one, with those of the section that the model
    explains worst.
    """
    if len(parts) == 1:
        return parts[0]
    s = profile_stations(length)
    spans = list(zip(sections, [*(x.start for x in sections[1:]), s.size], strict=True))

    def joined(rows: Sequence[np.ndarray], *, is_height: bool) -> np.ndarray:
        whole = np.empty((*rows[0].shape[:-1], s.size), rows[0].dtype)
        end_height, level = rows[0][..., 0], 0.0 * rows[0][..., 0]
        for x, (section, end) in zip(rows, spans, strict=True):
            begin = section.start - section.first
            if is_height:
                level = level + end_height - x[..., begin]
                end_height = x[..., min(end - section.first, x.shape[-1] - 1)]
            whole[..., section.start : end] = (
                x[..., begin : end - section.first] + level[..., None] * is_height
            )
        return whole

    count = min((len(part.draws) for part in parts if part.draws is not None), default=0)
    rows: dict[str, list[Any]] = {
        "z": [part.z for part in parts],
        "z_std": [part.z_std for part in parts],
        "draws": [part.draws if part.draws is None else part.draws[:count] for part in parts],
    }
    if any(part.unsure is not None and part.unsure.any() for part in parts):
        rows["unsure"] = [np.zeros(x.s.size, bool) if x.unsure is None else x.unsure for x in parts]
    arrays: dict[str, Any] = {
        name: joined(values, is_height=name in ("z", "draws"))
        for name, values in rows.items()
        if all(x is not None for x in values)
    }
    residuals = [part.residual for part in parts if part.residual is not None]
    distance, scales = None, [part.distance for part in parts if part.distance]
    if scales:  # means weighted by inverse variance, as their errors have common causes
        weights = [1.0 / one.std**2 for one in scales]
        distance = DistanceScale(*(float(x) for x in np.average(scales, axis=0, weights=weights)))
    return Estimate(
        s, **arrays, notes=_joined_notes(parts, sections, length), distance=distance,
        residual=max(residuals, default=None),
    )  # fmt: skip


def _joined_notes(
    parts: Sequence[Estimate], sections: Sequence[_DriveSection], length: float
) -> tuple[str, ...]:
    alike: dict[str, list[tuple[float, int, str]]] = {}
    for k, part in enumerate(parts):
        for note in part.notes:
            if not (k and LATE_START in note):
                wording = re.sub(r"[\d.]+", "#", note)
                alike.setdefault(wording, []).append((part.residual or 0.0, k, note))
    stations, notes = [PROFILE_SPACING * x.start for x in sections] + [length], []
    for found in alike.values():
        _, k, note = max(found)
        if len({text for *_, text in found}) > 1 or len(found) < len(parts):
            others = f"; the worst of {len(found)} such sections" if len(found) > 1 else ""
            where = f" ({stations[k]:.0f} to {stations[k + 1]:.0f} m{others})"
            note += "" if LATE_START in note else where
        notes.append(note)
    return tuple(notes)


@dataclass(frozen=True)
class Sections:
    """Estimation of drives by sections, which are kept in a `folder` if there is one.

    `told` takes what is being done and the share of the drive that is done; `said` takes a
    sentence on what was kept.
    """

    folder: Path | None = None
    told: Callable[[str, float], None] = lambda text, share: None
    said: Callable[[str], None] = lambda sentence: None

    def estimator(self, one: Estimator) -> Estimator:
        """Return an estimator that estimates by sections, and is as `one` in all else."""
        return copy_with(one, estimate=partial(self._estimate, one))

    def clear(self) -> None:
        """Remove what was kept: the report is done."""
        if self.folder is not None and self.folder.is_dir():
            remove_stale_partials(self.folder)
            for path in self.folder.glob("*.json"):
                path.unlink()
            if not any(self.folder.iterdir()):
                self.folder.rmdir()

    def _estimate(self, one: Estimator, record: Record, car: VehicleParameters) -> Estimate:
        length = np.inf  # the others need a small part of its time, and tell stations in notes
        if isinstance(one, MapSmoother):
            length = _FITTED_SECTION if one.adapt else _SECTION
        sections, odometer = split(record, car.wheelbase, length), Odometer(record)
        if len(sections) > 1:  # a section does not tell where its odometer was right
            odometer = calibrate_odometer(record)
            record = odometer.record
        records = [section.of(record) if len(sections) > 1 else record for section in sections]
        paths = [self._path(one, part, car) for part in records]
        parts = {}
        for k, (path, part) in enumerate(zip(paths, records, strict=True)):
            if path and (estimate := self._read(path, part)):
                parts[k], latest = estimate, path.stat().st_mtime
        if parts:
            when = datetime.fromtimestamp(latest).strftime("%H:%M")
            self.said(f"kept from {when}: {len(parts)} of {len(sections)} sections")
        missing = [k for k in range(len(sections)) if k not in parts]
        for number, k in enumerate(missing):
            several = f", section {k + 1} of {len(sections)}" if len(sections) > 1 else ""
            self.told(several, number / len(missing))
            parts[k] = one.estimate(records[k], car)
            check_estimate(parts[k], records[k])
            if path := paths[k]:
                _KIND.write(path, _plain(parts[k]), path.stem)
        joined = join([parts[k] for k in range(len(sections))], sections, record.length)
        return odometer.describe(joined)

    def _path(self, one: Estimator, record: Record, car: VehicleParameters) -> Path | None:
        """Return the file of the estimate of a record, named by the digest of all that it is of."""
        if self.folder is None:
            return None
        try:
            total, entry = hashlib.sha256(), make_entry("section", one)
        except EntryError:  # its code cannot be read, and so not be told from another
            return None
        for x in (record.t, record.a, record.v, record.s, record.commands):
            total.update(np.ascontiguousarray(x).tobytes())
        own = load_instruments(one.instruments) if isinstance(one, HasInstruments) else None
        described = [record.length, record.sensors, record.low_pass, own, car]
        inputs = [total.hexdigest(), entry.reference, entry.settings, entry.code]
        return self.folder / f"{_KIND.identity(*inputs, *map(repr, described))}.json"

    def _read(self, path: Path, record: Record) -> Estimate | None:
        """Return the estimate that is kept in a file; None if it is damaged or another's."""

        def make(content: Mapping[str, Any]) -> Estimate:
            estimate = _from_plain(content, record)
            check_estimate(estimate, record)
            return estimate

        return _KIND.find(path, path.stem, make)


def _plain(estimate: Estimate) -> dict[str, Any]:
    """Return what is kept of an estimate, as JSON types; arrays are their bytes in base 64."""
    plain = {name: getattr(estimate, name) for name in ("residual", "s_std", "distance", "notes")}
    for name in _ARRAYS:
        if (x := getattr(estimate, name)) is not None:
            plain[name] = [x.dtype.str, x.shape, base64.b64encode(x.tobytes()).decode()]
    return plain


def _from_plain(content: Mapping[str, Any], record: Record) -> Estimate:
    arrays: dict[str, Any] = {}
    for name in content.keys() & set(_ARRAYS):
        kind, shape, text = content[name]
        arrays[name] = np.frombuffer(base64.b64decode(text), kind).reshape(shape)
    distance = content["distance"]
    return Estimate(
        profile_stations(record.length), **arrays, notes=tuple(content["notes"]),
        residual=content["residual"], s_std=content["s_std"],
        distance=distance and DistanceScale(*distance),
    )  # fmt: skip
