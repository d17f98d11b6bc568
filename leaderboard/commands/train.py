"""Command `train`: fit an estimator to drives over known roads, or pretrain it on the corpus."""

import time
from itertools import product
from pathlib import Path
from typing import Annotated, Any, cast

import estimators
from estimators import weights_io
from estimators.api import Trainable
from estimators.linear.calibrated_fir import CalibratedFir
from estimators.networks.narx import Narx
from estimators.networks.static_lm import StaticLm
from leaderboard import commands, pretraining
from leaderboard.commands.drive_files import DriveOptions, read_passes
from leaderboard.commands.options import KnownRoads, Length, Settings, argument, option
from leaderboard.commands.output import Output
from leaderboard.drive_report.drive_estimates import read_profiles
from road_envs.core.config import ConfigError
from road_envs.drives.reading import DEFAULT_VEHICLE
from road_envs.drives.recording import simulate_record
from road_envs.drives.training_corpus import Corpus
from road_envs.records.record import PROFILE_SPACING, Profile, Record
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

_SIMULATED = ("vehicle", "sensors", "mode", "speed_kmh")  # options that simulated drives have, too


def train(
    *,
    estimator: Annotated[str, argument("Name of a trainable estimator.")],
    records: Annotated[
        list[Path] | None, argument("Own drives to train on, over roads of known --profile.")
    ] = None,
    out: Annotated[Path, option("File for the fitted estimator (.npz or .safetensors).")],
    profile: KnownRoads = None,
    road: Annotated[
        list[str] | None, option("Training road; may be given again. Default: the shipped corpus.")
    ] = None,
    length: Length = None,
    drives: Annotated[
        int | None, option("Drives on each road with different seeds, or of the corpus.", min=1)
    ] = None,
    seed: Annotated[int, option("Seed of the training.", min=0)] = 1,
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
    commands.check_output_path(out, ".npz", ".safetensors")
    chosen = estimators.create(estimator, **commands.parse_settings(settings))
    if not isinstance(chosen, Trainable):
        raise ConfigError(f"{estimator} is not trainable; use it in `estimate` by its name")
    facts: dict[str, Any] = {"estimator": estimator}
    vehicle, simulated = options.vehicle or DEFAULT_VEHICLE, {"length": length, "drives": drives}
    if records:
        _refuse("own drives", {"road": road, **simulated})
        if not profile:
            raise ConfigError("give the --profile of the drives' roads")
        files = read_passes(records, options)
        known = cast(list[Profile], read_profiles(profile, [f.measured for f in files]))
        pairs = [(file.measured.record, z) for file, z in zip(files, known, strict=True)]
        if not isinstance(chosen, CalibratedFir):  # which uses what lies on the profile
            for path, (record, z) in zip(records, pairs, strict=True):
                _check_whole(path, record, z)
        facts["drives"] = [str(path) for path in records]
        facts |= _fit(chosen, pairs, files[0].car, seed, out)
        facts["notes"] = list(dict.fromkeys(n for file in files for n in file.measured.notes))
    elif road:
        measured = {k: x for k, x in vars(options).items() if k not in _SIMULATED}
        _refuse("simulated drives", {"profile": profile, **measured})
        car, pairs, number = load_vehicle(vehicle), [], drives or 1
        with commands.progress_bar() as progress:
            for k, (name, i) in enumerate(product(road, range(number))):
                progress(f"simulating {name}", 0.5 * k / (len(road) * number))
                pair = simulate_record(
                    name, length=length, vehicle=car, speed_kmh=options.speed_kmh or 14.5,
                    mode=options.given()["mode"], instruments=options.sensors or "ideal",
                    seed=seed + i,
                )  # fmt: skip
                pairs.append(pair)
            progress("training", 0.5)
            fitted = _fit(chosen, pairs, car, seed, out)
        metres = float(sum(record.length for record, _ in pairs))
        facts |= {"drives": len(pairs), "metres": metres, **fitted}
    else:
        others = {k: x for k, x in vars(options).items() if k != "vehicle"}
        _refuse("the corpus", {"profile": profile, "length": length, **others})
        corpus = Corpus(car=vehicle) if drives is None else Corpus(car=vehicle, number=drives)
        begin = time.process_time()
        kept = f"the last stored state of the training is beside {out}; the same command continues"
        with commands.progress_bar(kept) as progress:
            command = commands.command_line()
            pretraining.train(chosen, estimator, corpus, seed, out, command, progress)
        seconds = time.process_time() - begin
        facts |= {"drives": corpus.number, "corpus": corpus.digest, "cpu_seconds": seconds}
    return Output(facts={**facts, "written": [str(out)]})


def _refuse(material: str, options: dict[str, Any]) -> None:
    """Raise ConfigError if an option is given that training on this material does not use."""
    if given := [f"--{key.replace('_', '-')}" for key, x in options.items() if x is not None]:
        raise ConfigError(f"training on {material} takes no {', '.join(given)}: leave it out")


def _check_whole(path: Path, record: Record, profile: Profile) -> None:
    """Raise ConfigError if a profile, level beyond its ends, does not reach over its record."""
    start, end = profile.s[0], profile.s[-1]
    if start > 2.0 * PROFILE_SPACING or end < record.length - 2.0 * PROFILE_SPACING:
        raise ConfigError(
            f"{path}: its --profile is known from {start:.2f} to {end:.2f} m of the drive; all of "
            f"0 to {record.length:.2f} m are needed to train, or an estimator such as "
            "calibrated_fir, which uses what is known"
        )


def _fit(
    estimator: Trainable,
    drives: list[tuple[Record, Profile]],
    car: VehicleParameters,
    seed: int,
    out: Path,
) -> dict[str, Any]:
    fitted = estimator.fit([r for r, _ in drives], [z for _, z in drives], car, seed)
    weights_io.save(fitted, out)
    if isinstance(fitted, StaticLm | Narx):
        return {"epochs": fitted.training.epochs, "stopped_by": fitted.training.stop}
    return fitted.summary() if isinstance(fitted, CalibratedFir) else {}
