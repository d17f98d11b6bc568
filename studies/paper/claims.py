"""The statements of the paper, each compared with the results of the study."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from leaderboard.evaluation.bound import nrmse_bound
from leaderboard.metrics.heights import scored_band
from leaderboard.metrics.level import EQ_12_RAW, STATE_LIMITS
from studies.paper.study import (
    TRAINING_STATES,
    Study,
    TrainingState,
    iq_means,
    training_state,
)

NAIVE_BASELINES = ("constant", "unrelated_road", "mean")
"""Baselines that use no measurement."""

Verdict = Literal["agrees", "agrees in part", "does not agree"]
FLAT_ERROR = 0.9
"""In-band error above which an estimate is hardly better than a flat road, which has 1."""

CLOSE_DB = 3.0
"""Distance [dB] of two densities within which their class, 6 dB wide, is likely the same."""

PAPER_SECONDS = (65.0, 2.0)
"""The paper's time for training and simulating the network, and for simulating it (7.2)."""


@dataclass(frozen=True)
class Claim:
    """A statement of the paper and the result of the study; `reason` explains a difference."""

    section: str
    statement: str
    result: str
    verdict: Verdict
    reason: str = ""


def claims(study: Study) -> list[Claim]:
    """Return the compared statements, in the order of the paper."""
    return [
        _bumps_found(study),
        _bump_heights(study),
        _ride_on_bumps(study),
        _left_and_right(study),
        _levels(study),
        _order(study),
        _densities(study),
        _classes(study),
        _states(study),
        _times(study),
    ]


def key_findings(study: Study) -> list[str]:
    """Return the summary of the report as a few sentences."""
    compared = claims(study)
    counts = {v: sum(c.verdict == v for c in compared) for v in ("agrees", "agrees in part")}
    paving = study.paving
    constant, unrelated = (
        _percents(sorted({each.baseline_median(name, EQ_12_RAW) for each in paving}))
        for name in ("constant", "unrelated_road")
    )
    return [
        f"Of {len(compared)} statements of the paper {counts['agrees']} agree with the results "
        f"and {counts['agrees in part']} agree in part.",
        f"On the paving, equation 12 as it is printed gives {_listed(study, EQ_12_RAW)} where the "
        f"paper has {_claimed(study)} (handling and ride at 14.5 km/h, ride and handling at "
        f"54 km/h). On the car of their training the same networks have "
        f"{_percents(iq_means(paving, EQ_12_RAW)[1])}.",
        "The equation compares levels, and of raw heights mostly the datum: a constant height, "
        f"without any road, has {constant}, an unrelated road of the same roughness {unrelated}. "
        "With heights about their mean the networks have "
        f"{_listed(study, 'level_error')}.",
        _point_by_point(study),
        _new_roads(study),
    ]


def _point_by_point(study: Study) -> str:
    field, own = iq_means(study.paving, "nrmse")
    low, high = scored_band(min(scenario.speed for scenario in study.paving))
    sentence = (
        f"Point by point, between {low:g} and {high:g} cycles/m, the error is {_numbers(field, 2)} "
        f"of the road, and {_numbers(own, 2)} on the car of the training, where a flat road has 1"
    )
    if min(own) > FLAT_ERROR:
        return (
            f"{sentence}: the networks reproduce little of this paving, though they were trained "
            "on an altered copy of it."
        )
    return f"{sentence}."


def _new_roads(study: Study) -> str:
    new = [study.new_road_score(scenario, "nrmse") for scenario in study.paving]
    level = [study.new_road_score(scenario, EQ_12_RAW) for scenario in study.paving]
    worse = ", worse than a flat road" if min(new) > 1.0 else ""
    return (
        f"On unseen roads, the networks' error is {_numbers(new, 2)}{worse}; by "
        f"equation 12 it is {_percents(level)}."
    )


