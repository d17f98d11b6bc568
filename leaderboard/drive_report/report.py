"""A report of one or more drives: estimates, one road of all passes, and the files of the page."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import estimators
from estimators.roughness.tolerance_error import roughness_std
from leaderboard.drive_report.analysis import SEGMENT_LENGTHS, DriveResult, KnownFactor, analyse
from leaderboard.drive_report.conditions import Conditions
from leaderboard.drive_report.drive_estimates import estimate_drive, make_drive_estimator
from leaderboard.drive_report.export import write_files
from leaderboard.drive_report.geopackage import write_geopackage
from leaderboard.drive_report.known_iri import Stretch, known_factor
from leaderboard.drive_report.mean_path import golden_weight, tells_vehicle
from leaderboard.drive_report.page import write_page
from leaderboard.drive_report.passes import ReportedPass, align_passes, compare, join
from leaderboard.drive_report.sections import Sections
from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.description import DriveDescription
from road_envs.drives.reading import DriveFile, same_instruments
from road_envs.sensing.instruments import instruments_of, load_instruments

_DEFAULT_FACTOR_STD = 0.06  # of a factor whose own is not given, as measured in `known_iri`
_Progress = Callable[[str, float], None]  # takes what is being done and the share done, 0 to 1


@dataclass(frozen=True, kw_only=True)
class ReportSettings:
    """Settings of a report: an estimator with its settings, categories, segments [m], stretches of
    known IRI if there are any, and for HPMS the route with the mile where the drives begin. A
    `fast` report fits no vehicle to its drives.
    """

    conditions: Conditions
    estimator: str = "map_smoother"
    settings: dict[str, Any]
    fast: bool = False
    segment: float = 100.0
    known_iri: Sequence[Stretch] | None = None
    route: tuple[str, float] | None = None

    def __post_init__(self):
        if self.segment not in SEGMENT_LENGTHS:
            allowed = ", ".join(f"{x:g}" for x in SEGMENT_LENGTHS)
            raise ConfigError(f"--segment must be one of {allowed} m, got {self.segment:g} m")


@dataclass(frozen=True, kw_only=True)
class _RoadReport:
    """Results by drive, the road of all passes if there are several, and their agreement."""

    drives: list[DriveResult]
    road: DriveResult | None
    agreement: dict[str, Any] | None
    vehicle: str
    sensors: str
    descriptions: list[DriveDescription]

    @property
    def results(self) -> list[DriveResult]:
        """All results, that of the road of all passes first."""
        return [*([self.road] if self.road else []), *self.drives]


def make_report(
    drives: Sequence[DriveFile],
    chosen: ReportSettings,
    progress: _Progress,
    sections: Sections | None = None,
) -> _RoadReport:
    """Return the report of drives; several are passes over one road where they match.

    Long drives are estimated by `sections`, which are kept if these have a folder.
    Raises ConfigError, RecordError.
    """
    sensors = same_instruments(drives)
    records, names = [d.measured.record for d in drives], [d.label for d in drives]
    estimators.passes.refuse_repetitions(records, names)
    read, one = [], None
    metres = [max(record.length, 1.0) for record in records]
    for k, drive in enumerate(drives):
        begin, share = (0.95 * x / sum(metres) for x in (sum(metres[:k]), metres[k]))
        told = _within(progress, f"estimating {drive.name}", begin, share)
        part = replace(sections or Sections(), told=told)
        one = make_drive_estimator(chosen.estimator, drive, chosen.settings, chosen.fast)
        drive, found = estimate_drive(one, drive, part)
        read.append(ReportedPass(drive.name, drive.measured, found))
    assert one is not None
    passes = align_passes(read)
    progress("joining the passes" if len(drives) > 1 else "writing the report", 0.95)
    joined = join(one, passes, [drive.car for drive in drives])
    passes = list(map(_with_factor_told, passes, drives))
    results = list(map(_analysed, passes, drives, repeat(chosen)))
    if chosen.known_iri is not None:
        known, note = known_factor(results[0], chosen.known_iri)
        mounts = [(drive.vehicle, drive.description.at, drive.sensors) for drive in drives]
        drives = list(drives)
        for k in (k for k, mount in enumerate(mounts) if mount == mounts[0]):
            drives[k], passes[k] = _with_factor(drives[k], known), passes[k].with_note(note)
        results = list(map(_analysed, passes, drives, repeat(chosen)))
    compared = [r for r, p in zip(results, passes, strict=True) if p.aligned]
    return _RoadReport(
        drives=results,
        road=_analysed(joined, drives[0], chosen) if joined else None,
        agreement=compare(compared),
        descriptions=[drive.description for drive in drives],
        vehicle=", ".join(dict.fromkeys(drive.car.name for drive in drives)),
        sensors=sensors,
    )


def _within(progress: _Progress, what: str, begin: float, share: float) -> _Progress:
    """Return the progress of a part that begins at `begin` and has this `share` of the whole."""
    return lambda text, done: progress(what + text, begin + share * done)


def _with_factor_told(each: ReportedPass, drive: DriveFile) -> ReportedPass:
    """Return a pass with a note of the factor that its description has, if any."""
    if (factor := drive.description.iri_factor) is None:
        return each
    return each.with_note(
        f"every IRI is multiplied by {factor:.3g}, the factor that the description has of this car "
        "and its mount"
    )


def _with_factor(drive: DriveFile, known: KnownFactor) -> DriveFile:
    factor = (drive.description.iri_factor or 1.0) * known.factor
    described = drive.description.updated(iri_factor=factor, iri_factor_std=known.std)
    return drive._replace(description=described)


def _analysed(each: ReportedPass, drive: DriveFile, chosen: ReportSettings) -> DriveResult:
    record, distance, told = each.measured.record, each.estimate.distance, drive.description
    instruments = instruments_of(record, drive.sensors)
    known, tolerance_std = None, 0.0
    if not tells_vehicle(record.sensors):
        tolerance_std = roughness_std(record, drive.car, drive.sensors, golden_weight)
    if told.iri_factor is not None:
        known = KnownFactor(told.iri_factor, told.iri_factor_std or _DEFAULT_FACTOR_STD)
    return analyse(
        each.name, each.measured, each.estimate, chosen.conditions, segment=chosen.segment,
        modes=drive.car.modes, clipping=instruments.ranges[:, None],
        noise=instruments.noise_rms(record.fs), tolerance_std=tolerance_std, known=known,
        distance_std=distance.std if distance else load_instruments(drive.sensors).speed_error,
    )  # fmt: skip


def write_report(report: _RoadReport, chosen: ReportSettings, folder: Path) -> list[Path]:
    """Write the page and the files of a report into a folder; return them, the page first."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for result in report.results:
        written += write_files(result, folder, chosen.route)
    written += write_geopackage(report.results, folder / "report.gpkg")
    about = {"vehicle": report.vehicle, "sensors": report.sensors, "estimator": chosen.estimator}
    page = folder / "index.html"
    write_page(report.results, chosen.conditions, about, report.agreement, page)
    return [page, *written]
