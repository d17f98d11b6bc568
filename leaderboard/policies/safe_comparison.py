"""Comparison of policies on the public drives of `RoadRecon/Safe4S4-v1`.

Each public drive is driven to both sides. All policies drive the same roads, cars and faults, and
the best switching found on the known road stands beside them as a line. Intervals are 95 %
bootstraps over the drives, a drive and its mirror image together.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from leaderboard.policies import best_found
from leaderboard.policies.comparison import TIME_LIMIT, time_limit
from road_envs.core.config import ConfigError
from road_envs.envs.safe4s4 import Safe4S4Setup
from road_envs.policies.api import Policy
from road_envs.policies.safe_rollout import SafeDrives, SafeRollout, drive_safely

BEST_FOUND = "best found"
"""Name of the row of `best_found.search`."""

PUBLIC_DRIVES = 8
"""Number of public drives; each is driven to both sides."""

SEARCH_SEED, BOOTSTRAPS = 1, 2000

TIE = 0.01
"""Difference of scores [m²/s⁴] within which two policies are even on a drive."""

Progress = Callable[[str, float], None]


def public_drives(number: int = PUBLIC_DRIVES, seal: str | None = None) -> SafeDrives:
    """Return the public drives, or the sealed ones: both groups in turn, each to both sides."""
    setup = Safe4S4Setup({"split": "test" if seal is None else "sealed", "seal": seal})
    groups = [{"group": ("known", "unseen")[k % 2]} for k in range(number)]
    return SafeDrives.mirrored(setup, range(number), groups)


def compare_safely(
    policies: Mapping[str, Policy],
    drives: SafeDrives,
    reference: str,
    *,
    generations: int = best_found.GENERATIONS,
    seconds: float = TIME_LIMIT,
    progress: Progress = lambda text, share: None,
) -> dict[str, Any]:
    """Return the rows of all policies and of the best switching found, as plain data.

    A policy that raises an error is a row with its failure. Without `generations` nothing is
    searched. Raises ConfigError if the reference is not among the policies.
    """
    if reference not in policies:
        raise ConfigError(f"the reference {reference} is not among {', '.join(policies)}")
    rollouts: dict[str, SafeRollout] = {}
    failures: dict[str, str] = {}
    for k, (name, policy) in enumerate(policies.items()):
        progress(name, 0.3 * k / len(policies))
        try:
            with time_limit(seconds):
                rollouts[name] = drive_safely(policy, drives)
        except Exception as error:  # a failing policy must not stop the comparison
            message = " ".join(str(error).split()) or "no message"
            failures[name] = f"{type(error).__name__}: {message}"
    if generations and rollouts:
        rows = [rollout.actions for rollout in rollouts.values()]
        rollouts[BEST_FOUND] = best_found.search(
            drives, rows, SEARCH_SEED, generations=generations,
            progress=lambda text, share: progress(f"best found: {text}", 0.3 + 0.7 * share),
        )  # fmt: skip
    base = rollouts.get(reference)
    rows_of_table = [_row(name, r, base, drives) for name, r in rollouts.items()]
    rows_of_table += [{"policy": name, "failure": text} for name, text in failures.items()]
    progress("done", 1.0)
    return {
        "benchmark": drives.setup.benchmark.name,
        "split": drives.setup.safe.split,
        "drives": len(drives),
        "reference": reference,
        "rows": rows_of_table,
    }


def _row(
    name: str, rollout: SafeRollout, base: SafeRollout | None, drives: SafeDrives
) -> dict[str, Any]:
    """Return the row of a policy as plain data."""
    described = [start.description for start, _ in drives.starts]
    groups = {
        "known": [d.group == "known" for d in described],
        "unseen": [d.group == "unseen" for d in described],
        "left": [d.side == "left" for d in described],
        "right": [d.side == "right" for d in described],
        "S3": [d.grade == "S3" for d in described],
    }
    score, violated = rollout.score, rollout.violated
    row: dict[str, Any] = {
        "policy": name,
        "failure": None,
        "score": _interval(score),
        "comfort": _interval(rollout.comfort),
        "violations": float(violated.mean()),
        "cost": _round(rollout.totals["cost"].mean()),
        "lift_off": _round(rollout.totals["lift_off"].mean()),
        "load_transfer": _round(rollout.totals["load_transfer"].mean()),
        "roll": _round(np.degrees(rollout.totals["roll"]).max()),
        "tyre_load": _round(np.sqrt(rollout.totals["tyre_load"] / rollout.duration).mean()),
        "groups": {
            group: {"score": _round(score[m].mean()), "violations": float(violated[m].mean())}
            for group, m in groups.items()
            if any(m)
        },
        "scores": [_round(x) for x in score],
    }
    if base is not None:
        more = score - base.score
        row["more_than_reference"] = _interval(more)
        row["wins"], row["losses"] = int((more > TIE).sum()), int((more < -TIE).sum())
        row["ties"] = len(more) - row["wins"] - row["losses"]
        row["worst_loss"] = _round(more.min())
    return row


def _interval(x: np.ndarray) -> dict[str, float]:
    """Return the mean of `x` (2 N,), and its 95 % interval over pairs of mirrored drives."""
    pairs = x.reshape(-1, 2).mean(axis=1)
    rng = np.random.default_rng(0)
    means = pairs[rng.integers(0, pairs.size, (BOOTSTRAPS, pairs.size))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return {"mean": _round(pairs.mean()), "low": _round(low), "high": _round(high)}


def _round(x: float) -> float:
    """Return `x` with five digits."""
    return float(f"{x:.5g}")
