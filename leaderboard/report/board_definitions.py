"""Columns of the boards: every metric, and what a board derives from the scores and the runs."""

from dataclasses import replace

from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.metrics.api import Metric
from leaderboard.metrics.registry import SCORES
from road_envs.core.config import folder, read_yaml, validate_choice

WORST = "worst"
TAIL = {"above_0.3": 0.3, "above_1": 1.0}  # columns of the share of drives above
BELOW_BOUND = "below_bound"
# estimators that use the nonlinear car and higher frequencies may be below
BOUND_NAME = "bound of a linear car without friction, from data below 25 Hz"
BOUND_ROW = "bound"
LIMIT_ROWS = (BOUND_ROW, "attainable")  # rows that are no estimator's
RANK_COLUMNS = {"offline": "rank", "causal": "rank_causal"}  # column with the ranks of a division
TEXT_COLUMNS = ("interval", "states", "slope_interval", "calibrates")  # no single numbers
_DERIVED = read_yaml(folder() / "report" / "derived_columns.yaml")
COLUMNS: dict[str, Metric] = SCORES | {key: Metric(key, **form) for key, form in _DERIVED.items()}


def column_forms(definition: BoardDefinition) -> dict[str, Metric]:
    """Return COLUMNS as a board shows them: values of its ranking score in its unit and digits."""
    score, forms = COLUMNS[definition.ranks_by], dict(COLUMNS)
    for key in (WORST, "slope", *(key for key in _DERIVED if key.startswith("grade_"))):
        unit = f"{score.unit} {forms[key].unit}".strip()
        digits = min(score.digits, forms[key].digits)
        forms[key] = replace(forms[key], unit=unit, factor=score.factor, digits=digits)
    return forms


def rank_column(definition: BoardDefinition) -> str:
    """Return the column of the ranks that order a board: of its first division, else of all."""
    return RANK_COLUMNS[next(iter(definition.divisions), "offline")]


def ranked_kind(definition: BoardDefinition) -> str:
    """Return what a board orders: each "entry", or each "causal entry"."""
    return "entry" if rank_column(definition) == RANK_COLUMNS["offline"] else "causal entry"


def board_columns(name: str, definition: BoardDefinition) -> tuple[Metric, ...]:
    """Return the columns of a board in their order, labelled by their heads. Raises ConfigError."""
    ranks = [RANK_COLUMNS[division] for division in definition.divisions]
    shown = [*ranks[:1], *definition.columns]
    for key in (*definition.columns, *definition.on_request):
        validate_choice(f"column of the board {name}:", key, COLUMNS)
    declared = [metric.key for metric in SCORES.values() if name in metric.boards]
    keys = dict.fromkeys([*shown, *ranks, *definition.on_request, *declared])
    return tuple(
        replace(form, label=form.head or form.label, wide=form.key not in shown)
        for form in map(column_forms(definition).__getitem__, keys)
    )
