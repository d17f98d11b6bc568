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

from leaderboard.conformance.probes import Probe, questions, verdicts
from leaderboard.evaluation.entry import Entry, EntryError, Outcome
from leaderboard.evaluation.tasks import load_task
from leaderboard.metrics.registry import scores
from leaderboard.sandbox.client import Host
from leaderboard.sandbox.limits import Limits
from road_envs.data.record import Estimate, Profile, Record
from road_envs.data.recording import record_drive
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

UNKNOWN = {"front": "soft_high", "rear": "stiff_low"}
"""States of the struts in which the sample's training drives were not driven."""

LOST, BURST = 0.02, 20
"""Share of the samples that is lost, and how many of them in a row."""

PATIENCE = 300.0
"""Seconds that a run on the sample may take: its drives are an eighth of a condition's training and
less of its test, so that what takes longer would not come to an end on a board.
"""

MAY_REFUSE = ("short", "mode")
ACCIDENTS = (
    "ArithmeticError", "AssertionError", "AttributeError", "EstimateError", "FloatingPointError",
    "IndexError", "KeyError", "LinAlgError", "MemoryError", "NameError", "OverflowError",
    "RecursionError", "TypeError", "UnboundLocalError", "ZeroDivisionError",
)  # fmt: skip
"""Errors that nobody raises to refuse a record."""

BOARD = "new_road"
"""The task whose drives a time is reckoned for."""


@dataclass(frozen=True)
class Sample:
    """What an estimator is asked: drives to learn from, one with its truth, and damaged ones."""

    car: VehicleParameters
    training: tuple[tuple[Record, Profile], ...]
    record: Record
    truth: Profile
    damaged: Mapping[str, Record]
    said: str


@cache
def sample() -> Sample:
    """The same drives in every run."""
    training = tuple(_drive(seed) for seed in TRAINING_SEEDS)
    record, truth = _drive(TEST_SEED)
    damaged = {
        "gaps": dataclasses.replace(record, a=_with_gaps(record.a)),
        "clipped": dataclasses.replace(record, a=_clipped(record.a)),
        "field": _drive(TEST_SEED, grade="S3")[0],
        "short": _drive(TEST_SEED, length=SHORT)[0],
        "mode": _drive(TEST_SEED, mode=UNKNOWN)[0],
    }
    said = f"{record.length:g} m of class {ROAD['road_class']}, {MODE}, {SPEED_KMH:g} km/h"
    return Sample(load_vehicle(CAR), training, record, truth, damaged, said)


def check(entry: Entry, host: Host, limits: Limits) -> list[Probe]:
    """Put everything to an entry, in processes of the `host`; `limits` are those of the board.

    It stops where nothing more can be asked: at an estimator that cannot be made, or that does not
    run.
    """
    if entry.failure is not None:
        return [Probe(name="contract", passed=False, said=entry.failure)]
    how = "causal" if entry.causal else "offline"
    behind = f", {entry.lag:g} m behind the front axle" if entry.lag else ""
    contract = Probe(name="contract", passed=True, said=f"a frozen dataclass, {how}{behind}")
    given = sample()
    try:
        alone = _ask(host, entry, [given.record])
    except EntryError as error:
        return [contract, Probe(name="runs", passed=False, said=f"on {given.said}: {error}")]
    found = [contract, _runs(given, alone), *_damaged(host, entry, given)]
    try:
        asked = _asked(host, entry, given)
    except EntryError as error:
        return [*found, Probe(name="probes", passed=False, said=str(error))]
    return [*found, *_verdicts(entry, given, alone, asked), *_costs(limits, given, asked)]


def probe_entry(entry: Entry, host: Host) -> list[Probe]:
    """The probes alone. Raises EntryError."""
    given = sample()
    alone = _ask(host, entry, [given.record])
    return _verdicts(entry, given, alone, _asked(host, entry, given))


def _ask(host: Host, entry: Entry, records: Sequence[Record]) -> Outcome:
    given = sample()
    (outcome,) = host.reconstruct(
        entry.reference, entry.settings, given.training, records, given.car, [SEED], entry.name
    )
    return outcome


def _runs(given: Sample, outcome: Outcome) -> Probe:
    found = scores(given.truth, outcome.estimates[0], SPEED_KMH / 3.6, False)
    held = f"isolated by {outcome.isolation}" if outcome.isolation == "namespaces" else "isolated"
    said = (
        f"{given.said}, in a process of its own ({held}): in-band error {found['nrmse']:.2f}, "
        "where a flat road has 1"
    )
    return Probe(name="runs", passed=True, said=said)


