"""Definition of every board: its title, the score that ranks entries, and its columns."""

from dataclasses import dataclass

from leaderboard.evaluation.tasks import BoardName
from leaderboard.metrics.registry import SCORES, Score
from road_envs.vehicle.perturbed_vehicle import GRADES


@dataclass(frozen=True)
class Column:
    """A column of a table; `wide` ones are shown on request only."""

    key: str
    label: str
    unit: str = ""
    wide: bool = False


@dataclass(frozen=True)
class BoardDefinition:
    """Title, ranking score and columns of a board."""

    title: str
    ranks_by: str
    columns: tuple[Column, ...]
    description: str
    scale: float = 2.0  # value of the ranking score at the right end of bars and profiles


WORST = "worst"
TAIL = {"above_0.3": 0.3, "above_1": 1.0}
"""Thresholds of the ranking score by column; the column shows the share of drives above it."""

TAIL_COLUMNS = (
    Column(WORST, "worst"),
    Column("above_0.3", "> 0.3", "%"),
    Column("above_1", "> 1", "%"),
)
RANK_COLUMNS = (Column("rank", "rank"), Column("rank_causal", "among causal", wide=True))
COST_COLUMNS = (
    Column("train_seconds", "train", "s", wide=True),
    Column("estimate_ms_per_100m", "time", "ms/100m"),
    Column("parameters", "weights", wide=True),
)
NEW_ROAD_COLUMNS = (
    *RANK_COLUMNS,
    Column("nrmse", "NRMSE"),
    Column("interval", "95 %"),
    *TAIL_COLUMNS,
    Column("bound_efficiency", "of bound", "%", wide=True),
    Column("r", "r"),
    Column("level_error", "level", "%", wide=True),
    Column("class_exact", "class", "%", wide=True),
    Column("class_within_one", "within one", "%", wide=True),
    Column("iri_error", "IRI", "mm/m", wide=True),
    Column("dsd_distance_db", "DSD", "dB", wide=True),
    Column("bump_f1", "bump F1", wide=True),
    Column("coverage_90", "in 90 %", "%", wide=True),
    *COST_COLUMNS,
)
FIELD_COLUMNS = (
    *RANK_COLUMNS,
    *(Column(f"grade_{grade}", grade) for grade in GRADES),
    Column("slope", "slope", "per grade"),
    Column("slope_interval", "95 %", wide=True),
    Column("nrmse", "NRMSE", wide=True),
    *TAIL_COLUMNS,
    Column("interval", "95 %", wide=True),
    Column("r", "r", wide=True),
    Column("class_exact", "class", "%", wide=True),
    Column("iri_error", "IRI", "mm/m", wide=True),
    Column("coverage_90", "in 90 %", "%", wide=True),
)
CLASS_COLUMNS = (
    *RANK_COLUMNS,
    Column("dsd_distance_db", "DSD", "dB"),
    Column("interval", "95 %"),
    Column("dsd_bias_db", "bias", "dB"),
    Column("class_exact", "class", "%"),
    Column("class_within_one", "within one", "%", wide=True),
    Column("fitted_class", "fitted", "%", wide=True),
    Column("G_d0_error_db", "Gd(n0)", "dB"),
    Column("class_exact_0.25", "at 0.25", "%", wide=True),
    Column("class_exact_0.5", "at 0.5", "%", wide=True),
    Column("class_exact_1", "at 1", "%", wide=True),
    Column("class_exact_2", "at 2", "%", wide=True),
    Column("iri_error_relative", "IRI", "%"),
    Column("nrmse", "NRMSE", wide=True),
)
PAPER_COLUMNS = (
    Column("level_error_raw", "eq. 12", "%"),
    Column("level_error", "about mean", "%"),
    Column("level_error_left", "left", "%", wide=True),
    Column("level_error_right", "right", "%", wide=True),
    Column("states", "trainings", "<15/15-25/>25 %", wide=True),
    Column("nrmse", "NRMSE"),
    Column("nrmse_left", "NRMSE left", wide=True),
    Column("nrmse_right", "NRMSE right", wide=True),
    Column("bound_efficiency", "of bound", "%", wide=True),
    Column("r", "r"),
    Column("bump_f1", "bump F1"),
    Column("bump_height_error", "height error", "mm", wide=True),
    Column("bump_location_error", "location error", "m", wide=True),
    Column("bump_ghosts", "wrong side", wide=True),
    Column("dsd_distance_db", "DSD", "dB", wide=True),
    Column("train_seconds", "train", "s", wide=True),
)
COLUMN_FORMATS: dict[str, Score] = {
    **SCORES,
    WORST: SCORES["nrmse"]._replace(label="worst drive", digits=2),
    "above_0.3": Score("drives above 0.3", "%", 100.0, 0, "low"),
    "above_1": Score("drives above 1", "%", 100.0, 0, "low"),
    **{f"grade_{grade}": SCORES["nrmse"] for grade in GRADES},
    "slope": Score("growth of the NRMSE per grade", "", 1.0, 3, "zero"),
}
"""Formats of the columns that are scores or derived from scores."""

BOARDS: dict[BoardName, BoardDefinition] = {
    "new_road": BoardDefinition(
        "New road",
        "nrmse",
        NEW_ROAD_COLUMNS,
        "The main board: roads that the estimator was not trained on, on the car of its training.",
    ),
    "field": BoardDefinition(
        "Field car",
        "nrmse",
        FIELD_COLUMNS,
        "Cars that differ from the car of the training, increasingly from S1 to S3: NRMSE on "
        "each, and its slope over the grades.",
    ),
    "class": BoardDefinition(
        "Roughness class",
        "dsd_distance_db",
        CLASS_COLUMNS,
        "Roughness of the road instead of its heights: ranked by the distance of the densities.",
        scale=20.0,
    ),
    "measured": BoardDefinition(
        "Measured surfaces",
        "nrmse",
        NEW_ROAD_COLUMNS,
        "Measured road surfaces, with the paper's protocol and as new roads.",
    ),
    "paper": BoardDefinition(
        "The paper's protocol",
        "nrmse",
        PAPER_COLUMNS,
        "The eight case scenarios of Ngwangwa et al.: training on altered copies of the test road.",
    ),
}
