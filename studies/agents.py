"""Learners of switching, each from several seeds, against every law: who reaches the bar?

    python -m studies.agents rows.jsonl [--learner ppo=2] [--plot curves.png]

`learned` is policy iteration (`road-recon train-policy`); `ppo`, `recurrent_ppo` and `qrdqn` are
the learners of Stable-Baselines3 and sb3-contrib on the features of `FeatureVecEnv`, which are
equal for mirror images, with the settings of `studies.trained_networks`. All train on training
drives only, and drive the first DRIVES public drives, each to both sides, as they are and with cars
and instruments of grade S3.

The bar: more than every law, with the lower end of a 95 % bootstrap over seeds and drives above 0,
on all drives, on their mirror images, on unseen ones and on those of S3; no group of drives below
ride by more than TIE; violations not above those of `rrms`.
"""

import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.evaluation.provenance import describe_environment
from leaderboard.policies.comparison import GROUPS, REFERENCE, TIE, interval, members
from road_envs.policies import REGISTRY, create
from road_envs.policies.fixed import FixedPair
from road_envs.policies.network_policy import NetworkPolicy
from road_envs.policies.policy_iteration import IterationConfig, iterate
from road_envs.policies.rollout import Drives, drive_all
from road_envs.vehicle.suspension import MODES
from studies import trained_networks
from studies.policy_robustness import public
from studies.study import Row, run_study, study_parser

LEARNERS = ("learned", "recurrent_ppo", "ppo", "qrdqn")
LAWS = ("rrms", "rrms_lateral", "lateral", "skyhook", "groundhook", "add", "sh_add")
RIDE, BEST_LAW, OTHER = "ride/ride", "rrms_lateral", "mpc"
SEEDS = 5  # by default
DRIVES = 24
"""Public drives; the table of `road-recon policies` has the first eight."""

SETS: dict[str, dict[str, Any]] = {"public": {}, "S3": {"grade": "S3"}}
"""Fields that are fixed in each set of drives."""


@cache
def drive_sets() -> dict[str, Drives]:
    """Return the drives of SETS, each followed by its mirror image."""
    return {name: public(DRIVES, **fixed) for name, fixed in SETS.items()}


def compute(policy: str, seed: int) -> Row:
    """Train a learner from a seed, or take a law, and drive all sets.

    `curve` are steps or rounds and scores on other training drives, `seconds` the CPU time of the
    training on `machine`, `scores` [m²/s⁴] and `violated` (N,) of each set.
    """
    environment = describe_environment()
    machine = ", ".join(f"{name} {environment[name]}" for name in ("numpy", "torch", "processor"))
    begin = time.process_time()
    curve: Sequence[tuple[int, float]] = ()
    driver: Any
    if policy == "learned":
        network, curve = iterate(IterationConfig(), seed, lambda text, share: None)
        driver = NetworkPolicy.from_network(network)
    elif policy in LEARNERS:
        driver, curve = trained_networks.train(trained_networks.CONFIGS[policy], seed)
    elif policy in REGISTRY:
        driver = create(policy)
    else:
        front, rear = policy.split("/")
        driver = FixedPair(front=front, rear=rear)  # type: ignore[arg-type]
    seconds = time.process_time() - begin
    return {"curve": curve, "seconds": seconds, "machine": machine} | evaluate(driver)


def evaluate(driver: Any) -> Row:
    """Return the scores and violations of a policy on every set."""
    driven = {name: drive_all(driver, drives) for name, drives in drive_sets().items()}
    return {
        "scores": {name: [round(x, 5) for x in r.score.tolist()] for name, r in driven.items()},
        "violated": {name: r.violated.tolist() for name, r in driven.items()},
    }


class Results:
    """Scores and violations of the rows, by policy as arrays (S, N), and the parts of the bar."""

    def __init__(self, rows: list[Row]):
        self.rows, drives = rows, public(DRIVES)
        self.groups = {name: members(drives, name) for name in GROUPS}
        mirror = np.arange(len(drives)) % 2 == 1
        every = np.ones(len(drives), dtype=bool)
        self.parts = {
            "public": ("public", every),
            "mirrored": ("public", mirror),
            "unseen": ("public", self.groups["unseen"]),
            "S3": ("S3", every),
        }

    def of(self, policy: str, key: str, drives: str = "public") -> np.ndarray:
        """Return `scores` or `violated` (S, N) of a policy on a set of drives."""
        return np.array([row[key][drives] for row in self.rows if row["policy"] == policy])

    def more(self, policy: str, rival: str, part: str) -> dict[str, float]:
        """Return the gain over a rival on a part of the bar, with its interval."""
        drives, inside = self.parts[part]
        gain = self.of(policy, "scores", drives) - self.of(rival, "scores", drives)
        families = self.groups["known"][inside]
        return interval(gain[:, inside], families, mirrored=part != "mirrored")

    def hardest(self, policy: str, part: str) -> tuple[str, dict[str, float]]:
        """Return the law over which a policy gains least, by the lower end, and the gain."""
        laws = [row["policy"] for row in self.rows if row["policy"] not in (*LEARNERS, OTHER)]
        gains = {law: self.more(policy, law, part) for law in laws}
        law = min(gains, key=lambda name: gains[name]["low"])
        return law, gains[law]

    def groups_of(self, policy: str) -> dict[str, tuple[dict[str, float], float, float, float]]:
        """Return, by group of public drives, the gain over BEST_LAW with its interval, that over
        ride, and the shares of drives with a violation of the policy and of REFERENCE.
        """
        own = self.of(policy, "scores")
        law, ride = (own - self.of(name, "scores") for name in (BEST_LAW, RIDE))
        violated, base = (self.of(name, "violated") for name in (policy, REFERENCE))
        known = self.groups["known"]
        return {
            name: (
                interval(law[:, inside], known[inside], mirrored=name not in ("left", "right")),
                float(ride[:, inside].mean()),
                float(violated[:, inside].mean()),
                float(base[:, inside].mean()),
            )
            for name, inside in self.groups.items()
            if inside.any()
        }

    def missed(self, policy: str) -> list[str]:
        """Return the clauses of the bar that a policy misses."""
        parts = [part for part in self.parts if not self.hardest(policy, part)[1]["low"] > 0.0]
        found = [f"not above every law: {', '.join(parts)}"] * bool(parts)
        groups = self.groups_of(policy).items()
        below = [name for name, (_, ride, *_) in groups if ride < -TIE]
        found += [f"below ride: {', '.join(below)}"] * bool(below)
        own, base = (self.of(name, "violated").mean() for name in (policy, REFERENCE))
        more = f"violates in {own:.0%} of the public drives, {REFERENCE} in {base:.0%}"
        return found + [more] * bool(own > base)