def _bumps_found(study: Study) -> Claim:
    recall, own = iq_means(study.bumps, "bump_recall")
    precision, _ = iq_means(study.bumps, "bump_precision")
    return Claim(
        "section 7.1, conclusions",
        "The methodology locates the bumps where they occur.",
        f"Recall within 0.3 m is {_percents(recall, 0)} in scenarios 1 to 4, and "
        f"{_percents(own, 0)} on the car of the training; precision is {_percents(precision, 0)}.",
        _verdict(sum(min(pair) > 0.9 for pair in zip(recall, precision, strict=True)), 4)
        if min(recall) <= 0.9 or min(precision) > 0.9
        else "agrees in part",
        _false_bumps(study),
    )


def _false_bumps(study: Study) -> str:
    behind = [x for scenario in study.bumps if np.isfinite(x := scenario.false_bump_offset())]
    if not behind:
        return "There are no false bumps."
    wheelbase = study.bumps[0].task.vehicle.wheelbase
    sentence = f"The false bumps lie {_numbers(behind)} m behind a true one in the median"
    if max(abs(x - wheelbase) for x in behind) > 0.3 * wheelbase:
        return f"{sentence}."
    return (
        f"{sentence}: when the rear axle, {wheelbase:.2f} m behind the front one, passes the bump, "
        "the body is excited again, and a network without memory detects another bump."
    )


def _bump_heights(study: Study) -> Claim:
    wrong, _ = iq_means(study.bumps, "bump_height_error_relative")
    good = sum(x < 0.2 for x in wrong)
    return Claim(
        "section 7.1, Figures 6 to 9",
        "Small bumps are reconstructed up to 0.08 m of their 0.1 m, large ones closely: within "
        "20 %.",
        f"Height errors of the detected bumps are {_percents(wrong, 0)} in scenarios 1 to 4.",
        _verdict(good, len(wrong)),
    )


def _ride_on_bumps(study: Study) -> Claim:
    pair = [next(c for c in study.bumps if c.number == number) for number in (3, 4)]
    (ride, handling), own = iq_means(pair, "nrmse")
    least = [nrmse_bound(c.task, c.task.conditions[0], c.truth) for c in pair]
    bound = (
        f"the least error of a linear estimator that knows the car is {least[0]:.3f} in ride and "
        f"{least[1]:.3f} in handling"
    )
    reason = (
        f"A stiff suspension transmits more of the road: {bound}. The paper attributes it to its "
        "model of the car in handling."
        if (least[1] < least[0]) and handling <= ride
        else f"The sensors do not explain it: {bound}."
    )
    return Claim(
        "section 7.1, highlights",
        "Reconstructed bumps are better in ride comfort mode than in handling mode.",
        f"On the asymmetric bumps the in-band error is {ride:.2f} in ride and {handling:.2f} in "
        f"handling; on the car of the training {own[0]:.2f} and {own[1]:.2f}.",
        "agrees" if ride < handling else "does not agree",
        reason,
    )


def _left_and_right(study: Study) -> Claim:
    sides = (iq_means(study.bumps, f"nrmse_{side}") for side in ("left", "right"))
    pairs, own = (list(zip(*each, strict=True)) for each in zip(*sides, strict=True))
    better = [left < right for left, right in pairs]
    better_own = sum(left < right for left, right in own)
    return Claim(
        "section 7.1",
        "The left wheel path is reconstructed better than the right one, most of all on the "
        "asymmetric bumps.",
        f"In-band errors left and right in scenarios 1 to 4: {_pairs(pairs)}; on the car of the "
        f"training {_pairs(own)}.",
        _verdict(sum(better), len(better)),
        f"On the car of the training the left one is better in {better_own} of {len(own)}. On the "
        "asymmetric layout (3 and 4) the large bump is on the left and the small one on the right, "
        "so the same error in metres is a larger share on the right. On symmetric layouts (1 and "
        "2) left and right differ only by the locations of the three accelerometers, the asymmetry "
        "of the car and the random start of the training.",
    )


