"""The verdict on an estimator before it stands on a board: one sentence for each thing that counts.

    contract   a frozen dataclass that says whether it is causal, with methods that can be called
    runs       trained and asked in a process of its own, it gives an estimate that can be judged
    gaps       a fiftieth of the samples lost, in bursts: the field boards have such records
    clipped    instruments whose range ends at half of what there was to see
    field      a drive of car S3: another car, faulty instruments
    short      5 m of road, and
    mode       states of the struts that it was not trained in: it may refuse, in one sentence
    sign ... repeat   the questions of `probes.py`, `repeat` over two processes
    time, memory      what a board allows

A check that does not apply, or is answered by a refusal that is allowed, has neither passed nor
failed. The judge's own process never loads the estimator.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from leaderboard.conformance.probes import CheckResult, evaluate_probes, perturbed_records
from leaderboard.evaluation.entry import Entry, EntryError, TrainingRun
from leaderboard.evaluation.tasks import load_task
from leaderboard.metrics.registry import compute_scores
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs.data.record import Estimate, Profile, Record
from road_envs.data.recording import simulate_record
from road_envs.roads import load_road
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

CAR, INSTRUMENTS = "land_rover_defender_110", "paper"
ROAD = {"kind": "iso8608", "road_class": "D", "length": 60.0, "coherence": "none"}
SPEED_KMH, MODE = 30.0, "handling"
TRAINING_SEEDS, TEST_SEED = (101, 102), 1
SEED = 1
"""Of the training."""

SHORT = 5.0
"""Length [m] of a road that an estimator may find too short."""

UNTRAINED_MODES = {"front": "soft_high", "rear": "stiff_low"}
"""States of the struts in which the sample's training drives were not driven."""

DROPOUT_RATE, DROPOUT_LENGTH = 0.02, 20
"""Share of the samples that is lost, and how many of them in a row."""

RUN_TIME_LIMIT = 300.0
"""Seconds that a run on the sample may take: its drives are an eighth of a condition's training and
less of its test, so that what takes longer would not come to an end on a board.
"""

REFUSAL_ALLOWED = ("short", "mode")
UNINTENDED_ERRORS = (
    "ArithmeticError", "AssertionError", "AttributeError", "EstimateError", "FloatingPointError",
    "IndexError", "KeyError", "LinAlgError", "MemoryError", "NameError", "OverflowError",
    "RecursionError", "TypeError", "UnboundLocalError", "ZeroDivisionError",
)  # fmt: skip
"""Errors that nobody raises to refuse a record."""

COST_TASK = "new_road"
"""The task whose drives a time is reckoned for."""


@dataclass(frozen=True)
class CheckDrives:
    """What an estimator is asked: drives to learn from, one with its truth, and damaged ones."""

    car: VehicleParameters
    training: tuple[tuple[Record, Profile], ...]
    record: Record
    truth: Profile
    damaged: Mapping[str, Record]
    message: str


@cache
def check_drives() -> CheckDrives:
    """The same drives in every run."""
    training = tuple(_drive(seed) for seed in TRAINING_SEEDS)
    record, truth = _drive(TEST_SEED)
    damaged = {
        "gaps": dataclasses.replace(record, a=_with_dropouts(record.a)),
        "clipped": dataclasses.replace(record, a=_clipped(record.a)),
        "field": _drive(TEST_SEED, grade="S3")[0],
        "short": _drive(TEST_SEED, length=SHORT)[0],
        "mode": _drive(TEST_SEED, mode=UNTRAINED_MODES)[0],
    }
    message = f"{record.length:g} m of class {ROAD['road_class']}, {MODE}, {SPEED_KMH:g} km/h"
    return CheckDrives(load_vehicle(CAR), training, record, truth, damaged, message)


def check_entry(entry: Entry, sandbox: SandboxClient, limits: Limits) -> list[CheckResult]:
    """Put everything to an entry, in processes of the `sandbox`; `limits` are those of the board.

    It stops where nothing more can be asked: at an estimator that cannot be made, or that does not
    run.
    """
    if entry.failure is not None:
        return [CheckResult(name="contract", passed=False, message=entry.failure)]
    how = "causal" if entry.causal else "offline"
    behind = f", {entry.lag:g} m behind the front axle" if entry.lag else ""
    contract = CheckResult(
        name="contract", passed=True, message=f"a frozen dataclass, {how}{behind}"
    )
    given = check_drives()
    try:
        alone = _run(sandbox, entry, [given.record])
    except EntryError as error:
        return [
            contract,
            CheckResult(name="runs", passed=False, message=f"on {given.message}: {error}"),
        ]
    found = [contract, _check_run(given, alone), *_check_damaged_records(sandbox, entry, given)]
    try:
        asked = _run_probes(sandbox, entry, given)
    except EntryError as error:
        return [*found, CheckResult(name="probes", passed=False, message=str(error))]
    return [
        *found,
        *_evaluate_probes(entry, given, alone, asked),
        *_check_costs(limits, given, asked),
    ]


def probe_entry(entry: Entry, sandbox: SandboxClient) -> list[CheckResult]:
    """The probes alone. Raises EntryError."""
    given = check_drives()
    alone = _run(sandbox, entry, [given.record])
    return _evaluate_probes(entry, given, alone, _run_probes(sandbox, entry, given))


def _run(sandbox: SandboxClient, entry: Entry, records: Sequence[Record]) -> TrainingRun:
    given = check_drives()
    (training_run,) = sandbox.reconstruct(
        entry.reference, entry.settings, given.training, records, given.car, [SEED], entry.name
    )
    return training_run


