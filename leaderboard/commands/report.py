"""Command `report`: roughness, condition and obstacles of a driven road, as a page and files."""

import math
from pathlib import Path
from typing import Annotated, Any

from leaderboard import commands
from leaderboard.commands.drive_files import KINDS, DriveOptions, read_passes
from leaderboard.commands.options import Settings, argument, option
from leaderboard.commands.output import Output
from leaderboard.drive_report.analysis import DriveResult
from leaderboard.drive_report.conditions import load_conditions
from leaderboard.drive_report.export import parse_route
from leaderboard.drive_report.known_iri import read_known_iri
from leaderboard.drive_report.report import ReportSettings, make_report, write_report
from leaderboard.drive_report.sections import KEPT, Sections
from road_envs.core.config import names
from road_envs.drives.logger_tables.description import write_description


def report(
    *,
    drives: Annotated[list[Path], argument(f"Drives, each {KINDS}; several are passes.")],
    out: Annotated[Path, option("Folder of the page and its files.")] = Path("report"),
    estimator: Annotated[str, option("Name, or a file from `train`.")] = "map_smoother",
    fast: Annotated[
        bool, option("Fit no vehicle to the drives: wider intervals, sooner.", "--fast")
    ] = False,
    segment: Annotated[float, option("Length of a segment in m: 10, 20 or 100.")] = 100.0,
    conditions: Annotated[
        str, option(f"Condition categories: {', '.join(names('conditions'))}, or a YAML path.")
    ] = "hpms",
    known_iri: Annotated[
        str | None,
        option(
            "Known IRI in mm/m of the drive, or a table of stretches (begin_m, end_m, iri): "
            "calibrates this car and mount."
        ),
    ] = None,
    route: Annotated[
        str | None,
        option(
            "Also write NAME_hpms.csv for this route, miles from its begin; ROUTE,MILE where "
            "the drive begins."
        ),
    ] = None,
    options: DriveOptions,
    settings: Settings = None,
) -> Output:
    """Report IRI, ISO class, condition and obstacles of a driven road: a page, CSV, GeoPackage.

    Writes index.html, which needs no other file and prints on A4, and for each drive the tables
    NAME_segments, NAME_obstacles (.csv, .parquet), NAME_heights (.parquet; `export` makes a road of
    it) and, if the drive has positions, NAME.geojson and report.gpkg.
    """
    commands.check_output_folder(out)
    commands.import_from_here(estimator)
    chosen = ReportSettings(
        conditions=load_conditions(conditions), settings=commands.parse_settings(settings),
        estimator=estimator, fast=fast, segment=segment,
        known_iri=None if known_iri is None else read_known_iri(known_iri),
        route=None if route is None else parse_route(route),
    )  # fmt: skip
    kept = f"finished sections are kept in {out}; the same command continues"
    with commands.progress_bar(kept) as progress:
        progress("reading", 0.0)
        read = read_passes(drives, options)
        sections = Sections(out / KEPT, said=commands.notices.print)
        made = make_report(read, chosen, progress, sections)
        page, *written = write_report(made, chosen, out)
        sections.clear()
    if options.save_description:  # with the factor of a known IRI
        write_description(options.save_description, made.descriptions[0])
    facts = {
        "drives": [_facts(drive) for drive in made.drives],
        "agreement": made.agreement,
        "road": made.road and _facts(made.road),
        "written": [str(path) for path in (page, *written)],
    }
    shows = [part for result in made.results for part in _shown(result)]
    if made.agreement:
        shows.append(
            "{} passes: standard deviation of the IRI within segments {repeatability:.2f} mm/m, "
            "ICC {icc:.2f}".format(len(made.agreement["names"]), **made.agreement)
        )
        shows += [
            f"{row['name']} less {made.agreement['first']}: IRI bias {row['bias']:+.2f} mm/m, "
            f"RMSE {row['rmse']:.2f}, cross-correlation (R 56-style) {row['correlation']:.2f}"
            for row in made.agreement["passes"]
        ]
    shows.append(f"written: {page} and {len(written)} files beside it")
    return Output(facts=facts, shows=shows)


def _facts(result: DriveResult) -> dict[str, Any]:
    rows = {"segments": result.segments, "obstacles": result.obstacles}
    return {"name": result.name, **result.facts, **rows, "notes": list(result.notes)}


def _shown(result: DriveResult) -> list[Any]:
    length, iri = (result.facts[key] for key in ("length_m", "iri_mean"))
    heads = ("from [m]", "to [m]", "IRI mean [mm/m]", "95 %", "condition", "class", "flags")
    numbers = ("{begin_m:.0f}", "{end_m:.0f}", "{iri_mean:.2f}")
    interval = "{iri_mean_low:.2f} to {iri_mean_high:.2f}"
    cells = [
        (
            *(text.format(**row) for text in numbers),
            "–" if math.isnan(row["iri_mean_high"]) else interval.format(**row),
            *(row[name] for name in heads[4:]),
        )
        for row in result.segments
    ]
    obstacle = (
        "{kind} at {station_m:.1f} ± {place:.1f} m: {height_mm:+.0f} mm ({height_low_mm:.0f} to "
        "{height_high_mm:.0f}), {length_m:.1f} m long, wheel path {wheel_path}, "
        "confidence {confidence:.2f}"
    )
    return [
        f"{result.name}: {length:.0f} m, mean IRI {iri:.2f} mm/m",
        commands.make_table(heads, cells, texts=heads[4:]),
        *(obstacle.format(**row, place=1.96 * row["station_std_m"]) for row in result.obstacles),
        *(f"- {note}" for note in result.notes),
    ]
