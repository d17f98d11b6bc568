"""Commands `simulate` and `train`: simulate a drive, train an estimator."""

import time
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer

import estimators
from estimators import registry, weights_io
from estimators.api import Pretrained, Trainable
from estimators.linear.calibrated_fir import CalibratedFir
from estimators.networks.narx import Narx
from estimators.networks.static_lm import StaticLm
from leaderboard import pretraining
from leaderboard.commands import (
    check_output_path,
    command_line,
    on_interrupt,
    parse_mode,
    parse_settings,
    progress_bar,
)
from leaderboard.commands.drive_files import DriveOptions, read_passes
from leaderboard.commands.options import (
    KnownRoads,
    Length,
    Mode,
    Road,
    Seed,
    Sensors,
    Settings,
    Speed,
    Vehicle,
)
from leaderboard.commands.output import Output
from leaderboard.drive_report.drive_estimates import read_profiles
from leaderboard.report import plots
from road_envs.core.config import ConfigError
from road_envs.drives.reading import DEFAULT_VEHICLE
from road_envs.drives.recording import simulate_record, write_record
from road_envs.drives.training_corpus import Corpus
from road_envs.plants.driving import simulate_on_plant
from road_envs.records.record import Profile, Record
from road_envs.records.roughness import iri
from road_envs.roads import realise_road, write_csv
from road_envs.sensing.data_logger import load_instruments
from road_envs.vehicle.parameters import load_vehicle

Grade = Annotated[
    str,
    typer.Option(
        help="Grade of the perturbed vehicle: S0 (as described) to S3; the seed draws it."
    ),
]

Plant = Annotated[
    str,
    typer.Option(
        help="Vehicle model: own, or that of another project, mujoco or commonroad, which needs "
        "the extra plants and a vehicle with passive struts."
    ),
]


