"""Policies that switch the suspension: observations in, actions out.

To add a policy to this package, write a file beside this one and add a line to REGISTRY; tuned
settings go into configs/policies/<name>.yaml. One of another package is declared there as an entry
point, and available as `my_policy`:

    [project.entry-points."road_envs.policies"]
    my_policy = "my_package.my_module:MyPolicy"
"""

import dataclasses
import importlib
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

from road_envs.core import config
from road_envs.core.config import ConfigError, Settings, build
from road_envs.core.registry import PluginWarning, Registry
from road_envs.policies.api import Policy, PolicyContext, PolicyError
from road_envs.policies.fixed import FixedPair, RandomSwitching
from road_envs.policies.greedy_information import GreedyInformation
from road_envs.policies.mpc import ModelPredictive
from road_envs.policies.network_policy import FILE_SUFFIXES, NetworkPolicy
from road_envs.policies.turns import LateralThreshold, RrmsLateral, RunningRmsPolicy
from road_envs.policies.two_state import AccelerationDriven, Groundhook, Skyhook, SkyhookAdd

__all__ = [
    "FILE_SUFFIXES",
    "REGISTRY",
    "PluginWarning",
    "Policy",
    "PolicyContext",
    "PolicyError",
    "available",
    "create",
    "make_policy",
]

ENTRY_POINT_GROUP = "road_envs.policies"  # under which other packages offer policies

REGISTRY: dict[str, type[Policy]] = {
    "fixed": FixedPair,
    **dict.fromkeys(
        ["fixed_ride", "fixed_handling", "fixed_ride_handling", "fixed_handling_ride"], FixedPair
    ),
    "random": RandomSwitching,
    "rrms": RunningRmsPolicy,
    "lateral": LateralThreshold,
    "rrms_lateral": RrmsLateral,
    "skyhook": Skyhook,
    "groundhook": Groundhook,
    "add": AccelerationDriven,
    "sh_add": SkyhookAdd,
    "mpc": ModelPredictive,
    "greedy_information": GreedyInformation,
    "learned": NetworkPolicy,
}


@dataclass(frozen=True, kw_only=True)
class _PolicySettings(Settings):
    """Settings of a shipped policy and their source."""

    settings: dict[str, Any] = field(default_factory=dict)
    source: str = ""


def create(name: str, **settings: Any) -> Policy:
    """Create a policy with its tuned settings, overridden by `settings`. Raises ConfigError."""
    return _POLICIES.create(name, settings, _tuned_settings(name))


def make_policy(reference: str | Path, **settings: Any) -> Policy:
    """Return a policy by registered name or "module:Class", which take `settings`, or from a file
    of a network. Raises ConfigError, and whatever the code of another package raises.
    """
    name = str(reference)
    if name.endswith(FILE_SUFFIXES):
        if settings:
            raise ConfigError(f"{name} holds a network, which takes no settings")
        if not Path(name).is_file():
            raise ConfigError(f"{name}: there is no such file")
        return NetworkPolicy(file=name)
    if ":" not in name:
        return create(name, **settings)
    module, _, qualified_name = name.partition(":")
    try:
        cls: Any = attrgetter(qualified_name)(importlib.import_module(module))
        return build(_validate_policy_class(cls), settings, qualified_name)
    except (ImportError, AttributeError, TypeError) as error:
        raise ConfigError(f"the policy {name} cannot be used: {error}") from error


def runs_foreign_code(reference: str) -> bool:
    """Return whether `make_policy` would run code of another package; networks are only numbers."""
    return reference not in REGISTRY and not reference.endswith(FILE_SUFFIXES)


def _tuned_settings(name: str) -> dict[str, Any]:
    """Return the shipped settings of a policy; empty if there are none."""
    if name not in config.names("policies"):
        return {}
    settings = dict(config.load(_PolicySettings, "policies", name).settings)
    if "file" in settings:  # beside its settings, whatever the working folder has of this name
        settings["file"] = str(config.folder() / "policies" / settings["file"])
    return settings


def _validate_policy_class(cls: Any) -> Any:
    """Return `cls` if it has the interface of a policy. Raises TypeError."""
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        raise TypeError("it must be a dataclass of settings")
    for method in ("reset", "act"):
        if not callable(getattr(cls, method, None)):
            raise TypeError(f"it has no method {method}")
    return cls


_POLICIES = Registry("policy", ENTRY_POINT_GROUP, REGISTRY, _validate_policy_class)
available, names, entry_point = _POLICIES.available, _POLICIES.names, _POLICIES.entry_point
"""Look-up of all policies, as documented in `Registry`."""
