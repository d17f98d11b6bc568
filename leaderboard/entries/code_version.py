"""Versions of the evaluation code and of each estimator's code, as digests of source files.

The files are found by following import statements, so an edit invalidates only the results that it
may have changed. Docstrings, comments and layout do not count. Of entries from outside this project
every file counts, byte by byte (`leaderboard.entries.entry_files`).
"""

from functools import cache

from road_envs.core.code_digest import closure, digest

EVALUATION_MODULE = "leaderboard.evaluation.evaluate"
"""Module that imports, directly or not, all code that determines drives and scores."""


@cache
def evaluation_version() -> str:
    """Return the version of the code that determines drives and scores."""
    return digest(closure(EVALUATION_MODULE))


def module_version(module: str) -> str:
    """Return the version of a module of this project and of everything it imports."""
    return digest(closure(module))
