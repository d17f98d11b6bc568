"""`estimate` and `classify`: what a record says of the road, be it simulated or measured."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

import estimators
from estimators import weights_io
from estimators.api import Estimator, check_estimate
from estimators.roughness import spectral
from estimators.roughness.rms_regression import RmsRoughness, RoughnessEstimate
from estimators.wiener.segments import dominant_modes
from leaderboard.commands import check_output_path, console, parse_mode, parse_settings, print_json
from leaderboard.commands.simulate import Json, Sensors, Vehicle, print_facts, print_notes
from leaderboard.metrics.registry import SCORES, UNDEFINED, compute_scores
from leaderboard.report import plots
from road_envs.config import ConfigError, validate_choice
from road_envs.data.measured_record import MeasuredRecord, read_measured_record
from road_envs.data.record import Profile, Record
from road_envs.data.recording import is_record, read_record
from road_envs.data.training_corpus import Corpus, drives_in_mode
from road_envs.roads import Surface, load_road, write_csv
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

RecordFile = Annotated[
    Path,
    typer.Argument(
        help="A record from `simulate`, or a measured drive as a table (.csv, .parquet)."
    ),
]
Mode = Annotated[
    str | None,
    typer.Option(help="4S4 mode of a measured drive: ride, handling, ..., or front=..,rear=.."),
]
Speed = Annotated[float | None, typer.Option(help="Speed of a measured drive in km/h.", min=0.1)]
PRINTED_SCORES = (
    "nrmse", "nrmse_left", "nrmse_right", "r", "coherence", "level_error", "level_error_raw",
    "class_exact", "fitted_class", "dsd_distance_db", "iri_error", "bump_recall",
    "bump_precision", "coverage_50", "coverage_90",
)  # fmt: skip
"""Scores that are printed; `--json` has them all."""

METHODS = ["spectral", "rms"]
N_DRIVES, SPEED_MARGIN = 60, 1.5
"""Drives that the regression learns from, and how far their speeds reach around the record's."""


def estimate(
    estimator: Annotated[str, typer.Argument(help="A file from `train`, or a name.")],
    record: RecordFile,
    truth: Annotated[Path | None, typer.Option(help="True profile (.csv), to score.")] = None,
    vehicle: Vehicle = "land_rover_defender_110",
    mode: Mode = None,
    speed_kmh: Speed = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Setting of the estimator, key=value.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the estimate (.csv).")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw the estimate (.png).")] = None,
    json: Json = False,
) -> None:
    """Reconstruct both wheel paths of a record; with the truth at hand, score it.

    A measured drive is a table with the columns t [s], a_rf, a_lr, a_rr [m/s²] (or a_rf_g ... [g]),
    v [m/s] or v_kmh, and mode; speed and mode may be options instead.
    """
    check_output_path(out, ".csv"), check_output_path(plot, ".png", ".svg", ".pdf")
    chosen, car = _estimator(estimator, parse_settings(settings or [])), load_vehicle(vehicle)
    seen, notes = _record(record, car, mode, speed_kmh)
    found = chosen.estimate(seen, car)
    check_estimate(found, seen)
    facts: dict[str, Any] = {
        "estimator": estimator,
        "record": str(record),
        "length_m": seen.length,
        "rms_m": [float(z.std()) for z in found.z],
        "notes": [*notes, *found.notes],
        "written": [str(p) for p in (out, plot) if p],
    }
    known, v, scored = None, float(np.median(seen.v)), {}
    if truth:
        known = Profile(found.s, load_road(truth).realise(np.random.default_rng(0)).height(found.s))
        scored = compute_scores(known, found, v, bumps=True)
    if out:
        write_csv(Surface(found.z, found.ds, name=f"estimate of {record.name}"), out)
    if plot:
        plots.draw_estimate(known, found, v, plot)
    if json:
        print_json({**facts, "scores": scored} if truth else facts)
        return
    print_facts(facts)
    if scored:
        _print_scores(scored)


