"""Notes for the reader of a board: doubts about its rows, and how they were made."""

from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

from estimators import REGISTRY
from estimators.lookup import TRAINING_VEHICLE
from leaderboard.evaluation.provenance import LIBRARIES
from leaderboard.evaluation.results import ISOLATED, Result, content_digest
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics.baselines import NOISE_LEVEL, TRUTH_PLUS_NOISE
from leaderboard.metrics.registry import SCORES
from leaderboard.report.board_definitions import BELOW_BOUND, BOUND_NAME, BOUND_ROW
from leaderboard.running.board import Board
from leaderboard.running.verification import Verified, kernels_of
from road_envs.sensing.instruments import load_instruments
from road_envs.sensing.perturbed_vehicle import load_plant_mismatch
from road_envs.vehicle.parameters import load_vehicle

if TYPE_CHECKING:
    from leaderboard.report.tables import Row

PUBLIC_ROADS = (
    "The test roads of this board are public: an entry can draw them again instead of estimating "
    "them, and its rank then says nothing. A rank counts only in a sealed season, whose seeds are "
    "revealed after the entries are in."
)

FOUND_SEEDS = (
    "A seed of these roads is so small that an entry can find it from the noise of a record, and "
    "draw road and noise again. Where its author may have done so, a rank counts only in a sealed "
    "season."
)

SEALED_ROADS = "The seeds of these roads were revealed after all entries were in."
REVEALED_ROADS = (
    "The seeds of these roads stand in a file: an entry that is newer can draw them again. Its "
    "rank counts only in a results repository, which refuses entries that are newer."
)

_SENSORS = "paper"  # of shipped weights, and those that a model of the sensors has by default
_SHEET = attrgetter("fs", "f_alias", "noise_density", "speed_error")
_SEARCHED = 2**40  # seeds below are found by trial, 100 000 in a second, in 130 days of a core
_Known = Mapping[str, Sequence[Verified]]  # what was verified, by the content of the row


def section_notes(
    board: Board, task: Task, rows: Sequence["Row"], level_drives: int, trainings: Mapping[str, int]
) -> tuple[str, ...]:
    """Return all notes on a task, on the `rows` of its scored entries, on its `level_drives`, which
    have no ranking score, and on the `trainings` of those that depend on the seed.
    """
    scored = board.scored(task)
    ranks_by = task.board_definition.ranks_by
    drives = f"{level_drives} drive{'s' * (level_drives > 1)}"
    level = f"On {drives} nobody has a score, as on a level road."
    unranked = [x.name for x in rows if x.state == "scored" and x.values.get(ranks_by) is None]
    lacking = f"No {SCORES[ranks_by].label} on some drives, and so no rank: {', '.join(unranked)}."
    others = [x for x in scored if x.role == "entry" and x.estimator not in REGISTRY]
    seal = FOUND_SEEDS if min(task.test.all_seeds) < _SEARCHED else REVEALED_ROADS
    is_open = bool(others) and not has_public_roads(task) and SEALED_ROADS not in task.note
    seeds = {name: f"{n} training seed{'s' * (n > 1)}" for name, n in trainings.items()}
    results = [*scored, *board.failed(task)]  # of a file, they note what was changed on its surface
    surface = dict.fromkeys(x for r in results for x in r.notes if x not in _own_notes(r))
    return (
        *([PUBLIC_ROADS] if task.is_public else []),
        *([seal] if is_open else []),
        *([level] if level_drives else []),
        *([lacking] if unranked else []),
        *_protocol_notes(task, scored),
        *([f"Surface: {'; '.join(surface)}."] if surface and task.board_name == "measured" else []),
        *(f"{note}." for row in scored for note in _own_notes(row)),
        *sanity_warnings(rows, ranks_by, has_public_roads(task)),
        *_kernel_notes(scored, _verified_for(task, board.verified)),
        *_version_notes(scored),
        *_notes_on_others(seeds, "ran with {}, the others with {}"),
    )


def has_public_roads(task: Task) -> bool:
    """Return whether anybody can draw the test roads: those of a shipped task, or of one that a
    results repository has among its own without a seal.
    """
    return task.is_public or PUBLIC_ROADS in task.note


def sanity_warnings(rows: Sequence["Row"], ranks_by: str, is_public: bool = False) -> list[str]:
    """Return remarks on entries whose NRMSE or ranking score is better than that of the truth with
    noise, or whose NRMSE is better than the bound, and on faulty baselines.
    """
    doubt = ": it knows more than the sensors tell, or has drawn these public roads again"
    error = {row.name: row.values.get("nrmse") for row in rows}
    best = next((row.values for row in rows if row.name == TRUTH_PLUS_NOISE), {})
    warnings, bound = [], error.get(BOUND_ROW)
    for row in (row for row in rows if row.state == "scored"):
        mine, below = error[row.name], row.values.get(BELOW_BOUND) or 0.0
        pairs = [(row.values.get(key), best.get(key)) for key in ("nrmse", ranks_by)]
        if any(x is not None and y is not None and x < y for x, y in pairs):
            warnings.append(
                f"{row.name} scores better than the truth with {100 * NOISE_LEVEL:g} % noise: "
                "it has used the truth, or the evaluation is faulty"
            )
        elif mine is not None and bound is not None and mine < bound:
            share = f"on {below:.0%} of its drives{doubt * is_public}"
            warnings.append(f"{row.name} is below the {BOUND_NAME}, {share}")
    for name, level in (("flat", 1.0), (TRUTH_PLUS_NOISE, NOISE_LEVEL)):
        if (x := error.get(name)) is not None and abs(x - level) > 0.1 * level:
            warnings.append(f"the evaluation is faulty: {name} scores {x:.3f} instead of {level:g}")
    return warnings