def _check_run(given: CheckDrives, training_run: TrainingRun) -> CheckResult:
    found = compute_scores(given.truth, training_run.estimates[0], SPEED_KMH / 3.6, False)
    held = (
        f"isolated by {training_run.isolation}"
        if training_run.isolation == "namespaces"
        else "isolated"
    )
    message = (
        f"{given.message}, in a process of its own ({held}): in-band error {found['nrmse']:.2f}, "
        "where a flat road has 1"
    )
    return CheckResult(name="runs", passed=True, message=message)


def _check_damaged_records(
    sandbox: SandboxClient, entry: Entry, given: CheckDrives
) -> list[CheckResult]:
    """All at once, and only where that fails one by one."""
    what = {
        "gaps": f"{DROPOUT_RATE:.0%} of the samples lost, in bursts",
        "clipped": "clipped at half of what there was to see",
        "field": "car S3 with faulty instruments",
        "short": f"{SHORT:g} m of road",
        "mode": "states of the struts unlike the training's",
    }
    try:
        _run(sandbox, entry, list(given.damaged.values()))
    except EntryError:
        return [
            _check_damaged_record(sandbox, entry, name, record, what)
            for name, record in given.damaged.items()
        ]
    return [
        CheckResult(name=name, passed=True, message=f"{what[name]}: estimated") for name in what
    ]


def _check_damaged_record(
    sandbox: SandboxClient, entry: Entry, name: str, record: Record, what: Mapping[str, str]
) -> CheckResult:
    try:
        _run(sandbox, entry, [record])
    except EntryError as error:
        refused = name in REFUSAL_ALLOWED and _is_refusal(str(error))
        message = re.sub(r"^estimating test drive [^:]*: ", "", str(error))
        verb = "refused" if refused else "failed"
        return CheckResult(
            name=name, passed=None if refused else False, message=f"{what[name]}: {verb}: {message}"
        )
    return CheckResult(name=name, passed=True, message=f"{what[name]}: estimated")


def _is_refusal(message: str) -> bool:
    """Whether an entry's failure is an error that its author wrote for the reader."""
    found = re.match(r"estimating test drive [^:]*: (\w+): (.+)", message)
    return found is not None and found[1] not in UNINTENDED_ERRORS and found[2] != "no message"


def _run_probes(sandbox: SandboxClient, entry: Entry, given: CheckDrives) -> TrainingRun:
    return _run(sandbox, entry, list(_perturbed_records(given).values()))


def _perturbed_records(given: CheckDrives) -> dict[str, Record]:
    return perturbed_records(given.record, load_instruments(INSTRUMENTS))


def _evaluate_probes(
    entry: Entry, given: CheckDrives, alone: TrainingRun, asked: TrainingRun
) -> list[CheckResult]:
    """`alone` has the estimate of the sample from another process, after a training of its own."""
    answers: dict[str, Estimate] = dict(
        zip(_perturbed_records(given), asked.estimates, strict=True)
    )
    answers["retrained"] = alone.estimates[0]
    return evaluate_probes(answers, given.record, bool(entry.causal), entry.lag)


def _check_costs(
    limits: Limits, given: CheckDrives, training_run: TrainingRun
) -> list[CheckResult]:
    """Reckoned for one condition of the board, one training, all test drives, from a run of some
    estimates, of which the first may have compiled something.
    """
    task = load_task(COST_TASK).with_test_drives(None)
    seen = sum(record.length for record, _ in given.training)
    learning, asked = (
        sum(r.length for r, _ in d.roads_and_seeds) for d in (task.training, task.test)
    )
    train, metres = training_run.train_seconds, len(training_run.estimates) * given.record.length
    reckoned = train * learning / seen + training_run.estimate_seconds * asked / metres
    per_100m = 1e5 * training_run.estimate_seconds / metres
    memory = training_run.peak_memory or 0.0
    return [
        CheckResult(
            name="time",
            passed=reckoned < limits.seconds,
            message=f"{train:.2f} s to train, {_format_number(per_100m)} ms per 100 m: about "
            f"{_format_number(reckoned)} s for a condition of {COST_TASK}, "
            f"of {limits.seconds:g} s allowed",
        ),
        CheckResult(
            name="memory",
            passed=memory < limits.memory,
            message=f"{memory:.2f} GiB at its peak, of {limits.memory:g} GiB allowed",
        ),
    ]


def _format_number(x: float) -> str:
    """A positive number in two or more digits, never as a power of ten."""
    return f"{x:.0f}" if x >= 10.0 else f"{x:.2g}"


def _drive(
    seed: int, mode: object = MODE, grade: str = "S0", length: float = 60.0
) -> tuple[Record, Profile]:
    road = load_road({**ROAD, "length": length})
    return simulate_record(
        load_vehicle(CAR),
        road.realise(np.random.default_rng(seed)),
        speed_kmh=SPEED_KMH,
        mode=mode,  # type: ignore[arg-type]
        instruments=load_instruments(INSTRUMENTS),
        seed=seed,
        grade=grade,
    )


def _with_dropouts(a: np.ndarray) -> np.ndarray:
    rng, found = np.random.default_rng(0), a.copy()
    for channel in found:
        for first in rng.integers(
            channel.size - DROPOUT_LENGTH,
            size=int(DROPOUT_RATE * channel.size / DROPOUT_LENGTH) + 1,
        ):
            channel[first : first + DROPOUT_LENGTH] = np.nan
    return found


def _clipped(a: np.ndarray) -> np.ndarray:
    limit = 0.5 * np.abs(a).max()
    return np.clip(a, -limit, limit)
