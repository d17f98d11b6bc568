"""Conformance checks of an estimator before submission, one sentence for each check.

    contract   a frozen dataclass with the attribute `causal` and the required methods
    runs       trained and run in a separate process, it returns a valid estimate in metres
    gaps       2 % of the samples lost in bursts, as in records of the field board
    clipped    accelerometers clipped at half of the peak value
    field      a drive of car S3: perturbed vehicle, faulty instruments; calibrated, if it can be
    short      5 m of road; the estimator may refuse it with an error message
    mode       strut modes that were not in its training; the estimator may refuse them too
    sign ... repeat   the probes of `probes.py`, `repeat` in two processes
    time, memory      the limits of a board

The result of a check that does not apply or that is refused is neither passed nor failed. This
process never loads the estimator.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from estimators.api import CalibrationDrive
from leaderboard.conformance.probes import CheckResult, evaluate_probes, perturbed_records
from leaderboard.entries.entry import Calibrations, Entry, EntryError, TrainingRun
from leaderboard.evaluation.evaluate import SEEDS
from leaderboard.evaluation.tasks import load_task
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from leaderboard.scoring import score
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Profile, Record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

_CAR, _INSTRUMENTS = "land_rover_defender_110", "paper"
_ROAD = {"kind": "iso8608", "road_class": "D", "length": 60.0, "coherence": "none"}
_SPEED_KMH, _MODE = 30.0, "handling"
_TRAINING_SEEDS, _TEST_SEED = (101, 102), 1
_SEED = 1  # training seed

SHORT_LENGTH = 5.0  # length [m] of a road that an estimator may refuse
_UNTRAINED_MODES = {"front": "soft_high", "rear": "stiff_low"}  # of no training drive
_DROPOUT_RATE, _DROPOUT_LENGTH = 0.02, 20  # share and number of consecutive lost samples

_DAMAGES = {
    "gaps": f"{_DROPOUT_RATE:.0%} of the samples lost, in bursts",
    "clipped": "accelerations clipped at half of their peak",
    "field": "car S3 with faulty instruments",
    "short": f"{SHORT_LENGTH:g} m of road",
    "mode": "strut modes that were not in the training",
}
"""Damaged records by name."""

RUN_TIME_LIMIT = 300.0
"""Time limit [s] of one run on these drives. They are an eighth of a condition's training drives
and less of its test drives, so a slower estimator would exceed the limit of a board.
"""

_MAX_ERROR = 10.0
"""In-band error above which heights are not in metres: a flat road has 1, a wrong sign 2."""

_REFUSAL_ALLOWED = ("short", "mode")
UNINTENDED_ERRORS = (
    "ArithmeticError", "AssertionError", "AttributeError", "EstimateError", "FloatingPointError",
    "IndexError", "KeyError", "LinAlgError", "MemoryError", "NameError", "OverflowError",
    "RecursionError", "TypeError", "UnboundLocalError", "ZeroDivisionError",
)  # fmt: skip
"""Errors that are bugs of an estimator, not deliberate refusals of a record."""

_COST_TASK = "new_road"  # task for which the run time is predicted


@dataclass(frozen=True)
class _CheckDrives:
    """Drives of the checks, and damaged and perturbed records (`probes`) of the test drive."""

    car: VehicleParameters
    training: tuple[tuple[Record, Profile], ...]
    record: Record
    truth: Profile
    damaged: Mapping[str, Record]
    perturbed: Mapping[str, Record]
    description: str


@cache
def check_drives() -> _CheckDrives:
    """Simulate the drives of the checks, always the same."""
    drive = partial(
        simulate_record, _ROAD, speed_kmh=_SPEED_KMH, vehicle=_CAR, instruments=_INSTRUMENTS
    )
    training = tuple(drive(seed=seed, mode=_MODE) for seed in _TRAINING_SEEDS)
    record, truth = drive(seed=_TEST_SEED, mode=_MODE)
    half = 0.5 * np.abs(record.a).max()
    damaged = {
        "gaps": dataclasses.replace(record, a=_with_dropouts(record.a)),
        "clipped": dataclasses.replace(record, a=np.clip(record.a, -half, half)),
        "field": drive(seed=_TEST_SEED, mode=_MODE, grade="S3")[0],
        "short": drive(seed=_TEST_SEED, mode=_MODE, length=SHORT_LENGTH)[0],
        "mode": drive(seed=_TEST_SEED, mode=_UNTRAINED_MODES)[0],
    }
    description = (
        f"{record.length:g} m of class {_ROAD['road_class']}, {_MODE}, {_SPEED_KMH:g} km/h"
    )
    perturbed, car = perturbed_records(record, load_instruments(_INSTRUMENTS)), load_vehicle(_CAR)
    return _CheckDrives(car, training, record, truth, damaged, perturbed, description)


def check_entry(entry: Entry, sandbox: SandboxClient, limits: Limits) -> list[CheckResult]:
    """Run all checks of an entry in the `sandbox`; `limits` are those of the board.

    Stops after the first check of an estimator that cannot be constructed or does not run.
    """
    if entry.failure is not None:
        return [CheckResult("contract", False, entry.failure)]
    kind = "causal" if entry.causal else "offline"
    behind = f", {entry.lag:g} m behind the front axle" if entry.lag else ""
    contract = CheckResult("contract", True, f"a frozen dataclass, {kind}{behind}")
    drives = check_drives()
    try:
        single = _run(sandbox, entry, [drives.record])
    except EntryError as failure:
        return [contract, CheckResult("runs", False, f"on {drives.description}: {failure}")]
    error = score(single.estimates[0], drives.truth, speed_kmh=_SPEED_KMH)["nrmse"]
    message = (
        f"{drives.description}, in a separate process (isolation: {single.isolation}): "
        f"in-band error {error:.2f}, a flat estimate has 1"
    )
    if error > _MAX_ERROR:
        message += "; heights must be in metres, upwards: are these in millimetres?"
    results = [contract, CheckResult("runs", not error > _MAX_ERROR, message)]
    results += _check_damaged_records(sandbox, entry, drives)
    try:
        probed = _run(sandbox, entry, list(drives.perturbed.values()))
    except EntryError as failure:
        return [*results, CheckResult("probes", False, str(failure))]
    results += _evaluate_probes(entry, drives, single, probed)
    return results + _check_costs(limits, drives, probed)


def probe_entry(entry: Entry, sandbox: SandboxClient) -> list[CheckResult]:
    """Run only the probes of an entry. Raises EntryError."""
    drives = check_drives()
    single = _run(sandbox, entry, [drives.record])
    probed = _run(sandbox, entry, list(drives.perturbed.values()))
    return _evaluate_probes(entry, drives, single, probed)


def _run(
    sandbox: SandboxClient, entry: Entry, records: Sequence[Record], known: Calibrations = ()
) -> TrainingRun:
    drives = check_drives()
    (training_run,) = sandbox.reconstruct(
        entry, drives.training, records, drives.car, [_SEED], calibrations=known
    )
    return training_run


def _check_damaged_records(
    sandbox: SandboxClient, entry: Entry, drives: _CheckDrives
) -> list[CheckResult]:
    """Run all damaged records at once, and one by one only if that fails; calibrate for one."""
    known = {"field": [[CalibrationDrive(*drives.training[0])]]}
    results = [CheckResult(name, True, f"{what}: estimated") for name, what in _DAMAGES.items()]
    try:
        _run(sandbox, entry, list(drives.damaged.values()))
        _run(sandbox, entry, [drives.damaged["field"]], known["field"])
    except EntryError:
        for k, (name, record) in enumerate(drives.damaged.items()):
            try:
                _run(sandbox, entry, [record], known.get(name, ()))
            except EntryError as error:
                reason = re.sub(r"^estimating test drive [^:]*: ", "", str(error))
                found = re.match(r"(?:estimat|calibrat)ing [^:]*: (\w+): (.+)", str(error))
                meant = found and found[1] not in UNINTENDED_ERRORS and found[2] != "no message"
                refused = meant and (name in _REFUSAL_ALLOWED or ": CalibrationError: " in reason)
                message = f"{_DAMAGES[name]}: {'refused' if refused else 'failed'}: {reason}"
                results[k] = CheckResult(name, None if refused else False, message)
    return results


def _evaluate_probes(
    entry: Entry, drives: _CheckDrives, single: TrainingRun, probed: TrainingRun
) -> list[CheckResult]:
    """Evaluate the probes; `single` is a run on the test record alone, with its own training."""
    estimates = dict(zip(drives.perturbed, probed.estimates, strict=True))
    estimates["retrained"] = single.estimates[0]
    return evaluate_probes(estimates, drives.record, bool(entry.causal), entry.lag)


def _check_costs(
    limits: Limits, drives: _CheckDrives, training_run: TrainingRun
) -> list[CheckResult]:
    """Check time and memory against the limits.

    The time is extrapolated to all trainings and test drives of a condition of _COST_TASK; it is an
    upper bound, since the first estimate may include compilation.
    """
    task = load_task(_COST_TASK).with_test_drives(None)
    measured_training = sum(record.length for record, _ in drives.training)
    training_length, test_length = (
        sum(road.length for road, _ in part.roads_and_seeds) for part in (task.training, task.test)
    )
    train_seconds = training_run.train_seconds
    metres = len(training_run.estimates) * drives.record.length
    trainings = len(SEEDS) if training_run.parameters else 1
    predicted = trainings * (
        train_seconds * training_length / measured_training
        + training_run.estimate_seconds * test_length / metres
    )
    per_100m = 1e5 * training_run.estimate_seconds / metres
    memory = training_run.peak_memory or 0.0
    message = (
        f"{train_seconds:.2f} s to train, {_format_number(per_100m)} ms per 100 m: about "
        f"{_format_number(predicted)} s for a condition of {_COST_TASK}, the limit is "
        f"{limits.seconds:g} s"
    )
    peak = f"peak {memory:.2f} GiB, the limit is {limits.memory:g} GiB"
    time = CheckResult("time", predicted < limits.seconds, message)
    return [time, CheckResult("memory", memory < limits.memory, peak)]


def _format_number(x: float) -> str:
    """Return a positive number with two or more digits, never in exponential notation."""
    return f"{x:.0f}" if x >= 10.0 else f"{x:.2g}"


def _with_dropouts(a: np.ndarray) -> np.ndarray:
    rng, damaged = np.random.default_rng(0), a.copy()
    for channel in damaged:
        for first in rng.integers(
            channel.size - _DROPOUT_LENGTH,
            size=int(_DROPOUT_RATE * channel.size / _DROPOUT_LENGTH) + 1,
        ):
            channel[first : first + _DROPOUT_LENGTH] = np.nan
    return damaged
