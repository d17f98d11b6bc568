"""Evaluation of estimators and of switching policies.

From Python `score`, `plot`, `run_task`, and in plain arrays `load_task`, `score_arrays`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from leaderboard.api import ScoreTable, load_task, plot, run_task, score, score_arrays

__all__ = ["ScoreTable", "load_task", "plot", "run_task", "score", "score_arrays"]


def __getattr__(name: str) -> Any:
    """Import the Python interface when it is first used: the command line needs little of it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("leaderboard.api"), name)
