"""Evaluation of estimators and of switching policies; from Python `score`, `plot`, `run_task`."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from leaderboard.api import ScoreTable, plot, run_task, score

__all__ = ["ScoreTable", "plot", "run_task", "score"]


def __getattr__(name: str) -> Any:
    """Import the Python interface when it is first used: the command line needs little of it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("leaderboard.api"), name)