def _levels(study: Study) -> Claim:
    below = [scenario.iq_mean(EQ_12_RAW) < STATE_LIMITS[0] for scenario in study.paving]
    scenario = study.paving[0]
    naive = [_percent(scenario.baseline_median(name, EQ_12_RAW)) for name in NAIVE_BASELINES]
    own = _percents(iq_means(study.paving, EQ_12_RAW)[1])
    return Claim(
        "section 7.2, Figure 10",
        f"The RMS errors (equation 12) of the near-optimal trainings are below 15 %: "
        f"{_claimed(study)}.",
        f"Over {len(scenario.trainings)} trainings each: {_listed(study, EQ_12_RAW)} of raw "
        f"heights, {_listed(study, 'level_error')} about their means; on the car of the training "
        f"{own} of raw heights.",
        _verdict(sum(below), len(below)),
        "With raw heights the equation includes the datum, which the network's bias learns: the "
        f"mean height of the training road alone has {naive[0]}, an unrelated road of the same "
        f"roughness {naive[1]}, and the mean of the training roads {naive[2]}. A least-squares fit "
        "that explains a share r of the road has the level r, hence an error of 1 - r about the "
        "mean. The datum of the measured paving is not published; another gives other values.",
    )


def _order(study: Study) -> Claim:
    mine, own = iq_means(study.paving, EQ_12_RAW)
    low, high = float(np.mean(mine[:2])), float(np.mean(mine[2:]))
    agrees = int(np.argmin(mine)) == 1, int(np.argmax(mine)) == 2  # ride at 14.5, at 54 km/h
    faster = (
        ": there the faster drives are better, since at 54 km/h the wavelengths that excite the "
        "body are longer and have more of the road's height"
        if np.mean(own[2:]) < np.mean(own[:2])
        else ""
    )
    return Claim(
        "section 7.2, Figure 10",
        "Best in ride at 14.5 km/h, worst in ride at 54 km/h, handling between the two.",
        f"{_listed(study, EQ_12_RAW)}: {_percent(low)} at 14.5 km/h and {_percent(high)} at "
        "54 km/h.",
        _verdict(sum(agrees), 2),
        f"On the car of the training it is {_percents(own)}{faster}. The paper's own sessions "
        "change their order from Figure 10 to A.1 and A.3.",
    )


def _densities(study: Study) -> Claim:
    mine, own = iq_means(study.paving, "dsd_distance_db")
    unrelated = _unrelated(study, "dsd_distance_db")
    easy = (
        ": without any measurement it has nearly the right one"
        if max(unrelated) < 1.5 * CLOSE_DB
        else ""
    )
    return Claim(
        "section 7.2, Figure 11, conclusions",
        "Densities are very well correlated between 0.2 and 1.8 cycles/m, whatever the training.",
        f"They are {_numbers(mine)} dB apart in that band, and {_numbers(own)} dB on the car of "
        f"the training; those of an unrelated road {_numbers(unrelated)} dB.",
        _verdict(sum(x < CLOSE_DB for x in mine), len(mine)),
        f"A density has no phase, so an unrelated road of the same roughness can match it{easy}. "
        f"{_bias(study)}",
    )


def _classes(study: Study) -> Claim:
    mine, own = iq_means(study.paving, "class_exact")
    unrelated = _unrelated(study, "class_exact")
    return Claim(
        "section 7.2",
        "The roads are consistently classified as D between 0.2 and 3 cycles/m.",
        f"{_percents(mine, 0)} of the octaves are in the true class, {_percents(own, 0)} on the "
        f"car of the training; of an unrelated road {_percents(unrelated, 0)}.",
        _verdict(sum(x > 0.75 for x in mine), len(mine)),
        f"A class is 6 dB wide. {_bias(study)}",
    )


