"""Condition categories of a road by its IRI, from `configs/conditions`."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from road_envs.core.config import ConfigError, Positive, Settings, load


@dataclass(frozen=True, kw_only=True)
class Conditions(Settings):
    """Categories, the best first, and the limits between them."""

    name: str
    title: str
    categories: Annotated[tuple[str, ...], "", "from the best to the worst"]
    limits: Annotated[tuple[Positive, ...], "mm/m", "IRI at which the next category begins"]
    source: str

    def __post_init__(self):
        super().__post_init__()
        if len(self.limits) != len(self.categories) - 1:
            count, given = len(self.categories), len(self.limits)
            raise ConfigError(f"{count} categories need {count - 1} limits, got {given}")
        if (np.diff(self.limits) <= 0.0).any():
            raise ConfigError(f"the limits must increase, got {list(self.limits)}")

    def level(self, iri: float) -> int:
        """Return the index of the category of an IRI [mm/m]."""
        return int(np.searchsorted(self.limits, iri, side="right"))

    def category(self, iri: float) -> str:
        """Return the category of an IRI [mm/m]."""
        return self.categories[self.level(iri)]


def load_conditions(name: str) -> Conditions:
    """Load categories by shipped name or YAML path. Raises ConfigError."""
    return load(Conditions, "conditions", name)
