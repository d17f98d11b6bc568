"""What settings of a road are checked for, each in one sentence that names the culprit."""

from collections.abc import Sequence

import numpy as np

from road_envs.config import ConfigError

MAX_SAMPLES = 50_000_000


def check_positive(road, *names: str) -> None:
    """ValueError naming the first of the settings that is not positive and finite."""
    for name in names:
        if not 0.0 < getattr(road, name) < np.inf:
            raise ValueError(f"{name} must be positive, got {getattr(road, name)}")


def check_not_negative(road, *names: str) -> None:
    """ValueError naming the first of the settings that is negative or not finite."""
    for name in names:
        if not 0.0 <= getattr(road, name) < np.inf:
            raise ValueError(f"{name} must not be negative, got {getattr(road, name)}")


def check_range(road, name: str) -> None:
    """ValueError if a setting is not a positive least and a greatest value."""
    low, high = getattr(road, name)
    if not 0.0 < low <= high < np.inf:
        raise ValueError(f"{name} must be a positive least and greatest, got {low} and {high}")


def check_size(length: float, ds: float) -> None:
    """ConfigError if `length` [m] holds more steps of `ds` [m] than a computer should be asked."""
    if not length / ds < MAX_SAMPLES:
        raise ConfigError(
            f"{length:g} m in steps of {ds:g} m are more than {MAX_SAMPLES:,} samples"
        )


def check_not_empty(roads: Sequence) -> None:
    """ValueError if there are no roads."""
    if not roads:
        raise ValueError("roads must name at least one road")
