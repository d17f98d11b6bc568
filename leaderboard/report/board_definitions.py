"""Columns of the boards: every metric, and what a board derives from the scores and the runs."""

from dataclasses import dataclass

from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.metrics.api import PERCENT, Metric
from leaderboard.metrics.registry import SCORES
from road_envs.core.config import validate_choice
from road_envs.sensing.perturbed_vehicle import GRADES

WORST = "worst"
TAIL = {"above_0.3": 0.3, "above_1": 1.0}
"""Thresholds of the ranking score by column; the column shows the share of drives above it."""

BELOW_BOUND = "below_bound"
BOUND_NAME = "bound of a linear car without friction, from data below 25 Hz"
"""Name of the bound; estimators that use the nonlinear car and higher frequencies may be below."""

BOUND_ROW, ATTAINABLE_ROW = LIMIT_ROWS = ("bound", "attainable")
"""Names of the rows that are no estimator's: the information bound, the attainable error."""

RANK_COLUMNS = {"offline": "rank", "causal": "rank_causal"}  # column with the ranks of a division

TEXT_COLUMNS = ("interval", "states", "slope_interval", "calibrates")
"""Columns that are not a single number."""


@dataclass(frozen=True)
class Column(Metric):
    """A metric in a table, labelled by its head; `wide` ones are shown on request only."""

    wide: bool = False


_DERIVED = (
    Metric("rank", "rank", digits=0, blank="",
           help="In the order of the score, entries share the rank of the best of them unless it "
           "is significantly better (95 % interval of the paired difference below 0); the next "
           "group has its place as rank. None from fewer than five roads."),
    Metric("rank_causal", "rank among causal entries", head="among causal", digits=0, blank="",
           help="Rank among the entries that use no future of the record."),
    Metric("interval", "95 % interval", head="95 %",
           help="95 % interval of the interquartile mean, by a bootstrap over roads within their "
           "families, then over training seeds. None from fewer than five roads."),
    Metric(WORST, "worst drive", head="worst",
           help="Largest score of any drive. None from fewer than five roads."),
    *(
        Metric(key, f"drives above {limit:g}", head=f"> {limit:g}", **PERCENT,
               help=f"Share of drives whose ranking score is above {limit:g}.")
        for key, limit in TAIL.items()
    ),
    Metric(BELOW_BOUND, "drives below the bound", head="< bound", **PERCENT, better="",
           help=f"Share of drives with an error below the {BOUND_NAME}. It is no floor: an "
           "estimator that uses the nonlinear car and higher frequencies can be below, and so can "
           "any on roads with single obstacles."),
    Metric("train_seconds", "training time", head="train", unit="s", digits=1, blank="",
           help="Mean time of one training under one condition."),
    Metric("estimate_ms_per_100m", "time per 100 m", head="time", unit="ms/100m", digits=1,
           blank="", help="Time of an estimate for 100 m of road, on the machine of the run."),
    Metric("parameters", "fitted parameters", head="weights", digits=0, blank="",
           help="Number of fitted parameters."),
    Metric("states", "states of the trainings", head="trainings", unit="<15/15-25/>25 %",
           help="Number of trainings that were near-optimal, sub-optimal and unstable in the sense "
           "of the paper's Appendix A: eq. 12 as printed below 15, 15 to 25, above 25 %."),
    *(
        Metric(f"grade_{grade}", f"in-band NRMSE on car {grade}", head=grade, digits=3,
               help=f"In-band NRMSE on cars of grade {grade}.")
        for grade in GRADES
    ),
    Metric("slope", "growth of the NRMSE per grade", head="slope", unit="per grade", digits=3,
           better="zero", help="Least-squares slope of the NRMSE over the grades of car."),
    Metric("calibrates", "calibrated to the vehicle", head="calibrated", blank="",
           help="Whether the estimator uses the calibration drives that it is given before each "
           "test drive; the others ignore them."),
    Metric("calibrate_seconds", "calibration time", head="calibrate", unit="s", digits=1, blank="",
           help="Mean time of a calibration, of the slowest condition: drives that an estimator "
           "before it has identified the same vehicle from take none."),
    Metric("slope_interval", "95 % interval of the slope", head="95 %",
           help="95 % interval of the slope, by the same bootstrap as that of the mean."),
)  # fmt: skip

COLUMNS: dict[str, Metric] = {**SCORES, **{column.key: column for column in _DERIVED}}
"""Every column by key: the scores, and what is derived from them."""


def board_columns(name: str, definition: BoardDefinition) -> tuple[Column, ...]:
    """Return the columns of a board in their order. Raises ConfigError for an unknown one."""
    ranks = [RANK_COLUMNS[division] for division in definition.divisions]
    shown = [*ranks[:1], *definition.columns]
    for key in (definition.ranks_by, *definition.columns, *definition.on_request):
        validate_choice(f"column of the board {name}:", key, COLUMNS)
    declared = [metric.key for metric in SCORES.values() if name in metric.boards]
    keys = dict.fromkeys([*shown, *ranks, *definition.on_request, *declared])
    return tuple(
        Column(**vars(form) | {"label": form.head or form.label, "wide": form.key not in shown})
        for form in map(COLUMNS.__getitem__, keys)
    )
