"""Versions of the evaluation code and of each estimator's code, as digests of source files.

Inside this project the files are found by following import statements, so an edit invalidates only
the results that it may have changed. Every file of another package counts, weights included.
Docstrings, comments and layout do not count.
"""

import importlib.util
from functools import cache
from pathlib import Path

from road_envs._code_digest import PACKAGES, closure, digest

EVALUATION_MODULE = "leaderboard.evaluation.evaluate"
"""Module that imports, directly or not, all code that determines drives and scores."""


@cache
def evaluation_version() -> str:
    """Return the version of the code that determines drives and scores."""
    return digest(closure(EVALUATION_MODULE))


def module_version(module: str) -> str:
    """Return the version of a module and of everything it imports."""
    top = module.partition(".")[0]
    return digest(closure(module) if top in PACKAGES else _package_files(top))


def _package_files(top: str) -> list[Path]:
    """Return all files of another package, or the single file of a module."""
    spec = importlib.util.find_spec(top)
    folders = [Path(folder) for folder in (spec.submodule_search_locations or ())] if spec else []
    if folders:
        files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
        return [path for path in files if "__pycache__" not in path.parts]
    return [Path(spec.origin)] if spec and spec.origin and Path(spec.origin).is_file() else []
