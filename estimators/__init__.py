"""Estimators of the road profile: registry (`registry.py`), interface (`api.py`), implementations.

An estimator imports neither another estimator nor the simulator.
"""

from estimators.estimation import estimate, make_estimator
from estimators.registry import (
    ENTRY_POINT_GROUP,
    REGISTRY,
    PluginWarning,
    available,
    create,
    find,
    names,
    without_weights,
)

__all__ = [
    "ENTRY_POINT_GROUP",
    "REGISTRY",
    "PluginWarning",
    "available",
    "create",
    "estimate",
    "find",
    "make_estimator",
    "names",
    "without_weights",
]
