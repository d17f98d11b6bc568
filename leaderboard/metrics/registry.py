"""All metrics by key, collected from the modules that declare them."""

from leaderboard.metrics import agreement, level, obstacles, pointwise, roughness
from leaderboard.metrics.api import Metric, ScoredEstimate

MODULES = (pointwise, level, roughness, agreement, obstacles)  # in the order of the table of scores


def _declared(module: object) -> list[Metric]:
    values = [v if isinstance(v, tuple) else (v,) for v in vars(module).values()]
    return [x for group in values for x in group if isinstance(x, Metric)]


SCORES = {metric.key: metric for module in MODULES for metric in _declared(module)}

PRINTED_SCORES = (  # of one estimate; there are three times as many
    "nrmse", "nrmse_left", "nrmse_right", "nrmse_at_lag", "nrmse_aligned", "lag", "r", "coherence",
    "level_error", "level_error_raw", "G_d0_bias_db", "class_exact", "fitted_class",
    "dsd_distance_db", "iri_error", "iri_bias", "iri_cross_correlation", "bump_recall",
    "bump_precision", "coverage_50", "coverage_90", "coverage_90_aligned",
)  # fmt: skip


def compute_scores(scored: ScoredEstimate) -> dict[str, float]:
    """Return all SCORES of an estimate; NaN where one is not defined.

    Obstacle scores are defined if obstacles are scored and the truth has some, uncertainty scores
    if the estimate has a standard deviation, errors relative to the truth unless it is flat, errors
    after local alignment if the positions wander.
    """
    return {key: float(x.compute(scored)) for key, x in SCORES.items() if x.compute is not None}
