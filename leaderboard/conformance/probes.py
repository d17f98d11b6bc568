"""Does an estimator follow what was sensed? Questions put to it beside a short drive, and verdicts.

    sign      a mirrored up and down: the road must be mirrored
    scale     half the accelerations: a road of less height, of the same shape
    shuffle   accelerations in another order: another road
    swap      a mirrored left and right: the wheel paths must change places
    future    noise from the middle on: a causal estimate must not change before it
    repeat    asked twice, run and trained twice with one seed: one answer

`perturbed_records` makes the records and `evaluate_probes` compares the estimates made from them,
so the caller need not hold the estimator in its own process. `probe_estimator` does both here.

The body is rigid, so where there is no left front accelerometer, with sensors at y,

    a_LF = a_RF - 2 y_RF (a_LR - a_RR) / (y_LR - y_RR)

is what RF would feel of the mirrored road. Shapes are compared by Pearson's r inside the scored
band. A model of a nonlinear car need not be odd or proportional to the last digit, so r has to
pass 0.5 only; an estimate that does not look at the record has 1 where it should not, or 0.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimators.api import Estimator, Trainable
from leaderboard.metrics.heights import band_pass, correlation
from road_envs.config import STRICT
from road_envs.data.record import Estimate, Profile, Record, scored_band
from road_envs.sensing.instruments import Instruments, load_instruments
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import WHEELS

PROBES = ("sign", "scale", "shuffle", "swap", "future", "repeat")
MIN_CORRELATION = 0.5
"""Least r at which one shape is taken for the other."""

SCALE_FACTOR = 0.5
"""Factor on the accelerations in `scale`."""

LOOKAHEAD_THRESHOLD = 0.1
"""Change, over the estimate's own deviation, that counts as having looked ahead."""

EQUALITY_TOLERANCE = 1e-9
"""Change [m] below which an estimate has not changed: rounding."""

MIRRORED_WHEELS = [WHEELS.index(wheel) for wheel in ("FR", "FL", "RR", "RL")]


EstimateFunction = Callable[[Sequence[Record]], Sequence[Estimate]]
"""Estimates of some records, one each, after a training with a seed that is always the same."""


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """What came of one probe; `passed` is None where it does not apply to the estimator."""

    __pydantic_config__ = STRICT

    name: str
    passed: bool | None
    message: str


def perturbed_records(record: Record, instruments: Instruments, seed: int = 0) -> dict[str, Record]:
    """The records to be estimated by name of the probe; "asked" is `record` itself, "again" too."""
    rng = np.random.default_rng(seed)
    RF, LR, RR = record.a
    y = [place.y for place in vars(instruments.accelerometers).values()]
    LF = RF - 2.0 * y[0] * (LR - RR) / (y[1] - y[2])
    late = record.s >= 0.5 * record.length
    noise = np.nanstd(record.a) * rng.standard_normal(record.a.shape)
    changed = {
        "asked": record.a,
        "again": record.a,
        "sign": -record.a,
        "scale": SCALE_FACTOR * record.a,
        "shuffle": record.a[:, rng.permutation(record.t.size)],
        "future": record.a + np.where(late, noise, 0.0),
    }
    asked = {name: dataclasses.replace(record, a=a) for name, a in changed.items()}
    asked["swap"] = dataclasses.replace(
        record,
        a=np.stack([LF, RR, LR]),
        spring_stiff=record.spring_stiff[:, MIRRORED_WHEELS],
        damper_high=record.damper_high[:, MIRRORED_WHEELS],
    )
    return asked


