"""Comparison of policies on the drives of `RoadRecon/Safe4S4-v1`.

Each public drive is driven to both sides. All policies drive the same roads, cars and faults, and
the best switching found on the known road stands beside them as a line. Intervals are 95 %
bootstraps over the drives, a drive and its mirror image together, as of roads in
`leaderboard.metrics.bootstrap`: from MIN_ROADS pairs on.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from leaderboard.entries.entry import describe_error
from leaderboard.metrics import UNDEFINED
from leaderboard.metrics.bootstrap import MIN_ROADS, resample
from leaderboard.policies import best_found
from leaderboard.policies.best_found import Progress
from leaderboard.policies.policy_process import PolicyProcess
from leaderboard.report.figures import rounded
from road_envs.core.config import ConfigError, validate_choice
from road_envs.envs.safe4s4 import Safe4S4Setup
from road_envs.envs.safe_drives import SafeDrive
from road_envs.policies.api import Policy
from road_envs.policies.rollout import Drives, Rollout, drive_all

BEST_FOUND = "best found"  # name of the row of `best_found.search`
REFERENCE = "rrms"  # policy that differences refer to by default
PUBLIC_DRIVES = 8  # number of public drives; each is driven to both sides
_SHORTEST_SEAL = 16  # characters: a policy can draw the drives of a thousand texts in a second
_round = partial(rounded, digits=5)  # more is noise, and people read the file
TIE = 0.01  # difference of scores [m²/s⁴] within which two policies are even on a drive

GROUPS: Mapping[str, tuple[str, str]] = {  # of drives: a field of `SafeDrive`, and its value
    "known": ("group", "known"),
    "unseen": ("group", "unseen"),
    "left": ("side", "left"),
    "right": ("side", "right"),
    **{grade: ("grade", grade) for grade in ("S0", "S1", "S2", "S3")},
    **{kind.replace("_", " "): ("severe", kind) for kind in ("lane_change", "j_turn", "fishhook")},
}


def members(drives: Drives, group: str) -> np.ndarray:
    """Return which drives (N,) belong to one of GROUPS."""
    field, value = GROUPS[group]
    return np.array([getattr(start.description, field) == value for start in drives.starts])


@dataclass(frozen=True)
class Comparison:
    """The table as plain `data`, the drives, and what each row of the table commanded on them."""

    data: dict[str, Any]
    drives: Drives
    rollouts: Mapping[str, Rollout]


def public_drives(number: int = PUBLIC_DRIVES, seal: str | None = None) -> Drives:
    """Return the public drives, or those sealed by `seal`: both groups, each to both sides.

    Raises ConfigError for a short `seal`.
    """
    if seal is not None and len(seal) < _SHORTEST_SEAL:
        raise ConfigError(
            f"the seal must have at least {_SHORTEST_SEAL} characters, got {len(seal)}: a policy "
            "could guess it and draw the drives"
        )
    setup = Safe4S4Setup({"split": "test" if seal is None else "sealed", "seal": seal})
    groups = [{"group": ("known", "unseen")[k % 2]} for k in range(number)]
    return Drives.mirrored(setup, range(number), groups)


def compare(
    policies: Mapping[str, Policy],
    drives: Drives,
    reference: str = REFERENCE,
    *,
    sweeps: int = best_found.SWEEPS,
    progress: Progress = lambda text, share: None,
) -> Comparison:
    """Compare all policies and the best switching found.

    A policy that raises an error is a row with its failure. Without `sweeps` nothing is searched.
    Raises ConfigError if the reference is not among the policies.
    """
    validate_choice("reference", reference, list(policies))
    rollouts, failures = dict[str, Rollout](), list[dict[str, str]]()
    searches: list[list[float]] = []
    for k, (name, policy) in enumerate(policies.items()):
        progress(name, 0.3 * k / len(policies))
        try:
            rollouts[name] = drive_all(policy, drives)
        except Exception as error:  # a failing policy must not stop the comparison
            failures.append({"policy": name, "failure": describe_error(error)})
        finally:
            if isinstance(policy, PolicyProcess):
                policy.close()  # nothing of it may run beside the next one
    if sweeps and rollouts:
        rows = [rollout.actions for rollout in rollouts.values()]
        rollouts[BEST_FOUND], searched = best_found.search(
            drives, rows, seeds=(1, 2), sweeps=sweeps,
            progress=lambda text, share: progress(f"best found: {text}", 0.3 + 0.7 * share),
        )  # fmt: skip
        searches = [[_round(x) for x in scores] for scores in searched]
    base = rollouts.get(reference)
    driven = [_row(name, r, base, drives) for name, r in rollouts.items()]
    driven.sort(key=lambda row: -row["score"]["mean"])
    progress("done", 1.0)
    setup: Any = drives.setup
    data = {
        "benchmark": setup.benchmark.name,
        "split": setup.safe.split,
        "drives": [_label(start.description) for start in drives.starts],
        "reference": reference,
        "rows": driven + failures,
        "searches": searches,
    }
    return Comparison(data, drives, rollouts)


def _label(drive: SafeDrive) -> str:
    """Return a description such as "j turn to the left, class C then D, 47 km/h, S1, known"."""
    return (
        f"{drive.severe.replace('_', ' ')} to the {drive.side}, class {drive.road} then "
        f"{drive.road_after}, {drive.speed_kmh:.0f} km/h, {drive.grade}, {drive.group}"
    )


def _row(name: str, rollout: Rollout, base: Rollout | None, drives: Drives) -> dict[str, Any]:
    groups = {group: members(drives, group) for group in GROUPS}
    score, violated, totals = rollout.score, rollout.violated, rollout.totals
    driven = np.arange(1, len(rollout.actions))[:, None] < rollout.intervals
    switched = driven & (np.diff(rollout.actions, axis=0) != 0)
    row: dict[str, Any] = {
        "policy": name,
        "failure": None,
        "score": interval(score, groups["known"]),
        "comfort": interval(rollout.comfort, groups["known"]),
        "violations": float(violated.mean()),
        "worst": _round(score.min()),
        **{x: _round(totals[x].mean()) for x in ("cost", "stop", "lift_off", "load_transfer")},
        "roll": _round(np.degrees(totals["roll"]).max()),
        "tyre_load": _round(np.sqrt(totals["tyre_load"] / rollout.duration).mean()),
        "switches": _round((switched.sum(axis=0) / rollout.duration).mean()),
        "groups": {
            group: {"score": _round(score[m].mean()), "violations": float(violated[m].mean())}
            for group, m in groups.items()
            if m.any()
        },
        "scores": [_round(x) for x in score],
    }
    if base is not None:
        more = score - base.score
        row["more_than_reference"] = interval(more, groups["known"])
        row["wins"], row["losses"] = int((more > TIE).sum()), int((more < -TIE).sum())
        row["ties"] = len(more) - row["wins"] - row["losses"]
        row["worst_loss"] = _round(more.min())
    return row


def interval(
    x: np.ndarray, families: np.ndarray | None = None, mirrored: bool = True
) -> dict[str, float]:
    """Return the mean of `x` (N,) or (S, N), and its 95 % interval over S seeds and N drives.

    Drives are drawn in pairs if they are `mirrored`, and within each of their `families` (N,). Of
    fewer than MIN_ROADS drives or pairs the interval is NaN.
    """
    pairs = np.atleast_2d(x)
    pairs = pairs.reshape(len(pairs), -1, 1 + mirrored).mean(axis=2).T[:, None, :]
    of_pairs = np.zeros(len(pairs)) if families is None else families[:: 1 + mirrored]
    strata = [np.flatnonzero(of_pairs == k).tolist() for k in set(of_pairs)]
    mean, low, high = resample([pairs], strata=strata, mean=np.average).interval()
    if len(pairs) < MIN_ROADS:
        low = high = np.nan
    return {"mean": _round(mean), "low": _round(low), "high": _round(high)}


def interval_text(found: Mapping[str, float]) -> str:
    """Return the text of the interval of a mean, a dash if it has none."""
    if not np.isfinite(found["low"]):
        return UNDEFINED
    return f"{found['low']:.3f} to {found['high']:6.3f}"


def table_lines(data: Mapping[str, Any]) -> list[str]:
    """Return the lines of the table, best score first."""
    lines = [
        f"{data['benchmark']}, {data['split']}: {len(data['drives'])} drives, half of them "
        "mirrored",
        f"{'policy':20s} score   95 %             comfort viol.  left right unseen    S3  worst  "
        f"load tr. roll  +/=/- {data['reference']}",
    ]
    shown = ("left", "right", "unseen", "S3")
    for row in data["rows"]:
        if row["failure"]:
            lines.append(f"{row['policy']} failed: {row['failure']}")
            continue
        g, s = row["groups"], row["score"]
        parts = [f"{g[x]['score']:6.2f}" if x in g else "   n/a" for x in shown]
        lines.append(
            f"{row['policy']:20s} {s['mean']:6.3f} {interval_text(s):>17s} "
            f"{row['comfort']['mean']:6.3f} {row['violations']:5.0%} {' '.join(parts)} "
            f"{row['worst']:6.2f} {row['load_transfer']:5.2f} {row['roll']:6.1f}  "
            + (f"{row['wins']}/{row['ties']}/{row['losses']}" if "wins" in row else "")
        )
    lines.append(
        "score [m²/s⁴]: minus mean-square comfort and the price of violations; higher is better."
    )
    if data["searches"]:
        scores = np.array(data["searches"])
        means, spread = scores.mean(axis=1), np.ptp(scores, axis=0) / -scores.max(axis=0)
        lines.append(
            f"{BEST_FOUND}: the best of {len(scores)} searches on the known road, not attainable; "
            f"their scores differ by {np.ptp(means) / -means.max():.1%}, at most by "
            f"{spread.max():.1%} on a drive."
        )
    return lines
