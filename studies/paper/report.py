"""Report of the study: a self-contained HTML page, and all numbers as JSON."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.evaluation.bound import nrmse_bound
from leaderboard.evaluation.provenance import describe_environment, package_version
from leaderboard.metrics import UNDEFINED
from leaderboard.metrics.level import EQ_12_RAW
from leaderboard.report.plots import inline_svg
from leaderboard.report.rendering import render
from road_envs.core.atomic_io import write_text
from studies.paper.claims import claims, key_findings
from studies.paper.figures import paper_figures
from studies.paper.study import PaperScenario, Study

TITLE = "Reproduction of the paper"
ABOUT = (
    "Ngwangwa, Heyns, Breytenbach and Els trained a static network, 3-50-2, on simulated drives "
    "over altered copies of the test road. This report compares its eight case scenarios, with "
    "{trainings} trainings of each, with the values of the paper. The measured drives are not "
    "published. They are replaced by drives of the field car {grade}, which differs from the car "
    "of the training and has sensor faults, and repeated with the car of the training (S0)."
)


@dataclass(frozen=True)
class ReportTable:
    """A table of texts: a head for each column, and rows that begin with their label."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


def write_report(study: Study, out: Path, command: str) -> list[Path]:
    """Write index.html and numbers.json into `out`, each atomically; return them."""
    write_text(out / "index.html", render_html(study, command))
    write_text(out / "numbers.json", json.dumps(numbers(study, command), indent=1) + "\n")
    return [out / name for name in ("index.html", "numbers.json")]


def tables(study: Study) -> list[ReportTable]:
    """Return the tables of the report: paving, bumps, modes and cars, cost."""
    return [_paving(study), _bumps(study), _modes(study), _cost(study)]


def numbers(study: Study, command: str) -> dict[str, Any]:
    """Return every score of every training, with the provenance, as plain data."""
    return {
        "command": command,
        "package_version": package_version(),
        "environment": describe_environment(),
        "seconds": round(study.seconds, 1),
        "new_road": study.new_road,
        "cases": [
            {
                "task": scenario.task.name,
                "digest": scenario.task.digest,
                "condition": scenario.condition,
                "claimed": scenario.task.claimed_level_error,
                "states": scenario.state_shares(),
                "drive_seconds": round(scenario.drive_seconds, 3),
                "trainings": [
                    {
                        "seed": training.seed,
                        "train_seconds": round(training.train_seconds, 3),
                        "estimate_seconds": round(training.estimate_seconds, 4),
                        **_rounded(training.scores),
                        "nominal": _rounded(training.nominal),
                    }
                    for training in scenario.trainings
                ],
                "baselines": {n: [_rounded(x) for x in xs] for n, xs in scenario.baselines.items()},
            }
            for scenario in study.scenarios
        ],
    }


def render_html(study: Study, command: str) -> str:
    """Render the report as a page."""
    return render(
        "paper.html",
        title=TITLE,
        about=_about(study),
        findings=key_findings(study),
        tables=tables(study),
        claims=claims(study),
        figures=[
            (figure.name, figure.caption, inline_svg(figure.paint, figure.size))
            for figure in paper_figures(study)
        ],
        provenance=_provenance(study, command),
    )


def _about(study: Study) -> str:
    scenario = study.scenarios[0]
    return ABOUT.format(trainings=len(scenario.trainings), grade=scenario.task.conditions[0].grade)


def _paving(study: Study) -> ReportTable:
    heads = (
        "Paving", "paper", "eq.\u00a012", "least-most", "about mean", "states", "NRMSE", "r",
        "constant", "unrelated", "its NRMSE", "new road",
    )  # fmt: skip
    rows = [
        [
            f"{scenario.number}: {scenario.drive_label}",
            _percent(scenario.task.claimed_level_error),
            _percent(scenario.iq_mean(EQ_12_RAW)),
            "-".join(
                f"{100 * end(scenario.score_values(EQ_12_RAW)):.1f}" for end in (np.min, np.max)
            ),
            _percent(scenario.iq_mean("level_error")),
            _shares(scenario),
            *_means(scenario, "nrmse", "r"),
            _percent(scenario.baseline_median("constant", EQ_12_RAW)),
            _percent(scenario.baseline_median("unrelated_road", EQ_12_RAW)),
            f"{scenario.baseline_median('unrelated_road', 'nrmse'):.2f}",
            f"{study.new_road_score(scenario, 'nrmse'):.2f}",
        ]
        for scenario in study.paving
    ]
    note = (
        "eq. 12 [%] of both wheel paths: of raw heights as printed, interquartile mean and range "
        "of the trainings, and of heights about their means; states: percent of the trainings that "
        "are near-optimal (below 15 %), sub-optimal (15 to 25 %) and unstable; in-band NRMSE (a "
        "flat road has 1) and correlation r; eq. 12 of a constant height and of an unrelated road "
        "of the same roughness, and the latter's NRMSE; NRMSE of the network on unseen roads."
    )
    return ReportTable("Belgian paving, scenarios 5 to 8", heads, rows, note)


