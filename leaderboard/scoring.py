"""Scores of one estimate by the true profile, which need neither a task nor a judge."""

import math
from dataclasses import dataclass
from typing import Any

from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.registry import PRINTED_SCORES, SCORES, compute_scores
from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.records.record import Estimate, Profile


@dataclass(frozen=True)
class ScoreTable:
    """Scores of one estimate by key (`leaderboard.metrics.registry.SCORES`); NaN if undefined."""

    values: dict[str, float]

    def __getitem__(self, key: str) -> float:
        """Return the score of a key as computed, not scaled for printing."""
        return self.values[key]

    def rows(self) -> list[tuple[str, str, str]]:
        """Return key, text with unit and label of each of PRINTED_SCORES that is defined."""
        defined = [key for key in PRINTED_SCORES if math.isfinite(self.values.get(key, math.nan))]
        return [(key, SCORES[key].text(self.values[key]), SCORES[key].label) for key in defined]

    def __str__(self) -> str:
        """Return the main scores as text, one on each line; `to_pandas` has them all."""
        return "\n".join(f"{label:<42}{text:>12}   {key}" for key, text, label in self.rows())

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame with columns label, value and unit, indexed by key.

        Values are in the printed unit. Raises MissingExtraError without pandas.
        """
        with optional_import("a DataFrame"):
            import pandas

        table = {
            key: (SCORES[key].label, SCORES[key].factor * value, SCORES[key].unit)
            for key, value in self.values.items()
        }
        return pandas.DataFrame.from_dict(table, orient="index", columns=["label", "value", "unit"])


def score(estimate: Estimate, truth: Profile, *, speed_kmh: float | None = None) -> ScoreTable:
    """Score an estimate of both wheel paths against the true ones.

    The scored band depends on the speed of the drive, which an estimate of
    `estimators.estimate` carries; give `speed_kmh` for any other. An estimate whose stations are
    uncertain (`s_std`) is also scored after local alignment. Raises ConfigError, TypeError.
    """
    check_stations(estimate, truth)
    speed, wandering = band_speed(estimate, speed_kmh), estimate.s_std is not None
    scored = ScoredEstimate(truth, estimate, speed, bumps=True, wandering=wandering)
    return ScoreTable(compute_scores(scored))


def band_speed(estimate: Estimate, speed_kmh: float | None) -> float:
    """Return the speed [m/s] that decides the scored band. Raises ConfigError."""
    if speed_kmh is not None:
        return speed_kmh / 3.6
    if estimate.speed is None:
        raise ConfigError("this estimate has no speed: give the speed of its drive as speed_kmh")
    return estimate.speed


def check_stations(estimate: Estimate, truth: Profile) -> None:
    """Raise ConfigError or TypeError if an estimate is not at the stations of the truth."""
    if not isinstance(estimate, Estimate) or not isinstance(truth, Profile):
        raise TypeError(
            "an Estimate comes first, then the true Profile; given: "
            f"{type(estimate).__name__}, {type(truth).__name__}"
        )
    if estimate.s.shape != truth.s.shape or abs(estimate.s - truth.s).max() > 1e-6:
        raise ConfigError(
            f"the estimate has {estimate.s.size} stations up to {estimate.s[-1]:.2f} m, the truth "
            f"{truth.s.size} up to {truth.s[-1]:.2f} m: both must be on the same ones"
        )
