"""Command `identify`: a vehicle's parameters from calibration drives."""

from pathlib import Path
from typing import Annotated, Any

from rich.table import Table

from estimators.api import CalibrationDrive
from estimators.map_smoother.identification import identify as identify_vehicle
from estimators.map_smoother.identification_result import IdentificationResult
from estimators.map_smoother.preparation import SolverSettings
from estimators.map_smoother.tuning import TUNING
from leaderboard.commands import PICTURES, YAML, check_output_path
from leaderboard.commands.drive_files import DriveOptions, read_passes
from leaderboard.commands.options import KnownRoads, argument, option
from leaderboard.commands.output import Output
from leaderboard.drive_report.drive_estimates import read_profiles
from leaderboard.report import plots
from road_envs.vehicle.parameters import write_vehicle


def identify(
    *,
    records: Annotated[list[Path], argument("Calibration drives of one vehicle.")],
    profile: KnownRoads = None,
    survey_error_mm: Annotated[
        float, option("Standard deviation of a profile's heights in mm.", min=0.01)
    ] = 1.0,
    structure: Annotated[
        bool,
        option("Also identify what the vehicle's file leaves out, such as a frame.", "--structure"),
    ] = False,
    options: DriveOptions,
    out: Annotated[Path | None, option("Write the identified vehicle (.yaml).")] = None,
    plot: Annotated[Path | None, option("Draw the result (.png).")] = None,
) -> Output:
    """Identify a vehicle's parameters from calibration drives, and write its file.

    With --profile the road is known; without, it is estimated at the same time. Parameters are
    those with tolerances in the vehicle's file. The last third of each drive is held out.
    """
    check_output_path(out, *YAML)
    check_output_path(plot, *PICTURES)
    files = read_passes(records, options)
    profiles = read_profiles(profile or [], [file.measured for file in files])
    drives = [
        CalibrationDrive(file.measured.record, known, 1e-3 * survey_error_mm, file.name)
        for file, known in zip(files, profiles, strict=True)
    ]
    settings = SolverSettings(instruments=files[0].sensors)
    result = identify_vehicle(drives, files[0].car, settings, structure)
    notes = [*dict.fromkeys(n for file in files for n in file.measured.notes), *result.notes]
    if out:
        names = ", ".join(path.name for path in records)
        write_vehicle(out, result.car, f"Identified by `road-recon identify` from {names}.")
    if plot:
        plots.draw_identification(result, [f.name for f in files], plot)
    told = [*notes, *(f"written: {path}" for path in (out, plot) if path)]
    shows = [*_tables(result, [file.name for file in files]), *(f"- {note}" for note in told)]
    return Output(facts={**_facts(result), "notes": notes}, shows=shows)


def _facts(result: IdentificationResult) -> dict[str, Any]:
    space = result.fit.space
    names = zip(space.names, result.factors, result.std, space.std, strict=False)
    fitted = result.fit.instrument_errors
    readings = zip(fitted.names, result.fit.x[space.size :], fitted.std, strict=False)
    return {
        "vehicle": result.car.name,
        "parameters": {
            name: {"factor": float(f), "relative_std": float(s * t)} for name, f, s, t in names
        },
        "instruments": {name: float(x * s) for name, x, s in readings},
        "unexplained": [[x.power, y.power] for x, y in result.unexplained],
    }


def _tables(result: IdentificationResult, drives: list[str]) -> list[Any]:
    space = result.fit.space
    table = Table("parameter", "change [%]", "± [%]", "of tolerance [%]", box=None)
    for i, name in enumerate(space.names):
        if result.std[i] <= TUNING.undetermined:
            change, std = 100.0 * (result.factors[i] - 1.0), 100.0 * result.std[i] * space.std[i]
            table.add_row(name, f"{change:+.1f}", f"{std:.1f}", f"{100.0 * result.std[i]:.0f}")
    readings, n = result.fit.instrument_errors, space.size
    rows = zip(readings.names, readings.std, result.fit.x[n:], result.std[n:], strict=False)
    for name, scale, x, std in rows:
        is_share = name.startswith(("gain", "speed"))
        unit, factor, digits = ("[%]", 100.0 * scale, 2) if is_share else ("[m]", scale, 3)
        table.add_row(f"{name} {unit}", f"{factor * x:+.{digits}f}", f"{factor * std:.{digits}f}")
    power = Table("drive, held-out third", "described", "identified", box=None)
    for name, (described, fitted) in zip(drives, result.unexplained, strict=True):
        power.add_row(name, f"{described.power:.1f}", f"{fitted.power:.1f}")
    return [table, "\nunexplained power over that of the instruments' noise", power]
