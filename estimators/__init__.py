"""Estimators by name: one file each; none knows another, none knows the simulator.

The names and the way to add one stand in `registry.py`, what an estimator is in `api.py`.
"""

from estimators.registry import (
    ENTRY_POINT_GROUP,
    REGISTRY,
    EstimatorPluginWarning,
    available,
    create,
    find,
    names,
    without_weights,
)

__all__ = [
    "ENTRY_POINT_GROUP",
    "REGISTRY",
    "EstimatorPluginWarning",
    "available",
    "create",
    "find",
    "names",
    "without_weights",
]