def _damaged(host: Host, entry: Entry, given: Sample) -> list[Probe]:
    """All at once, and only where that fails one by one."""
    what = {
        "gaps": f"{LOST:.0%} of the samples lost, in bursts",
        "clipped": "clipped at half of what there was to see",
        "field": "car S3 with faulty instruments",
        "short": f"{SHORT:g} m of road",
        "mode": "states of the struts unlike the training's",
    }
    try:
        _ask(host, entry, list(given.damaged.values()))
    except EntryError:
        return [_one(host, entry, name, record, what) for name, record in given.damaged.items()]
    return [Probe(name=name, passed=True, said=f"{what[name]}: estimated") for name in what]


def _one(host: Host, entry: Entry, name: str, record: Record, what: Mapping[str, str]) -> Probe:
    try:
        _ask(host, entry, [record])
    except EntryError as error:
        refused = name in MAY_REFUSE and _is_refusal(str(error))
        said = re.sub(r"^estimating test drive [^:]*: ", "", str(error))
        verb = "refused" if refused else "failed"
        return Probe(
            name=name, passed=None if refused else False, said=f"{what[name]}: {verb}: {said}"
        )
    return Probe(name=name, passed=True, said=f"{what[name]}: estimated")


def _is_refusal(said: str) -> bool:
    """Whether an entry's failure is an error that its author wrote for the reader."""
    found = re.match(r"estimating test drive [^:]*: (\w+): (.+)", said)
    return found is not None and found[1] not in ACCIDENTS and found[2] != "no message"


def _asked(host: Host, entry: Entry, given: Sample) -> Outcome:
    return _ask(host, entry, list(_questions(given).values()))


def _questions(given: Sample) -> dict[str, Record]:
    return questions(given.record, load_instruments(INSTRUMENTS))


def _verdicts(entry: Entry, given: Sample, alone: Outcome, asked: Outcome) -> list[Probe]:
    """`alone` has the estimate of the sample from another process, after a training of its own."""
    answers: dict[str, Estimate] = dict(zip(_questions(given), asked.estimates, strict=True))
    answers["retrained"] = alone.estimates[0]
    return verdicts(answers, given.record, bool(entry.causal), entry.lag)


def _costs(limits: Limits, given: Sample, outcome: Outcome) -> list[Probe]:
    """Reckoned for one condition of the board, one training, all test drives, from a run of some
    estimates, of which the first may have compiled something.
    """
    task = load_task(BOARD).with_roads(None)
    seen = sum(record.length for record, _ in given.training)
    learning, asked = (sum(r.length for r, _ in d.pairs) for d in (task.training, task.test))
    train, metres = outcome.train_seconds, len(outcome.estimates) * given.record.length
    reckoned = train * learning / seen + outcome.estimate_seconds * asked / metres
    per_100m = 1e5 * outcome.estimate_seconds / metres
    memory = outcome.peak_memory or 0.0
    return [
        Probe(
            name="time",
            passed=reckoned < limits.seconds,
            said=f"{train:.2f} s to train, {_short(per_100m)} ms per 100 m: about "
            f"{_short(reckoned)} s for a condition of {BOARD}, of {limits.seconds:g} s allowed",
        ),
        Probe(
            name="memory",
            passed=memory < limits.memory,
            said=f"{memory:.2f} GiB at its peak, of {limits.memory:g} GiB allowed",
        ),
    ]


def _short(x: float) -> str:
    """A positive number in two or more digits, never as a power of ten."""
    return f"{x:.0f}" if x >= 10.0 else f"{x:.2g}"


def _drive(
    seed: int, mode: object = MODE, grade: str = "S0", length: float = 60.0
) -> tuple[Record, Profile]:
    road = load_road({**ROAD, "length": length})
    return record_drive(
        load_vehicle(CAR),
        road.realise(np.random.default_rng(seed)),
        speed_kmh=SPEED_KMH,
        mode=mode,  # type: ignore[arg-type]
        instruments=load_instruments(INSTRUMENTS),
        seed=seed,
        grade=grade,
    )


def _with_gaps(a: np.ndarray) -> np.ndarray:
    rng, found = np.random.default_rng(0), a.copy()
    for channel in found:
        for first in rng.integers(channel.size - BURST, size=int(LOST * channel.size / BURST) + 1):
            channel[first : first + BURST] = np.nan
    return found


def _clipped(a: np.ndarray) -> np.ndarray:
    limit = 0.5 * np.abs(a).max()
    return np.clip(a, -limit, limit)