def evaluate_probes(
    answers: Mapping[str, Estimate], record: Record, causal: bool, lag: float = 0.0
) -> list[CheckResult]:
    """Compare the estimates of `perturbed_records`; "retrained" is one of "asked" by a second run.

    `lag` [m] is how far behind the front axle a causal estimate stands.
    """
    band = scored_band(float(np.median(record.v)))
    shape = {name: band_pass(x.z, x.ds, band) for name, x in answers.items()}
    asked, ds = shape["asked"], answers["asked"].ds

    def likeness(name: str, wanted: np.ndarray) -> float:
        return float(np.nan_to_num(correlation(wanted, shape[name], ds).r)) + 0.0

    r = {
        "sign": likeness("sign", -asked),
        "scale": likeness("scale", asked),
        "shuffle": likeness("shuffle", asked),
        "swap": likeness("swap", asked[::-1]),
    }
    level = float(np.sqrt(np.mean(shape["scale"] ** 2) / max(np.mean(asked**2), 1e-30)))
    looks = bool(asked.any())
    return [
        CheckResult(
            name="sign",
            passed=r["sign"] > MIN_CORRELATION,
            message=f"upside down, r = {r['sign']:.2f} to the mirrored estimate",
        ),
        CheckResult(
            name="scale",
            passed=r["scale"] > MIN_CORRELATION and SCALE_FACTOR**2 < level < SCALE_FACTOR**0.5,
            message=f"at half the accelerations {level:.2f} of the height, r = {r['scale']:.2f}",
        ),
        CheckResult(
            name="shuffle",
            passed=looks and abs(r["shuffle"]) < MIN_CORRELATION,
            message=f"out of order, r = {r['shuffle']:.2f} to the estimate in order",
        ),
        CheckResult(
            name="swap",
            passed=r["swap"] > MIN_CORRELATION,
            message=f"left for right, r = {r['swap']:.2f} to the exchanged wheel paths",
        ),
        _evaluate_future(answers, record, causal, lag),
        _evaluate_repeat(answers),
    ]


def _evaluate_future(
    answers: Mapping[str, Estimate], record: Record, causal: bool, lag: float
) -> CheckResult:
    stations = answers["asked"].s
    change = np.abs(answers["future"].z - answers["asked"].z).max(axis=0)
    sample = float(np.diff(record.s).max())  # between two samples one may interpolate
    first = 0.5 * record.length - lag - sample
    if causal:
        early = change[stations < first]
        known = f", {lag:g} m behind the front axle" if lag else ""
        return CheckResult(
            name="future",
            passed=bool(early.max(initial=0.0) <= EQUALITY_TOLERANCE),
            message=f"what comes later changes {1e3 * early.max(initial=0.0):.3g} mm of it{known}",
        )
    felt = stations[change > LOOKAHEAD_THRESHOLD * answers["asked"].z.std()]
    reach = max(0.0, first - felt.min(initial=first))
    return CheckResult(name="future", passed=None, message=f"offline: looks {reach:.1f} m ahead")


def _evaluate_repeat(answers: Mapping[str, Estimate]) -> CheckResult:
    how = {"again": "asked twice", "retrained": "run twice with one seed"}
    gap = {name: float(np.abs(answers[name].z - answers["asked"].z).max()) for name in how}
    message = ", ".join(f"{how[name]}: {1e3 * x:.3g} mm apart" for name, x in gap.items())
    return CheckResult(
        name="repeat", passed=max(gap.values()) <= EQUALITY_TOLERANCE, message=message
    )


def run_probes(
    answer: EstimateFunction,
    record: Record,
    instruments: Instruments,
    causal: bool,
    lag: float = 0.0,
) -> list[CheckResult]:
    """Probe whoever stands behind `answer`, on a `record` of 50 m or more.

    `answer` trains, if there is something to train, and estimates some records; it is called twice
    and has to use one training seed. Raises what it raises.
    """
    asked = perturbed_records(record, instruments)
    answers = dict(zip(asked, answer(list(asked.values())), strict=True))
    (answers["retrained"],) = answer([record])
    return evaluate_probes(answers, record, causal, lag)


def probe_estimator(
    estimator: Estimator,
    record: Record,
    car: VehicleParameters,
    *,
    training: Sequence[tuple[Record, Profile]] = (),
    seed: int = 1,
    instruments: Instruments | None = None,
) -> list[CheckResult]:
    """As `run_probes`, of an estimator in this process; one that learns does so on `training`."""

    def answer(records: Sequence[Record]) -> list[Estimate]:
        fitted = estimator
        if isinstance(estimator, Trainable) and training:
            seen, truths = [list(part) for part in zip(*training, strict=True)]
            fitted = estimator.fit(seen, truths, car, seed)
        return [fitted.estimate(one, car) for one in records]

    lag = getattr(estimator, "lag", None) or 0.0
    return run_probes(
        answer, record, instruments or load_instruments("paper"), estimator.causal, lag
    )


def count_passed(probes: Sequence[CheckResult]) -> str:
    """How a board shows them: "5/5", those passed of those that apply."""
    told = [p.passed for p in probes if p.passed is not None]
    return f"{sum(told)}/{len(told)}" if told else ""
