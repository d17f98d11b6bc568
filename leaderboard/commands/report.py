"""Command `report`: roughness, condition and obstacles of a driven road, as a page and files."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import estimators
from leaderboard.commands import (
    check_output_folder,
    console,
    import_from_here,
    make_table,
    parse_settings,
    print_json,
    print_notes,
    progress_bar,
)
from leaderboard.commands.drive_files import (
    DriveOptions,
    estimate_drive,
    make_drive_estimator,
    read_drive,
    with_drive_options,
)
from leaderboard.commands.options import Json, Settings
from leaderboard.drive_report.analysis import SEGMENT_LENGTHS, DriveResult, analyse
from leaderboard.drive_report.conditions import load_conditions
from leaderboard.drive_report.export import write_geojson, write_tables
from leaderboard.drive_report.page import write_page
from leaderboard.drive_report.passes import ReportedPass, align_passes, compare, join
from road_envs.core.config import ConfigError
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.records.record import Estimate
from road_envs.sensing.instruments import instruments_of, load_instruments

Drives = Annotated[
    list[Path],
    typer.Argument(help="Records or tables of drives (.csv, .parquet, .mf4); several passes."),
]


@with_drive_options
def report(
    *,
    drives: Drives,
    out: Annotated[Path, typer.Option(help="Folder of the page and its files.")],
    estimator: Annotated[str, typer.Option(help="Name, or a file from `train`.")] = "map_smoother",
    segment: Annotated[
        float, typer.Option(help="Length of a segment in m: 10, 20 or 100.")
    ] = 100.0,
    conditions: Annotated[
        str, typer.Option(help="Condition categories: shipped name or YAML path.")
    ] = "hpms",
    options: DriveOptions,
    settings: Settings = None,
    json: Json = False,
) -> None:
    """Report IRI, ISO class, condition and obstacles of a driven road: a page, CSV, GeoJSON.

    Writes index.html, which needs no other file and prints on A4, and for each drive the tables
    NAME_segments, NAME_obstacles (.csv, .parquet), NAME_heights (.parquet) and, if the drive has
    positions, NAME.geojson.
    """
    if segment not in SEGMENT_LENGTHS:
        allowed = ", ".join(f"{x:g}" for x in SEGMENT_LENGTHS)
        raise ConfigError(f"--segment must be one of {allowed} m, got {segment:g} m")
    check_output_folder(out)
    names = _names(drives)
    import_from_here([estimator])
    categories, chosen = load_conditions(conditions), parse_settings(settings)
    read: list[tuple[str, MeasuredRecord, Estimate]] = []
    cars = []
    with progress_bar() as progress:
        for k, path in enumerate(drives):
            progress(f"reading {path.name}", k / len(drives))
            drive = read_drive(path, options)
            options = replace(options, save_description=None)  # once
            records = [*(measured.record for _, measured, _ in read), drive.measured.record]
            estimators.passes.refuse_repetitions(records, [str(file) for file in drives[: k + 1]])
            progress(f"estimating {path.name}", (k + 0.2) / len(drives))
            one = make_drive_estimator(estimator, drive, chosen)
            drive, found = estimate_drive(one, drive)
            read.append((names[k], drive.measured, found))
            cars.append(drive.car)
        passes, instruments = align_passes(read), load_instruments(drive.sensors)
        progress("joining the passes" if len(drives) > 1 else "writing the report", 1.0)
        joined = join(one, passes, cars)

    def analysed(each: ReportedPass) -> DriveResult:
        distance = each.estimate.distance
        ranges = instruments_of(each.measured.record, drive.sensors).ranges
        return analyse(
            each.name,
            each.measured,
            each.estimate,
            categories,
            segment=segment,
            modes=drive.car.modes,
            clipping=ranges[:, None],
            distance_std=distance.std if distance else instruments.speed_error,
        )

    results = [analysed(each) for each in passes]
    road = [analysed(joined)] if joined else []
    agreement = compare([r for r, one in zip(results, passes, strict=True) if one.aligned])
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for result in (*road, *results):
        written += write_tables(result, out, result.name)
        written += write_geojson(result, out, result.name)
    about = {
        "estimator": estimator,
        "vehicle": drive.car.name,
        "sensors": drive.sensors,
    }
    page = out / "index.html"
    write_page([*road, *results], categories, about, agreement, page)
    files = [str(path) for path in (page, *written)]
    if json:
        facts = {"drives": [_facts(result) for result in results], "agreement": agreement}
        print_json({**facts, "road": _facts(road[0]) if road else None, "written": files})
        return
    for result in (*road, *results):
        _print(result)
    if agreement:
        _print_agreement(agreement)
    console.print(f"written: {page} and {len(written)} tables")


def _names(drives: list[Path]) -> list[str]:
    """Return a name for each drive: its stem, numbered where stems are equal."""
    stems = [path.stem for path in drives]
    return [
        stem if stems.count(stem) == 1 else f"{stem}_{stems[: k + 1].count(stem)}"
        for k, stem in enumerate(stems)
    ]


def _print_agreement(agreement: dict[str, Any]) -> None:
    console.print(
        f"{len(agreement['names'])} passes: standard deviation of the IRI within segments "
        f"{agreement['repeatability']:.2f} mm/m, ICC {agreement['icc']:.2f}"
    )
    for row in agreement["passes"]:
        console.print(
            f"{row['name']} less {agreement['first']}: IRI bias {row['bias']:+.2f} mm/m, "
            f"RMSE {row['rmse']:.2f}, cross-correlation (R 56-style) {row['correlation']:.2f}"
        )


def _facts(result: DriveResult) -> dict[str, Any]:
    return {
        "name": result.name,
        **result.facts,
        "segments": result.segments,
        "obstacles": result.obstacles,
        "notes": list(result.notes),
    }


def _print(result: DriveResult) -> None:
    console.print(
        f"{result.name}: {result.facts['length_m']:.0f} m, "
        f"mean IRI {result.facts['iri_mean']:.2f} mm/m"
    )
    heads = ("from [m]", "to [m]", "IRI mean [mm/m]", "95 %", "condition", "class", "flags")
    cells = [
        (
            f"{row['begin_m']:.0f}",
            f"{row['end_m']:.0f}",
            f"{row['iri_mean']:.2f}",
            f"{row['iri_mean_low']:.2f} to {row['iri_mean_high']:.2f}",
            *(row[name] for name in heads[4:]),
        )
        for row in result.segments
    ]
    console.print(make_table(heads, cells, texts=heads[4:]))
    for row in result.obstacles:
        console.print(
            f"{row['kind']} at {row['station_m']:.1f} ± {1.96 * row['station_std_m']:.1f} m: "
            f"{row['height_mm']:+.0f} mm ({row['height_low_mm']:.0f} to "
            f"{row['height_high_mm']:.0f}), {row['length_m']:.1f} m long, {row['wheel_path']}, "
            f"confidence {row['confidence']:.2f}"
        )
    print_notes(result.notes)