def _bias(study: Study) -> str:
    """Return sentences on the sign of the density errors and its cause."""
    field, own = iq_means(study.paving, "dsd_bias_db")
    sentences = (
        f"The networks' densities are {_numbers(field)} dB off in the mean over the band, and "
        f"{_numbers(own)} dB on the car of the training."
    )
    if max(own) < 0.0:
        sentences += (
            " There they are too low, since a least-squares fit that explains a small share of the "
            "road has no more than that share of its height."
        )
    if max(field) > CLOSE_DB:
        sentences += (
            " Where they are too high, the field car's accelerations lie outside the range of the "
            "training."
        )
    return sentences


def _states(study: Study) -> Claim:
    paving = [t.state for scenario in study.paving for t in scenario.trainings]
    every = [t.state for scenario in study.scenarios for t in scenario.trainings]
    own = [training_state(x) for s in study.paving for x in s.score_values(EQ_12_RAW, nominal=True)]
    seen = sum(kind in paving for kind in TRAINING_STATES)
    lost = (paving.count("unstable") - own.count("unstable")) / len(paving)
    reason = (
        "the networks are unstable because they are tested on another car than that of the "
        "training: a network of 302 weights is not constrained between and beyond its training "
        "samples. Those of the paper were tested on a measured car."
        if lost > 0.1
        else "the other car makes little difference."
    )
    return Claim(
        "Appendix A",
        "Trainings end near-optimal (equation 12 below 15 %), sub-optimal (15 to 25 %) or unstable "
        "(above 25 %), and it is hard to come to the same state twice.",
        f"On the paving {_shares(paving)}; of all scenarios {_shares(every)}.",
        _verdict(seen, 3),
        f"On the paving, on the car of the training, {_shares(own)}: {reason}",
    )


def _shares(states: list[TrainingState]) -> str:
    shares = [f"{_percent(states.count(k) / len(states), 0)} {k}" for k in TRAINING_STATES]
    return ", ".join(shares)


def _times(study: Study) -> Claim:
    trainings = [t for scenario in study.scenarios for t in scenario.trainings]
    train = float(np.mean([t.train_seconds for t in trainings]))
    run = float(np.mean([t.estimate_seconds for t in trainings]))
    drives = float(np.mean([scenario.drive_seconds for scenario in study.scenarios]))
    total, simulation = PAPER_SECONDS
    return Claim(
        "section 7.2",
        f"Training and simulation of the network take {total:.0f} s, {simulation:.0f} s of which "
        "are simulation (Intel Core i7, 2.2 GHz, 2011).",
        f"{train:.2f} s for a training, {1e3 * run:.0f} ms for an estimate; the drives of a "
        f"scenario, training and test, are simulated in {drives:.2f} s.",
        "agrees" if train + run <= total else "does not agree",
        "Fast enough for use on the road, as the paper states." if train + run <= total else "",
    )


def _verdict(good: int, of: int) -> Verdict:
    return "agrees" if good == of else "agrees in part" if good else "does not agree"


def _claimed(study: Study) -> str:
    return _percents([scenario.task.claimed_level_error or np.nan for scenario in study.paving])


def _listed(study: Study, score: str) -> str:
    return _percents(iq_means(study.paving, score)[0])


def _unrelated(study: Study, score: str) -> list[float]:
    return [scenario.baseline_median("unrelated_road", score) for scenario in study.paving]


def _percents(values: list[float], digits: int = 1) -> str:
    return _joined([f"{100 * x:.{digits}f}" for x in values]) + " %"


def _pairs(pairs: list[tuple[float, float]]) -> str:
    return "; ".join(f"{left:.2f}, {right:.2f}" for left, right in pairs)


def _numbers(values: list[float], digits: int = 1) -> str:
    return _joined([f"{x:.{digits}f}" for x in values])


def _joined(words: list[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _percent(share: float, digits: int = 1) -> str:
    return f"{100 * share:.{digits}f} %"