def _sensor_notes(task: Task, results: Sequence[Result], pretrained: str) -> list[str]:
    """Return notes on who was made for other sensors than the task has."""
    there, here = load_instruments(_SENSORS), task.sensors
    own, notes = f"{_SENSORS}, not of {Path(task.instruments).stem}", []
    is_other_sheet = _SHEET(there) != _SHEET(here)
    if pretrained and (is_other_sheet or there.accelerometers != here.accelerometers):
        notes.append(f"{pretrained}: trained with the sensors of {own}.")
    models = ", ".join(r.estimator for r in results if r.settings.get("instruments") == _SENSORS)
    if models and is_other_sheet:  # where they are, a record says
        notes.append(f"{models}: with noise and filter of the sensors of {own}.")
    return notes


def _protocol_notes(task: Task, results: Sequence[Result]) -> list[str]:
    ours = [r for r in results if r.estimator in REGISTRY]  # not files of `train`, nor others'
    notes, pretrained = [], ", ".join(r.estimator for r in ours if r.settings.get("shipped"))
    if task.trains_on_test_road:
        weights = f"; {pretrained} with pretrained weights" if pretrained else ""
        notes.append(f"Trained on altered copies of the test road{weights}.")
    cars = (load_vehicle(condition.car or task.car) for condition in task.conditions)
    others = dict.fromkeys(x.name for x in cars if x != load_vehicle(TRAINING_VEHICLE))
    if pretrained and others:
        known = f"{TRAINING_VEHICLE}, not of {', '.join(others)}"
        notes.append(f"{pretrained}: trained on drives of {known}.")
    notes += _sensor_notes(task, results, pretrained)
    if task.position_noise:
        receiver = load_plant_mismatch().instruments
        low, high = receiver.position_noise
        notes.append(
            f"Positions: fixes of a receiver that wander by {low:g} to {high:g} m, correlated over "
            f"{receiver.position_correlation_time:g} s. Ranked by the "
            f"{SCORES[task.board_definition.ranks_by].label}; the NRMSE beside it is that at fixed "
            "stations."
        )
    return [*notes, task.note] if task.note else notes


def _own_notes(result: Result) -> list[str]:
    """Return what the judge has found out about an entry."""
    return [note for note in result.notes if note.startswith(f"{result.estimator}: ")]


def isolation_notice(results: Iterable[Result]) -> str | None:
    """Return one sentence on the scored rows that ran without isolation; None if all had it."""
    entries = (r for r in results if r.role == "entry" and r.failure is None)
    names = dict.fromkeys(r.estimator for r in entries if r.isolation not in ISOLATED)
    if not names:
        return None
    return (
        f"Run without isolation: {', '.join(names)}. These estimators had the rights of the user "
        "who ran the board: their rows hold only if that user trusts their code."
    )


def _verified_for(task: Task, verified: _Known) -> _Known:
    """Return what was verified less what agrees in another score than the task is ranked by."""
    rank = task.board_definition.ranks_by
    return {
        content: [x for x in rows if x.ranks_by == rank or x.compares_all or not x.agrees]
        for content, rows in verified.items()
    }


def _kernel_notes(results: Sequence[Result], verified: _Known) -> list[str]:
    """Return a note on the rows of a task that are not known to agree with the kernels of most: by
    what was verified on them within the tolerance, or, if they were not run there again, by what
    they say of their machine, which is taken on trust.
    """
    made = {result.estimator: kernels_of(result.environment) for result in results}
    usual = _most_frequent(made)

    def doubt(result: Result) -> str | None:
        known = verified.get(content_digest(result), ())
        if false := [x.reason for x in known if x.is_false]:
            return f"is not what was found when it was run again: {false[0]}"
        again = [x for x in known if x.kernels == usual]
        if any(x.agrees for x in again):
            return None
        says_usual = made[result.estimator] == usual
        elsewhere = [x for x in known if x.runs and x.is_far and x.kernels != usual]
        if elsewhere and not again:
            return f"was run again on {elsewhere[0].kernels}: {elsewhere[0].distance:.1e} apart"
        if says_usual and not again:
            return None
        own = f"ran on {made[result.estimator]}, the others on {usual}"
        apart = f"{again[0].distance:.1e} apart there" if again else "not verified there"
        return f"{f'says that it ran on {usual}' if says_usual else own}: {apart}"

    notes: dict[str, list[str]] = {}
    for result in results:
        if text := doubt(result):
            notes.setdefault(text, []).append(result.estimator)
    return [f"{', '.join(names)} {text}." for text, names in notes.items()]


def _version_notes(results: Sequence[Result]) -> list[str]:
    """Return notes on rows of another version than most of a library, or Python's first numbers."""
    notes = []
    for name in ("python", *LIBRARIES):
        made = {r.estimator: r.environment[name] for r in results if name in r.environment}
        if name == "python":  # of the parts of a row, such as "3.11.4 or 3.11.5 or 3.12.0"
            parts = {k: [x.rpartition(".")[0] for x in v.split(" or ")] for k, v in made.items()}
            made = {k: " or ".join(dict.fromkeys(minor)) for k, minor in parts.items()}
        notes += _notes_on_others(made, f"ran with {name} {{}}, the others with {{}}")
    return notes


def _notes_on_others(made: Mapping[str, str], text: str) -> list[str]:
    """Return `text` of each value of `made` (by name) that is not the usual one, and of that."""
    usual = _most_frequent(made)
    notes: dict[str, list[str]] = {}
    for name, value in made.items():
        if value != usual:
            notes.setdefault(text.format(value, usual), []).append(name)
    return [f"{', '.join(names)} {note}." for note, names in notes.items()]


def _most_frequent(values: Mapping[str, str]) -> str:
    known = list(values.values())
    return max(set(known), key=lambda x: (known.count(x), x), default="")