def _bumps(study: Study) -> ReportTable:
    heads = (
        "Bumps", "eq.\u00a012", "states", "NRMSE left", "right", "r", "recall", "precision",
        "height error", "location error", "unrelated", "new road",
    )  # fmt: skip
    rows = [
        [
            f"{scenario.number}: {scenario.drive_label}",
            _percent(scenario.iq_mean(EQ_12_RAW)),
            _shares(scenario),
            *_means(scenario, "nrmse_left", "nrmse_right", "r"),
            *(
                _percent(scenario.iq_mean(f"bump_{score}"), 0)
                for score in ("recall", "precision", "height_error_relative")
            ),
            f"{100 * scenario.iq_mean('bump_location_error'):.0f} cm",
            f"{scenario.baseline_median('unrelated_road', 'nrmse'):.2f}",
            f"{study.new_road_score(scenario, 'nrmse'):.2f}",
        ]
        for scenario in study.bumps
    ]
    note = (
        "eq. 12 as printed [%]; percent of the trainings that are near-optimal, sub-optimal and "
        "unstable; in-band NRMSE left and right; recall and precision of the bumps within "
        "0.3 m [%]; errors of height and location of the detected bumps; "
        "NRMSE of an unrelated road and of the network on new roads."
    )
    return ReportTable("Bumps, scenarios 1 to 4", heads, rows, note)


def _modes(study: Study) -> ReportTable:
    """Ride against handling, left against right, the field car against that of the training."""
    heads = (
        "Scenario", "eq.\u00a012", "NRMSE", "left", "right", "eq.\u00a012, S0", "NRMSE, S0",
        "left", "right", "bound, S0",
    )  # fmt: skip
    scores = ("nrmse", "nrmse_left", "nrmse_right")
    order = [
        *study.bumps,
        *sorted(study.paving, key=lambda scenario: (scenario.speed, scenario.number)),
    ]
    rows = [
        [
            f"{scenario.number}: {scenario.drive_label}",
            _percent(scenario.iq_mean(EQ_12_RAW)),
            *_means(scenario, *scores),
            _percent(scenario.iq_mean(EQ_12_RAW, nominal=True)),
            *_means(scenario, *scores, nominal=True),
            f"{nrmse_bound(scenario.task, scenario.task.conditions[0], scenario.truth):.3f}",
        ]
        for scenario in order
    ]
    note = (
        "eq. 12 as printed [%] and in-band NRMSE of both wheel paths and of each, on the field car "
        "and, S0, on the car of the training; bound: least NRMSE of a linear estimator that knows "
        "the car and has its three accelerometers. Scenarios 3 and 4, 5 and 6, 7 and 8 differ only "
        "in the mode."
    )
    return ReportTable("Modes, wheel paths and cars", heads, rows, note)


def _cost(study: Study) -> ReportTable:
    def mean(seconds: list[float]) -> float:
        return float(np.mean(seconds))

    rows = [
        [
            f"{scenario.number}: {scenario.drive_label}",
            f"{mean([t.train_seconds for t in scenario.trainings]):.2f} s",
            f"{1e3 * mean([t.estimate_seconds for t in scenario.trainings]):.0f} ms",
            f"{scenario.drive_seconds:.2f} s",
        ]
        for scenario in study.scenarios
    ]
    rows.append(["the paper (Core i7, 2.2 GHz)", "63 s", "2 s", UNDEFINED])
    heads = ("Scenario", "one training", "one estimate", "all drives")
    return ReportTable("Computing time of the network", heads, rows)


def _provenance(study: Study, command: str) -> list[tuple[str, str]]:
    versions = {"road-envs": package_version(), **describe_environment()}
    tasks = [scenario.task for scenario in study.scenarios]
    return [
        ("Command", command),
        ("Duration", f"{study.seconds:.0f} s"),
        ("Versions", ", ".join(f"{name} {version}" for name, version in versions.items())),
        ("Tasks", ", ".join(f"{task.name} {task.digest[:12]}" for task in tasks)),
        ("Numbers", "numbers.json beside this file has every score of every training"),
    ]


def _means(scenario: PaperScenario, *scores: str, nominal: bool = False) -> list[str]:
    return [f"{scenario.iq_mean(score, nominal):.2f}" for score in scores]


def _shares(scenario: PaperScenario) -> str:
    return "/".join(f"{100 * share:.0f}" for share in scenario.state_shares().values())


def _percent(share: float | None, digits: int = 1) -> str:
    return UNDEFINED if share is None or not np.isfinite(share) else f"{100 * share:.{digits}f}"


def _rounded(scores: dict[str, float]) -> dict[str, float | None]:
    return {k: float(f"{x:.5g}") if np.isfinite(x) else None for k, x in scores.items()}