def classify(
    record: RecordFile,
    vehicle: Vehicle = "land_rover_defender_110",
    sensors: Sensors = "paper",
    mode: Mode = None,
    speed_kmh: Speed = None,
    method: Annotated[
        str, typer.Option(help="spectral: by the car's model; rms: learnt from simulated drives.")
    ] = "spectral",
    json: Json = False,
) -> None:
    """Tell the ISO 8608 class of the road of a record, with its probability.

    From the spectra of its accelerations, octave by octave; or from their RMS, by a regression on
    drives simulated for it, in its states and at speeds about its own.
    """
    validate_choice("method", method, METHODS)
    car = load_vehicle(vehicle)
    seen, notes = _record(record, car, mode, speed_kmh)
    found: Any = (
        spectral.classify_record(seen, car, sensors)
        if method == "spectral"
        else _by_rms(seen, Corpus(car=vehicle, instruments=sensors))
    )
    if json:
        facts = {
            key: value.tolist() if isinstance(value, np.ndarray) else value
            for key, value in found._asdict().items()
        }
        print_json({"class": found.letter, **facts, "notes": list(notes)})
        return
    share = 100.0 * found.probability[found.letter]
    console.print(
        f"class {found.letter} ({share:.0f} %), Gd(n0) = {1e6 * found.G_d0:.0f}e-6 m³ "
        f"± {4.34 * found.log_std:.1f} dB"
    )
    if method == "spectral":
        _print_octaves(found)
    print_notes(notes)


def _by_rms(seen: Record, corpus: Corpus) -> RoughnessEstimate:
    """What the regression says, fitted to drives like the one that was `seen`."""
    mode = dominant_modes(seen, np.arange(seen.t.size))
    slow, fast = 3.6 * np.percentile(seen.v, [5.0, 95.0])
    drives = drives_in_mode(corpus, mode, (slow / SPEED_MARGIN, fast * SPEED_MARGIN), N_DRIVES)
    return RmsRoughness.fit(*zip(*drives, strict=True)).predict(seen)


def _print_octaves(found: spectral.ClassPosterior) -> None:
    table = Table("octave [cycles/m]", "Gd(n0) [1e-6 m³]", "± [dB]", "class")
    columns = (found.octaves, found.levels, found.level_stds, found.octave_classes)
    for centre, level, std, letter in zip(*columns, strict=True):
        table.add_row(f"{centre:g}", f"{1e6 * level:.0f}", f"{4.34 * std:.1f}", letter)
    console.print(table)


def _estimator(name: str, settings: dict[str, Any]) -> Estimator:
    if Path(name).suffix not in (".npz", ".safetensors"):
        return estimators.create(name, **settings)
    if settings:
        raise ConfigError(f"{name} was trained with its settings: --set is for an estimator's name")
    return weights_io.load(name)


def _record(
    path: Path, car: VehicleParameters, mode: str | None, speed_kmh: float | None
) -> MeasuredRecord:
    """A record of this package, or a measured drive. Raises ConfigError."""
    if not is_record(path):
        struts = parse_mode(mode) if mode is not None else None
        return read_measured_record(path, car.wheelbase, speed_kmh=speed_kmh, mode=struts)
    if mode is not None or speed_kmh is not None:
        raise ConfigError(f"{path} tells its own mode and speed: leave out --mode and --speed-kmh")
    return MeasuredRecord(read_record(path)[0], ())


def _print_scores(scored: dict[str, float]) -> None:
    """The scores that are most asked for, each with its unit."""
    table = Table(box=None, pad_edge=False, show_header=False)
    for key in PRINTED_SCORES:
        if key in scored and (text := SCORES[key].format_value(scored[key])) != UNDEFINED:
            table.add_row(SCORES[key].label, text, SCORES[key].unit)
    console.print(table)
