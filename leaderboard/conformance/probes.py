"""Probes of an estimator: perturbed copies of a short record, and checks of the estimates.

    sign      accelerations negated: the estimate must be negated
    scale     accelerations halved: the estimate must be lower, with the same shape
    shuffle   samples in random order: the estimate must be uncorrelated
    swap      left and right exchanged: the wheel paths must be exchanged
    future    other samples from the middle on: a causal estimate must not change before it
    repeat    estimated twice, and trained twice with one seed: the estimates must be equal

`perturbed_records` makes the records and `evaluate_probes` compares the estimates made from them,
so the estimator may run in another process. `probe_estimator` does both in this process.

There is no left front accelerometer. Since the body is rigid, with sensors at lateral positions y,

    a_LF = a_RF - 2 y_RF (a_LR - a_RR) / (y_LR - y_RR)

is what sensor RF would measure on the mirrored road. Shapes are compared by Pearson's r in the
scored band. The threshold is only 0.5, since the model of a nonlinear vehicle is neither odd nor
proportional; an estimate that ignores the record has r = 1 with itself where it must differ, or 0.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimators.api import Estimator, declared_lag
from leaderboard.entries.entry import LocalSession
from leaderboard.metrics.heights import band_pass, correlation
from leaderboard.sandbox.retest import EQUALITY_TOLERANCE, largest_change, with_other_future
from road_envs.core.config import Settings
from road_envs.records.record import SENSORS, Estimate, Profile, Record, scored_band
from road_envs.sensing.instruments import Instruments, load_instruments
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import WHEELS

PROBES = ("sign", "scale", "shuffle", "swap", "future", "repeat")
MIN_CORRELATION = 0.5  # least r between shapes that count as equal
SCALE_FACTOR = 0.5  # on the accelerations in `scale`
LOOKAHEAD_THRESHOLD = 0.1
"""Least change that counts as use of later samples, relative to the estimate's deviation."""

MIRRORED_WHEELS = [WHEELS.index(wheel) for wheel in ("FR", "FL", "RR", "RL")]


@dataclass(frozen=True)
class CheckResult(Settings):
    """Result of one check or probe; `passed` is None if it does not apply to the estimator."""

    name: str
    passed: bool | None
    message: str


def perturbed_records(record: Record, instruments: Instruments, seed: int = 0) -> dict[str, Record]:
    """Return the records to estimate by name; "original" and "again" are unperturbed."""
    rng = np.random.default_rng(seed)
    RF, LR, RR = record.a
    y = [instruments.accelerometers[name].y for name in SENSORS]
    LF = RF - 2.0 * y[0] * (LR - RR) / (y[1] - y[2])
    accelerations = {
        "original": record.a,
        "again": record.a,
        "sign": -record.a,
        "scale": SCALE_FACTOR * record.a,
        "shuffle": record.a[:, rng.permutation(record.t.size)],
    }
    records = {name: dataclasses.replace(record, a=a) for name, a in accelerations.items()}
    records["future"] = with_other_future(record, 0.5 * record.length, rng)
    records["swap"] = dataclasses.replace(
        record,
        a=np.stack([LF, RR, LR]),
        spring_stiff=record.spring_stiff[:, MIRRORED_WHEELS],
        damper_high=record.damper_high[:, MIRRORED_WHEELS],
    )
    return records


def evaluate_probes(
    estimates: Mapping[str, Estimate], record: Record, causal: bool, lag: float = 0.0
) -> list[CheckResult]:
    """Compare the estimates of `perturbed_records` and return one result for each probe.

    `estimates` has one more key: "retrained" is the estimate of "original" after another training.
    `lag` [m] is the distance of a causal estimate behind the front axle.
    """
    band = scored_band(float(np.median(record.v)))
    shapes = {name: band_pass(x.z, x.ds, band) for name, x in estimates.items()}
    original, ds = shapes["original"], estimates["original"].ds

    def similarity(name: str, expected: np.ndarray) -> float:
        return float(np.nan_to_num(correlation(expected, shapes[name], ds).r)) + 0.0

    sign, swap = similarity("sign", -original), similarity("swap", original[::-1])
    scale, shuffle = similarity("scale", original), similarity("shuffle", original)
    level = float(np.sqrt(np.mean(shapes["scale"] ** 2) / max(np.mean(original**2), 1e-30)))
    is_lower = SCALE_FACTOR**2 < level < SCALE_FACTOR**0.5
    negated = f"accelerations negated: r = {sign:.2f} with the negated estimate"
    halved = f"accelerations halved: {level:.2f} of the height, r = {scale:.2f}"
    shuffled = f"samples shuffled: r = {shuffle:.2f} with the estimate"
    swapped = f"left and right exchanged: r = {swap:.2f} with exchanged wheel paths"
    return [
        CheckResult("sign", sign > MIN_CORRELATION, negated),
        CheckResult("scale", scale > MIN_CORRELATION and is_lower, halved),
        CheckResult("shuffle", bool(original.any()) and abs(shuffle) < MIN_CORRELATION, shuffled),
        CheckResult("swap", swap > MIN_CORRELATION, swapped),
        _evaluate_future(estimates, record, causal, lag),
        _evaluate_repeat(estimates, record),
    ]


def _evaluate_future(
    estimates: Mapping[str, Estimate], record: Record, causal: bool, lag: float
) -> CheckResult:
    original, future, start = estimates["original"], estimates["future"], 0.5 * record.length
    if causal:
        early = largest_change(original, future, start, lag, record)
        behind = f", {lag:g} m behind the front axle" if lag else ""
        message = f"later samples change the estimate by {1e3 * early:.3g} mm{behind}"
        return CheckResult("future", early <= EQUALITY_TOLERANCE, message)
    change = np.abs(future.z - original.z).max(axis=0)
    changed = original.s[change > LOOKAHEAD_THRESHOLD * original.z.std()]
    reach = max(0.0, start - changed.min(initial=start))
    return CheckResult("future", None, f"offline: uses samples up to {reach:.1f} m ahead")


def _evaluate_repeat(estimates: Mapping[str, Estimate], record: Record) -> CheckResult:
    words = {"again": "estimated twice", "retrained": "trained twice with one seed"}
    gap = {
        name: largest_change(estimates[name], estimates["original"], np.inf, 0.0, record)
        for name in words
    }
    message = ", ".join(f"{words[name]}: {1e3 * x:.3g} mm apart" for name, x in gap.items())
    return CheckResult("repeat", max(gap.values()) <= EQUALITY_TOLERANCE, message)


def probe_estimator(
    estimator: Estimator,
    record: Record,
    car: VehicleParameters,
    *,
    training: Sequence[tuple[Record, Profile]] = (),
    seed: int = 1,
    instruments: Instruments | None = None,
) -> list[CheckResult]:
    """Probe an estimator in this process on a `record` of 50 m or more.

    A trainable one is fitted to `training` first, twice. Raises what the estimator raises.
    """
    session = LocalSession(estimator, car)
    records = perturbed_records(record, instruments or load_instruments("paper"))
    estimates: dict[str, Estimate] = {}
    for names in (records, ("retrained",)):
        session.fit(training, seed)
        estimates |= {name: session.estimate(records.get(name, record))[0] for name in names}
    return evaluate_probes(estimates, record, estimator.causal, declared_lag(estimator))


def count_passed(probes: Sequence[CheckResult]) -> str:
    """Return the number of passed and of applicable probes, such as "5/5"; "" for none."""
    applicable = [probe.passed for probe in probes if probe.passed is not None]
    return f"{sum(applicable)}/{len(applicable)}" if applicable else ""
