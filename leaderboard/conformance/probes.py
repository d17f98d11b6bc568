"""Does an estimator follow what was sensed? Questions put to it beside a short drive, and verdicts.

    sign      a mirrored up and down: the road must be mirrored
    scale     half the accelerations: a road of less height, of the same shape
    shuffle   accelerations in another order: another road
    swap      a mirrored left and right: the wheel paths must change places
    future    noise from the middle on: a causal estimate must not change before it
    repeat    asked twice, run and trained twice with one seed: one answer

`questions` makes the records, whoever runs the estimator answers them, `verdicts` compares the
answers; so a judge need not hold the estimator in its own process. `probe` does all three here.

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
FOLLOWS = 0.5
"""Least r at which one shape is taken for the other."""

HALF = 0.5
"""Factor on the accelerations in `scale`."""

FELT = 0.1
"""Change, over the estimate's own deviation, that counts as having looked ahead."""

SAME = 1e-9
"""Change [m] below which an estimate has not changed: rounding."""

MIRRORED = [WHEELS.index(wheel) for wheel in ("FR", "FL", "RR", "RL")]


Answer = Callable[[Sequence[Record]], Sequence[Estimate]]
"""Estimates of some records, one each, after a training with a seed that is always the same."""


@dataclass(frozen=True, kw_only=True)
class Probe:
    """What came of one probe; `passed` is None where it does not apply to the estimator."""

    __pydantic_config__ = STRICT

    name: str
    passed: bool | None
    said: str


def questions(record: Record, instruments: Instruments, seed: int = 0) -> dict[str, Record]:
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
        "scale": HALF * record.a,
        "shuffle": record.a[:, rng.permutation(record.t.size)],
        "future": record.a + np.where(late, noise, 0.0),
    }
    asked = {name: dataclasses.replace(record, a=a) for name, a in changed.items()}
    asked["swap"] = dataclasses.replace(
        record,
        a=np.stack([LF, RR, LR]),
        stiff=record.stiff[:, MIRRORED],
        high=record.high[:, MIRRORED],
    )
    return asked


def verdicts(
    answers: Mapping[str, Estimate], record: Record, causal: bool, lag: float = 0.0
) -> list[Probe]:
    """What the estimates of `questions` say; "retrained" is another of "asked" by a second run.

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
        Probe(
            name="sign",
            passed=r["sign"] > FOLLOWS,
            said=f"upside down, r = {r['sign']:.2f} to the mirrored estimate",
        ),
        Probe(
            name="scale",
            passed=r["scale"] > FOLLOWS and HALF**2 < level < HALF**0.5,
            said=f"at half the accelerations {level:.2f} of the height, r = {r['scale']:.2f}",
        ),
        Probe(
            name="shuffle",
            passed=looks and abs(r["shuffle"]) < FOLLOWS,
            said=f"out of order, r = {r['shuffle']:.2f} to the estimate in order",
        ),
        Probe(
            name="swap",
            passed=r["swap"] > FOLLOWS,
            said=f"left for right, r = {r['swap']:.2f} to the exchanged wheel paths",
        ),
        _future(answers, record, causal, lag),
        _repeat(answers),
    ]


def _future(answers: Mapping[str, Estimate], record: Record, causal: bool, lag: float) -> Probe:
    stations = answers["asked"].s
    change = np.abs(answers["future"].z - answers["asked"].z).max(axis=0)
    sample = float(np.diff(record.s).max())  # between two samples one may interpolate
    first = 0.5 * record.length - lag - sample
    if causal:
        early = change[stations < first]
        known = f", {lag:g} m behind the front axle" if lag else ""
        return Probe(
            name="future",
            passed=bool(early.max(initial=0.0) <= SAME),
            said=f"what comes later changes {1e3 * early.max(initial=0.0):.3g} mm of it{known}",
        )
    felt = stations[change > FELT * answers["asked"].z.std()]
    reach = max(0.0, first - felt.min(initial=first))
    return Probe(name="future", passed=None, said=f"offline: looks {reach:.1f} m ahead")


def _repeat(answers: Mapping[str, Estimate]) -> Probe:
    how = {"again": "asked twice", "retrained": "run twice with one seed"}
    gap = {name: float(np.abs(answers[name].z - answers["asked"].z).max()) for name in how}
    said = ", ".join(f"{how[name]}: {1e3 * x:.3g} mm apart" for name, x in gap.items())
    return Probe(name="repeat", passed=max(gap.values()) <= SAME, said=said)


def examine(
    answer: Answer, record: Record, instruments: Instruments, causal: bool, lag: float = 0.0
) -> list[Probe]:
    """Probe whoever stands behind `answer`, on a `record` of 50 m or more.

    `answer` trains, if there is something to train, and estimates some records; it is called twice
    and has to use one training seed. Raises what it raises.
    """
    asked = questions(record, instruments)
    answers = dict(zip(asked, answer(list(asked.values())), strict=True))
    (answers["retrained"],) = answer([record])
    return verdicts(answers, record, causal, lag)


def probe(
    estimator: Estimator,
    record: Record,
    car: VehicleParameters,
    *,
    training: Sequence[tuple[Record, Profile]] = (),
    seed: int = 1,
    instruments: Instruments | None = None,
) -> list[Probe]:
    """As `examine`, of an estimator in this process; one that learns does so on `training`."""

    def answer(records: Sequence[Record]) -> list[Estimate]:
        fitted = estimator
        if isinstance(estimator, Trainable) and training:
            seen, truths = [list(part) for part in zip(*training, strict=True)]
            fitted = estimator.fit(seen, truths, car, seed)
        return [fitted.estimate(one, car) for one in records]

    lag = getattr(estimator, "lag", None) or 0.0
    return examine(answer, record, instruments or load_instruments("paper"), estimator.causal, lag)


def mark(probes: Sequence[Probe]) -> str:
    """How a board shows them: "5/5", those passed of those that apply."""
    told = [p.passed for p in probes if p.passed is not None]
    return f"{sum(told)}/{len(told)}" if told else ""
