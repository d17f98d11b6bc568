"""What the paper says, what came out here, whether they agree, and why: made from the numbers."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from leaderboard.bounds import nrmse_bound
from leaderboard.paper.study import LIMITS, PRINTED, Study

NOTHING = ("constant", "unrelated_road", "mean")
"""Those that measure nothing."""

Verdict = Literal["agrees", "agrees in part", "does not agree"]
CLOSE = 3.0
"""Distance [dB] of two densities within which a class, 6 dB wide, is likely the same."""

PAPER_SECONDS = (65.0, 2.0)
"""For training and simulating the network, and for simulating it (section 7.2)."""


@dataclass(frozen=True)
class Claim:
    """A statement of the paper beside what was found; `why` where the difference has a reason."""

    where: str
    says: str
    found: str
    verdict: Verdict
    why: str = ""


def claims(study: Study) -> list[Claim]:
    """All of them, in the paper's order."""
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


def summary(study: Study) -> list[str]:
    """The few sentences that a reader should take away."""
    made = claims(study)
    counts = {v: sum(c.verdict == v for c in made) for v in ("agrees", "agrees in part")}
    error = np.mean([c.middle("nrmse") for c in study.paving])
    new = np.mean([study.new(c, "nrmse") for c in study.paving])
    constant = study.paving[0].sentinel("constant", PRINTED)
    return [
        f"Of {len(made)} statements of the paper {counts['agrees']} agree with what was found here "
        f"and {counts['agrees in part']} in part.",
        f"On the paving, equation 12 as it is printed gives {_listed(study, PRINTED)} where the "
        f"paper has {_claimed(study)} (handling and ride at 14.5 km/h, ride and handling at "
        "54 km/h).",
        "The equation compares levels, and of raw heights it compares mostly the datum: a "
        f"constant height, which has no road in it, is given {_percent(constant)}. Of heights "
        f"about their mean the same networks have {_listed(study, 'level_error')}.",
        f"Point by point, between 0.2 and 1.8 cycles/m, the error is {error:.2f} of the road, "
        "where a flat road has 1: the networks know little of this paving, though they were "
        "trained on an altered copy of it.",
        f"On roads that it has not seen, the network's error is {new:.2f}.",
    ]


def _bumps_found(study: Study) -> Claim:
    recall = [case.middle("bump_recall") for case in study.bumps]
    precision = [case.middle("bump_precision") for case in study.bumps]
    behind = [case.false_bumps() for case in study.bumps]
    wheelbase = study.bumps[0].task.vehicle.wheelbase
    return Claim(
        "section 7.1, conclusions",
        "The methodology locates the bumps where they occur.",
        f"Within 0.3 m {_percents(recall)} of the bumps were found in scenarios 1 to 4; of what "
        f"was taken for a bump {_percents(precision)} was one.",
        _verdict(sum(min(pair) > 0.9 for pair in zip(recall, precision, strict=True)), 4)
        if min(recall) <= 0.9 or min(precision) > 0.9
        else "agrees in part",
        f"The false bumps stand {_numbers(behind)} m behind a true one in the median: when the "
        f"rear axle, {wheelbase:.2f} m behind the front one, passes the bump, the body is shaken "
        "again, and a network without memory sees another bump.",
    )


def _bump_heights(study: Study) -> Claim:
    wrong = [case.middle("bump_height_error_relative") for case in study.bumps]
    good = sum(x < 0.2 for x in wrong)
    return Claim(
        "section 7.1, Figures 6 to 9",
        "Small bumps are reconstructed up to 0.08 m of their 0.1 m, large ones closely: within "
        "20 %.",
        f"The heights of the bumps that were found are wrong by {_percents(wrong)} in scenarios "
        "1 to 4.",
        _verdict(good, len(wrong)),
    )


def _ride_on_bumps(study: Study) -> Claim:
    pair = [next(c for c in study.bumps if c.number == number) for number in (3, 4)]
    ride, handling = (case.middle("nrmse") for case in pair)
    least = [nrmse_bound(c.task, c.task.conditions[0], c.truth) for c in pair]
    return Claim(
        "section 7.1, highlights",
        "Reconstructed bumps are better in ride comfort mode than in handling mode.",
        f"On the asymmetric bumps the in-band error is {ride:.2f} in ride and {handling:.2f} in "
        "handling.",
        "agrees" if ride < handling else "does not agree",
        "The paper blames its model of the car in handling. A stiff suspension hands on more of "
        f"the road: the least error of a linear estimator that knows the car is {least[0]:.3f} in "
        f"ride and {least[1]:.3f} in handling.",
    )


def _left_and_right(study: Study) -> Claim:
    pairs = [(case.middle("nrmse_left"), case.middle("nrmse_right")) for case in study.bumps]
    better = [left < right for left, right in pairs]
    listed = ", ".join(f"{left:.2f} and {right:.2f}" for left, right in pairs)
    return Claim(
        "section 7.1",
        "The left wheel path is reconstructed better than the right one, most of all on the "
        "asymmetric bumps.",
        f"In-band errors left and right in scenarios 1 to 4: {listed}.",
        _verdict(sum(better), len(better)),
        "On the asymmetric layout the large bump is on the left and the small one on the right, so "
        "the same error in metres is a larger share on the right. On symmetric layouts nothing "
        "tells left from right but the places of three accelerometers and the training's chance.",
    )