def signed(gain: dict[str, float]) -> str:
    """Return a gain with its interval, if it has one."""
    if np.isnan(gain["low"]):
        return f"{gain['mean']:+.3f} (few drives)".ljust(25)  # as wide as with an interval
    return f"{gain['mean']:+.3f} ({gain['low']:+.3f} to {gain['high']:+.3f})"


def summary(rows: list[Row]) -> str:
    """Return the table of the bar, the groups of each learner, and each seed with its curve."""
    found = Results(rows)
    learners = [name for name in LEARNERS if any(row["policy"] == name for row in rows)]
    lines = [
        f"{DRIVES} public drives, each to both sides; gains in score [m²/s⁴]",
        f"{'learner':14s}seeds  CPU-min  drives    over the law nearest to it              "
        f"over {OTHER}",
    ]
    for name in learners:
        own = [row for row in rows if row["policy"] == name]
        head = f"{name:14s}{len(own):5d}{np.mean([row['seconds'] for row in own]) / 60.0:9.1f}"
        for part in found.parts:
            law, gain = found.hardest(name, part)
            other = signed(found.more(name, OTHER, part))
            lines.append(f"{head:28s}  {part:10s}{signed(gain)} {law:13s} {other}")
            head = ""
        lines.append(f"{'':30s}bar: {'; '.join(found.missed(name)) or 'reached'}")
    trained = {(row["machine"], row["policy"]) for row in rows if row["policy"] in learners}
    lines += [f"{policy} trained with {machine}" for machine, policy in sorted(trained)]
    for name in learners:
        title = f"{name}, by group"
        lines += ["", f"{title:24s}over {BEST_LAW:24s} over ride  violations ({REFERENCE})"]
        lines += [
            f"{group:24s}{signed(gain)}{ride:+15.3f}{own:10.0%} ({base:.0%})"
            for group, (gain, ride, own, base) in found.groups_of(name).items()
        ]
    lines += ["", f"each seed over {REFERENCE}; its violations; scores on training drives"]
    for row in rows:
        if row["policy"] in LEARNERS:
            gains = []
            for part, (drives, inside) in found.parts.items():
                gain = row["scores"][drives] - found.of(REFERENCE, "scores", drives)[0]
                gains.append(f"{part} {gain[inside].mean():+.3f}")
            curve = " ".join(f"{score:.2f}" for _, score in row["curve"])
            violated = f"{np.mean(row['violated']['public']):.0%}"
            lines.append(f"{row['policy']} {row['seed']}: {', '.join(gains)}; {violated}; {curve}")
    return "\n".join(lines)


def draw(rows: list[Row], path: Path) -> None:
    """Draw the learning curves against the CPU time of the training."""
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(figsize=(7.0, 3.6), layout="constrained")
    for k, name in enumerate(LEARNERS):
        for row in rows:
            if row["policy"] == name:
                curve = np.array(row["curve"])
                minutes = curve[:, 0] / curve[-1, 0] * row["seconds"] / 60.0
                label = name if row["seed"] == 1 else None
                axes.plot(minutes, curve[:, 1], color=f"C{k}", lw=1.0, label=label)
    axes.set(xlabel="CPU time of the training [min]", ylabel="score on training drives [m²/s⁴]")
    axes.legend()
    fig.savefig(path, dpi=120)
    plt.close(fig)


def learner(text: str) -> tuple[str, int]:
    """Return a learner and its number of seeds from `NAME` or `NAME=SEEDS`. Raises ValueError."""
    name, _, seeds = text.partition("=")
    return LEARNERS[LEARNERS.index(name)], int(seeds or SEEDS)


def main() -> None:
    """Train what is missing, print the table and draw the curves."""
    parser = study_parser("Learners of switching against every law.")
    form = "NAME[=SEEDS]"
    parser.add_argument(
        "--learner", action="append", type=learner, metavar=form, help=", ".join(LEARNERS)
    )
    chosen = parser.parse_args()
    laws = [*LAWS, OTHER, *(f"{front}/{rear}" for rear in MODES for front in MODES)]
    cases: list[Row] = [{"policy": law, "seed": 0} for law in laws]
    wanted = chosen.learner or [(name, SEEDS) for name in LEARNERS]
    cases += [{"policy": name, "seed": k + 1} for name, seeds in wanted for k in range(seeds)]
    run_study(chosen, cases, compute, summary, draw)


if __name__ == "__main__":
    main()
