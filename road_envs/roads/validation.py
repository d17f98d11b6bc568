"""Checks of the settings of roads; each error message is one sentence that names the setting."""

from collections.abc import Sequence

import numpy as np

from road_envs.config import ConfigError

MAX_SAMPLES = 50_000_000
"""Largest number of samples per wheel path: 400 MB."""


def check_positive(road, *names: str) -> None:
    """Raise ValueError for the first setting that is not positive and finite."""
    for name in names:
        if not 0.0 < getattr(road, name) < np.inf:
            raise ValueError(f"{name} must be positive and finite, got {getattr(road, name)}")


def check_not_negative(road, *names: str) -> None:
    """Raise ValueError for the first setting that is negative or not finite."""
    for name in names:
        if not 0.0 <= getattr(road, name) < np.inf:
            raise ValueError(
                f"{name} must not be negative and must be finite, got {getattr(road, name)}"
            )


def check_range(road, name: str) -> None:
    """Raise ValueError unless a setting is a pair 0 < smallest <= largest."""
    low, high = getattr(road, name)
    if not 0.0 < low <= high < np.inf:
        raise ValueError(
            f"{name} must be a positive smallest and largest value, got {low} and {high}"
        )


def check_size(length: float, ds: float) -> None:
    """Raise ConfigError if `length` [m] has more than MAX_SAMPLES steps of `ds` [m]."""
    if not length / ds < MAX_SAMPLES:
        raise ConfigError(
            f"a length of {length:g} m in steps of {ds:g} m has more than {MAX_SAMPLES:,} samples; "
            "choose a shorter road or a larger step"
        )


def check_not_empty(roads: Sequence) -> None:
    """Raise ValueError if there are no roads."""
    if not roads:
        raise ValueError("roads must contain at least one road")
