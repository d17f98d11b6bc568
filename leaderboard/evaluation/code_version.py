"""Versions of the code that makes drives and scores, and of each estimator.

Inside this project the files are found by following import statements, so that an edit voids the
results that it may have changed and no others. Of another package every file counts, weights
included. Docstrings, comments and layout do not count.
"""

import importlib.util
from functools import cache
from pathlib import Path

from road_envs._code_digest import PACKAGES, closure, digest

EVALUATION_MODULE = "leaderboard.evaluation.evaluate"
"""Everything that decides drives and scores is imported from here on."""


@cache
def evaluation_version() -> str:
    """Return the version of what makes drives and scores."""
    return digest(closure(EVALUATION_MODULE))


def module_version(module: str) -> str:
    """Return the version of the code in a module and of what it imports."""
    top = module.partition(".")[0]
    return digest(closure(module) if top in PACKAGES else _package_files(top))


def _package_files(top: str) -> list[Path]:
    """All files of another package, or the one file of a module."""
    spec = importlib.util.find_spec(top)
    folders = [Path(folder) for folder in (spec.submodule_search_locations or ())] if spec else []
    if folders:
        files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
        return [path for path in files if "__pycache__" not in path.parts]
    return [Path(spec.origin)] if spec and spec.origin and Path(spec.origin).is_file() else []
