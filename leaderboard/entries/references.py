"""References of entries: what a user may name, and what is an estimator of this package."""

import os
from importlib import metadata
from pathlib import Path

import estimators
from leaderboard.entries.entry_files import CLASS_REFERENCE, WEIGHTS_SUFFIXES
from road_envs.core.code_digest import PACKAGES
from road_envs.core.config import ConfigError, validate_choice


def is_ours(reference: str) -> bool:
    """Return whether a reference names an estimator of this package."""
    return reference in estimators.REGISTRY or (
        CLASS_REFERENCE.fullmatch(reference) is not None
        and reference.partition(":")[0].partition(".")[0] in PACKAGES
    )


def find_reference(name: str) -> str:
    """Return the reference of what a user has named: a path, "module:Class" or an installed name.

    Raises ConfigError for a file that does not exist and for an unknown name.
    """
    path = Path(name)
    if path.suffix in (*WEIGHTS_SUFFIXES, ".whl") or os.sep in name:
        if not (path.is_file() or path.is_dir()):  # pipes and devices have no end
            choices = "a wheel, a folder of an installed package, or a file from `train`"
            raise ConfigError(f"{name}: no such file; give {choices}")
        return str(path.resolve())
    if CLASS_REFERENCE.fullmatch(name):
        return name
    validate_choice("estimator", name, estimators.names())
    if name in estimators.REGISTRY:
        return name
    plugins = metadata.entry_points(group=estimators.ENTRY_POINT_GROUP)
    return next(entry.value for entry in plugins if entry.name == name)
