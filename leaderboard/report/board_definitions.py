"""The kinds of board: what each asks, the score that ranks on it, and the columns it shows."""

from dataclasses import dataclass

from leaderboard.evaluation.tasks import BoardName
from leaderboard.metrics.registry import SCORES, Score
from road_envs.vehicle.perturbed_vehicle import GRADES


@dataclass(frozen=True)
class Column:
    """One column; a `wide` one is left out where room is short."""

    key: str
    label: str
    unit: str = ""
    wide: bool = False


@dataclass(frozen=True)
class BoardDefinition:
    """A kind of board: its title, the score that ranks, and its columns."""

    title: str
    ranks_by: str
    columns: tuple[Column, ...]
    description: str
    scale: float = 2.0  # of the ranking score, at the right end of bars and profiles


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
    Column("bound_efficiency", "of bound", "%", wide=True),
    Column("r", "r"),
    Column("level_error", "level", "%"),
    Column("class_exact", "class", "%"),
    Column("class_within_one", "within one", "%", wide=True),
    Column("iri_error", "IRI", "mm/m"),
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
    Column("nrmse", "NRMSE"),
    Column("interval", "95 %", wide=True),
    Column("r", "r"),
    Column("class_exact", "class", "%"),
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
    Column("bump_location_error", "place", "m", wide=True),
    Column("bump_ghosts", "ghosts", wide=True),
    Column("dsd_distance_db", "DSD", "dB", wide=True),
    Column("train_seconds", "train", "s", wide=True),
)
COLUMN_FORMATS: dict[str, Score] = {
    **SCORES,
    **{f"grade_{grade}": SCORES["nrmse"] for grade in GRADES},
    "slope": Score("growth of the NRMSE per grade", "", 1.0, 3, "zero"),
}
"""How numbers are printed that are scores, or made of scores."""

BOARDS: dict[BoardName, BoardDefinition] = {
    "new_road": BoardDefinition(
        "New road",
        "nrmse",
        NEW_ROAD_COLUMNS,
        "The main board: roads that no estimator has seen, on the car that it was trained on.",
    ),
    "field": BoardDefinition(
        "Field car",
        "nrmse",
        FIELD_COLUMNS,
        "On cars that differ from the one that it was trained on, more from S1 to S3: NRMSE on "
        "each, and how fast it grows.",
    ),
    "class": BoardDefinition(
        "Roughness class",
        "dsd_distance_db",
        CLASS_COLUMNS,
        "How rough is the road, whatever its heights: ranked by the distance of the densities.",
        scale=20.0,
    ),
    "measured": BoardDefinition(
        "Measured surfaces",
        "nrmse",
        NEW_ROAD_COLUMNS,
        "Surfaces from files, after the paper's protocol and as new roads.",
    ),
    "paper": BoardDefinition(
        "The paper's protocol",
        "nrmse",
        PAPER_COLUMNS,
        "The eight case scenarios of Ngwangwa et al., trained on altered copies of the test road.",
    ),
}