def simulate(
    *,
    road: Road = "belgian",
    speed_kmh: Speed = 14.5,
    mode: Mode = None,
    length: Length = None,
    seed: Seed = 1,
    vehicle: Vehicle = "land_rover_defender_110",
    sensors: Sensors = "paper",
    grade: Grade = "S0",
    plant: Plant = "own",
    out: Annotated[Path | None, typer.Option(help="Write the record (.parquet, .csv).")] = None,
    truth: Annotated[Path | None, typer.Option(help="Write the true profile (.csv).")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw profile and record (.png).")] = None,
) -> Output:
    """Simulate a drive over a road and record the signals of the instruments."""
    (
        check_output_path(out, ".parquet", ".csv"),
        check_output_path(truth, ".csv"),
        check_output_path(plot, ".png", ".svg", ".pdf"),
    )
    surface, car = realise_road(road, seed, length), load_vehicle(vehicle)
    struts = parse_mode(mode) or next(iter(car.modes))
    common: dict[str, Any] = {"vehicle": car, "speed_kmh": speed_kmh, "seed": seed}
    common["instruments"] = load_instruments(sensors)
    if plant == "own":
        record, profile = simulate_record(surface, mode=struts, grade=grade, **common)
    elif grade != "S0":
        raise ConfigError(f"the plant {plant} has no grades: leave out --grade {grade}")
    else:
        record, profile = simulate_on_plant(plant, surface, **common)
    settings: dict[str, Any] = {
        "road": road,
        "speed_kmh": speed_kmh,
        "mode": struts,
        "vehicle": vehicle,
        "sensors": sensors,
        "grade": grade,
        "plant": plant,
        "seed": seed,
    }
    if out:
        write_record(out, record, settings, car.modes)
    if truth:
        write_csv(surface, truth)
    if plot:
        plots.draw_drive(record, profile, plot)
    rms = dict(zip(record.channels, np.sqrt(np.nanmean(record.a**2, axis=1)), strict=True))
    facts = {
        **settings,
        "length_m": surface.length,
        "duration_s": float(record.t[-1]),
        "samples": record.t.size,
        "lost_samples": int(np.isnan(record.a).any(axis=0).sum()),
        "iri_mm_per_m": [float(iri(z, surface.ds)) for z in surface.z],
        "rms_acceleration": {name: float(value) for name, value in rms.items()},
        "notes": list(surface.notes),
        "written": [str(p) for p in (out, truth, plot) if p],
    }
    return Output(facts=facts)


def train(
    *,
    estimator: Annotated[str, typer.Argument(help="Name of a trainable estimator.")],
    records: Annotated[
        list[Path] | None,
        typer.Argument(help="Own drives to train on, over roads of known --profile."),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="File for the fitted estimator (.npz or .safetensors).")
    ],
    profile: KnownRoads = None,
    road: Annotated[
        list[str] | None,
        typer.Option(help="Training road; may be given again. Default: the shipped corpus."),
    ] = None,
    length: Length = None,
    drives: Annotated[
        int | None,
        typer.Option(help="Drives on each road with different seeds, or of the corpus.", min=1),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the training.", min=0)] = 1,
    settings: Settings = None,
    options: DriveOptions,
) -> Output:
    """Train an estimator on simulated or own drives and store it.

    With files of drives and their --profile, it is trained on them: `calibrated_fir` needs nothing
    else. With --road, it is trained on simulated drives at one speed and in one mode. Without
    either, it is pretrained on the corpus for all speeds and modes, like the weights in this
    package. Pretraining takes some minutes and continues from a checkpoint if it is interrupted and
    called again.
    """
    check_output_path(out, ".npz", ".safetensors")
    chosen = estimators.create(estimator, **parse_settings(settings))
    if not isinstance(chosen, Trainable):
        raise ConfigError(f"{estimator} is not trainable; use it in `estimate` by its name")
    if records:
        if road or not profile:
            raise ConfigError("give the --profile of the drives' roads, and no --road")
        facts = _train_on_drives(chosen, records, profile, out, seed, options)
    elif road is None:
        vehicle = options.vehicle or DEFAULT_VEHICLE
        facts = _pretrain(chosen, estimator, out, drives, seed, vehicle)
    else:
        facts = _train_on_roads(chosen, road, length, drives or 1, out, seed, options)
    facts = {"estimator": estimator, **facts, "written": [str(out)]}
    return Output(facts=facts)


def _train_on_roads(
    estimator: Trainable,
    roads: list[str],
    length: float | None,
    drives: int,
    out: Path,
    seed: int,
    options: DriveOptions,
) -> dict[str, Any]:
    """Fit an estimator to simulated drives over roads and return the facts to print."""
    car = load_vehicle(options.vehicle or DEFAULT_VEHICLE)
    pairs: list[tuple[Record, Profile]] = []
    with progress_bar() as progress:
        for k, (name, i) in enumerate((name, i) for name in roads for i in range(drives)):
            progress(f"simulating {name}", 0.5 * k / (len(roads) * drives))
            pair = simulate_record(
                name,
                length=length,
                vehicle=car,
                speed_kmh=options.speed_kmh or 14.5,
                mode=parse_mode(options.mode),
                instruments=options.sensors or "ideal",
                seed=seed + i,
            )
            pairs.append(pair)
        progress("training", 0.5)
        fitted = estimator.fit([r for r, _ in pairs], [z for _, z in pairs], car, seed)
    weights_io.save(fitted, out)
    facts: dict[str, Any] = {"drives": len(pairs), "metres": float(sum(r.length for r, _ in pairs))}
    if isinstance(fitted, StaticLm | Narx):
        facts |= {"epochs": fitted.training.epochs, "stopped_by": fitted.training.stop}
    return facts


def _train_on_drives(
    estimator: Trainable,
    paths: list[Path],
    profiles: list[str],
    out: Path,
    seed: int,
    options: DriveOptions,
) -> dict[str, Any]:
    """Fit an estimator to drives in files and return the facts to print. Raises ConfigError."""
    files = read_passes(paths, options)
    truths = [
        cast(Profile, truth) for truth in read_profiles(profiles, [f.measured for f in files])
    ]
    fitted = estimator.fit([f.measured.record for f in files], truths, files[0].car, seed)
    weights_io.save(fitted, out)
    facts: dict[str, Any] = {"drives": [str(path) for path in paths]}
    if isinstance(fitted, CalibratedFir):
        facts |= fitted.summary()
    notes = dict.fromkeys(note for f in files for note in f.measured.notes)
    return {**facts, "notes": list(notes)}


def _pretrain(
    estimator: Trainable, name: str, out: Path, number: int | None, seed: int, vehicle: str
) -> dict[str, Any]:
    """Pretrain an estimator on the corpus of drives of a vehicle and return the facts to print.

    Raises ConfigError.
    """
    if not isinstance(estimator, Pretrained):
        raise ConfigError(
            f"{name} is trained for one speed and mode: give training roads with --road; "
            f"pretraining on the corpus is possible for {', '.join(registry.pretrainable())}"
        )
    if out.suffix != ".safetensors":
        raise ConfigError(f"{out}: the name must end in .safetensors for weights from the corpus")
    corpus = Corpus(car=vehicle) if number is None else Corpus(car=vehicle, number=number)
    begin = time.process_time()
    kept = f"the last stored state of the training is beside {out}; the same command continues"
    with on_interrupt(kept), progress_bar() as progress:
        pretraining.train(estimator, name, corpus, seed, out, command_line(), progress)
    seconds = time.process_time() - begin
    return {"drives": corpus.number, "corpus": corpus.digest, "cpu_seconds": seconds}
