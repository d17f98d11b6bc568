"""Commands `estimate` and `classify`: road profile and ISO 8608 class of a record."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np

import estimators
from estimators.roughness import spectral
from leaderboard import commands
from leaderboard.commands import drive_files
from leaderboard.commands.drive_files import DriveOptions, RecordFile, RecordFiles
from leaderboard.commands.options import Settings, argument, option
from leaderboard.commands.output import Output, facts_table
from leaderboard.drive_report.drive_estimates import estimate_drive, make_drive_estimator
from leaderboard.metrics.alignment import align
from leaderboard.pretraining import rms_roughness
from leaderboard.report import plots
from leaderboard.scoring import score
from road_envs.core.config import ConfigError, validate_choice
from road_envs.drives.reading import same_instruments
from road_envs.drives.training_corpus import Corpus
from road_envs.records.record import PROFILE_SPACING, Profile
from road_envs.roads import Surface, load_road, realise_road, write_csv
from road_envs.roads.measured import Measured

_DB_PER_LOG = 4.34  # 10 / ln 10: decibels per unit of the natural logarithm of a PSD


def estimate(
    *,
    estimator: Annotated[str, argument("A file from `train`, or a name.")],
    records: RecordFiles,
    truth: Annotated[Path | None, option("True profile (.csv), to score.")] = None,
    options: DriveOptions,
    settings: Settings = None,
    out: Annotated[Path | None, option("Write the estimate (.csv).")] = None,
    plot: Annotated[Path | None, option("Draw the estimate (.png).")] = None,
) -> Output:
    """Reconstruct both wheel paths of a record; score them if the truth is given.

    Several records are passes over one road, which is reconstructed from all of them, on the
    stations of the first. Each can have a description of its own, with the name of its file:
    a.yaml beside a.csv. Options are for all.

    A measured drive is a table with the columns t [s], a_rf, a_lr, a_rr [m/s²] (or a_rf_g ... [g]),
    v [m/s] or v_kmh, and mode; speed and mode can be given as options instead.
    """
    commands.check_output_path(out, ".csv")
    commands.check_output_path(plot, *commands.PICTURES)
    given = commands.parse_settings(settings)
    commands.import_from_here(estimator)
    estimators.make_estimator(estimator, **given)  # a wrong name ends it before a file is read
    drives = drive_files.read_passes(records, options)
    drive, surface = drives[0], realise_road(truth, 0) if truth else None
    needed = 0.0 if drive.is_table else drive.measured.record.length  # of a table, what overlaps
    if surface and surface.end < needed - 2.0 * PROFILE_SPACING:  # it would go on as a level road
        raise ConfigError(
            f"{truth}: the true profile is {surface.length:.2f} m long; of the road of the record "
            f"all {needed:.2f} m are needed"
        )
    chosen = make_drive_estimator(estimator, drive, given)
    if len(drives) == 1:
        drive, result = estimate_drive(chosen, drive)
        notes = list(drive.measured.notes)
    else:
        same_instruments(drives)
        names = [each.label for each in drives]
        notes = [f"{each.label}: {note}" for each in drives for note in each.measured.notes]
        measured, cars = [each.measured.record for each in drives], [each.car for each in drives]
        result = estimators.estimate_passes(chosen, measured, cars, names=names)
    facts: dict[str, Any] = {
        "estimator": estimator, "record": ", ".join(str(path) for path in records),
        "length_m": drive.measured.record.length, "rms_m": [float(z.std()) for z in result.z],
        "notes": [*notes, *result.notes], "written": [str(p) for p in (out, plot) if p],
    }  # fmt: skip
    profile, scored, v, scores = None, result, result.speed or 0.0, None
    if truth and surface:
        profile, scored = Profile(result.s, surface.height(result.s)), result
        if drive.is_table:
            road = load_road(truth)
            start = road.first_station if isinstance(road, Measured) else 0.0
            aligned = align(surface, result, v, drive.measured.chainage - start)
            profile, scored = aligned.truth, aligned.estimate
            facts["notes"].append(aligned.note)
        scores = score(scored, profile)
    shows = [*facts_table(facts)]
    if scores is not None:
        facts["scores"] = scores.values
        shows += facts_table({label: text for _, text, label in scores.rows()})
    if out:
        start = drive.measured.chainage if drive.is_table else 0.0
        write_csv(Surface(result.z, result.ds, start, name=f"estimate of {records[0].name}"), out)
    if plot:
        plots.save_figure(plots.estimate_figure(profile, scored, v), plot)
    return Output(facts=facts, shows=shows)


def classify(
    *,
    record: RecordFile,
    options: DriveOptions,
    method: Annotated[
        str, option("spectral: by a vehicle model; rms: regression on simulated drives.")
    ] = "spectral",
) -> Output:
    """Estimate the ISO 8608 class of the road of a record, with its probability.

    Method spectral uses the acceleration spectra by octaves; method rms uses a regression on the
    RMS of drives that are simulated in the modes and at the speeds of the record.
    """
    validate_choice("method", method, ["spectral", "rms"])
    drive = drive_files.read_drive(record, options)
    measured, notes = drive.measured.record, [*drive.measured.notes]
    result: Any
    if method == "spectral":
        result = spectral.classify_record(measured, drive.car, drive.sensors)
        notes += result.notes
    else:
        result = rms_roughness(measured, Corpus(car=drive.vehicle, instruments=drive.sensors))
    found = result._asdict().items()
    facts = {key: x.tolist() if isinstance(x, np.ndarray) else x for key, x in found}
    percent = 100.0 * result.probability[result.letter]
    shows: list[Any] = [
        f"class {result.letter} ({percent:.0f} %), Gd(n0) = {1e6 * result.G_d0:.0f}e-6 m³ "
        f"± {_DB_PER_LOG * result.log_std:.1f} dB"
    ]
    if method == "spectral":
        levels = zip(result.octaves, result.levels, result.level_stds, strict=True)
        numbers = [(f"{n:g}", f"{1e6 * G:.0f}", f"{_DB_PER_LOG * std:.1f}") for n, G, std in levels]
        pairs = zip(numbers, result.octave_classes, strict=True)
        heads = ("octave [cycles/m]", "Gd(n0) [1e-6 m³]", "± [dB]", "class")
        cells = [(*each, letter) for each, letter in pairs]
        shows.append(commands.make_table(heads, cells, texts=("class",)))
    shows += [f"- {note}" for note in notes]
    return Output(facts={"class": result.letter, **facts, "notes": notes}, shows=shows)
