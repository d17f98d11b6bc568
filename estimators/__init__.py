"""Estimators of the road profile: registry (`registry.py`), interface (`api.py`), implementations.

An estimator imports neither another estimator nor the simulator.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimators.api import ENTRY_POINT_GROUP
    from estimators.estimation import estimate
    from estimators.lookup import make_estimator
    from estimators.passes import estimate_passes
    from estimators.registry import REGISTRY, available, create, find, names, without_weights
    from road_envs.core.registry import PluginWarning

_MODULES = {"estimate": "estimation", "estimate_passes": "passes", "make_estimator": "lookup"}
"""Modules of the public names that are not in `registry`, which has the others."""

__all__ = [
    "ENTRY_POINT_GROUP",
    "REGISTRY",
    "PluginWarning",
    "available",
    "create",
    "estimate",
    "estimate_passes",
    "find",
    "make_estimator",
    "names",
    "without_weights",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: the interface needs no implementation."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"estimators.{_MODULES.get(name, 'registry')}"), name)