def _levels(study: Study) -> Claim:
    below = [case.middle(PRINTED) < LIMITS[0] for case in study.paving]
    case = study.paving[0]
    nothing = [_percent(case.sentinel(name, PRINTED)) for name in NOTHING]
    return Claim(
        "section 7.2, Figure 10",
        f"The RMS errors (equation 12) of the near-optimal trainings are below 15 %: "
        f"{_claimed(study)}.",
        f"Over {len(case.trainings)} trainings each: {_listed(study, PRINTED)} of raw heights, "
        f"{_listed(study, 'level_error')} about their means.",
        _verdict(sum(below), len(below)),
        "Of raw heights the equation counts the datum, which the network's bias learns: the mean "
        f"height of the training road alone is given {nothing[0]}, an unrelated road of the same "
        f"roughness {nothing[1]}, and the mean of the training roads {nothing[2]}. A network that "
        "fits a share r of the road in the least squares has the level r, hence an error of "
        "1 - r about the mean. The datum of the measured paving is not published; another one "
        "gives other figures.",
    )


def _order(study: Study) -> Claim:
    mine = [case.middle(PRINTED) for case in study.paving]
    low, high = np.mean(mine[:2]), np.mean(mine[2:])
    agrees = int(np.argmin(mine)) == 1, int(np.argmax(mine)) == 2
    return Claim(
        "section 7.2, Figure 10",
        "Best in ride at 14.5 km/h, worst in ride at 54 km/h, handling between the two.",
        f"{_listed(study, PRINTED)}: {_percent(float(low))} at 14.5 km/h and "
        f"{_percent(float(high))} at 54 km/h.",
        _verdict(sum(agrees), 2),
        "At 54 km/h the waves that move the body are longer and carry more of the road's height, "
        "so a network without memory fits a larger share of it. The paper's own sessions change "
        "their order from Figure 10 to A.1 and A.3.",
    )


def _densities(study: Study) -> Claim:
    mine = [case.middle("dsd_distance_db") for case in study.paving]
    stranger = [case.sentinel("unrelated_road", "dsd_distance_db") for case in study.paving]
    return Claim(
        "section 7.2, Figure 11, conclusions",
        "Densities are very well correlated between 0.2 and 1.8 cycles/m, whatever the training.",
        f"They are {_numbers(mine, 1)} dB apart in that band; those of an unrelated road "
        f"{_numbers(stranger, 1)} dB.",
        _verdict(sum(x < CLOSE for x in mine), len(mine)),
        "A density has no phase: an unrelated road of the same roughness has nearly the right one, "
        "and a network that fits little of the road has less of it.",
    )


def _classes(study: Study) -> Claim:
    mine = [case.middle("class_exact") for case in study.paving]
    bias = [case.middle("dsd_bias_db") for case in study.paving]
    stranger = [case.sentinel("unrelated_road", "class_exact") for case in study.paving]
    return Claim(
        "section 7.2",
        "The roads are consistently classified as D between 0.2 and 3 cycles/m.",
        f"{_percents(mine)} of the octaves are in the true class; of an unrelated road "
        f"{_percents(stranger)}.",
        _verdict(sum(x > 0.75 for x in mine), len(mine)),
        f"The densities are {_numbers(bias)} dB off in the mean over the band: a fit in the least "
        "squares that explains a small share of the road is as much too low, and a class is 6 dB "
        "wide.",
    )


def _states(study: Study) -> Claim:
    every = [t.state for case in study.cases for t in case.trainings]
    paving = [t.state for case in study.paving for t in case.trainings]
    kinds = ("near-optimal", "sub-optimal", "unstable")

    def told(states: list) -> str:
        shares = [f"{_percent(states.count(k) / len(states), 0)} {k}" for k in kinds]
        return ", ".join(shares)

    seen = sum(kind in paving for kind in kinds)
    return Claim(
        "Appendix A",
        "Trainings end near-optimal (equation 12 below 15 %), sub-optimal (15 to 25 %) or unstable "
        "(above 25 %), and it is hard to come to the same state twice.",
        f"On the paving {told(paving)}; of all scenarios {told(every)}.",
        _verdict(seen, 3),
        "The tests here are driven by a simulated car, whose accelerations stay near those of the "
        "training; the paper's are measured, and a network of 302 weights is free to go anywhere "
        "between and beyond its training samples.",
    )


def _times(study: Study) -> Claim:
    train = float(np.mean([t.train_seconds for case in study.cases for t in case.trainings]))
    run = float(np.mean([t.estimate_seconds for case in study.cases for t in case.trainings]))
    drives = float(np.mean([case.drive_seconds for case in study.cases]))
    total, simulation = PAPER_SECONDS
    return Claim(
        "section 7.2",
        f"Training and simulation of the network take {total:.0f} s, {simulation:.0f} s of which "
        "are simulation (Intel Core i7, 2.2 GHz, 2011).",
        f"{train:.2f} s for a training, {1e3 * run:.0f} ms for an estimate; the drives of a "
        f"scenario, training and test, are simulated in {drives:.2f} s.",
        "agrees" if train + run <= total else "does not agree",
        "Fast enough for a car on the road, as the paper says." if train + run <= total else "",
    )


def _verdict(good: int, of: int) -> Verdict:
    return "agrees" if good == of else "agrees in part" if good else "does not agree"


def _claimed(study: Study) -> str:
    return _percents([case.task.claimed_level_error or np.nan for case in study.paving])


def _listed(study: Study, score: str) -> str:
    return _percents([case.middle(score) for case in study.paving])


def _percents(values: list[float]) -> str:
    return _joined([f"{100 * x:.1f}" for x in values]) + " %"


def _numbers(values: list[float], digits: int = 1) -> str:
    return _joined([f"{x:.{digits}f}" for x in values])


def _joined(words: list[str]) -> str:
    return f"{', '.join(words[:-1])} and {words[-1]}"


def _percent(share: float, digits: int = 1) -> str:
    return f"{100 * share:.{digits}f} %"
