"""Boards: how the results of tasks are shown, as YAML in `configs/boards` or in the task itself.

Nothing here influences a result: editing a board leaves all of them valid.
"""

from dataclasses import dataclass
from functools import cache
from typing import Literal

from leaderboard.metrics.registry import SCORES
from road_envs.core import config
from road_envs.core.config import Positive, Settings


@dataclass(frozen=True, kw_only=True)
class BoardDefinition(Settings):
    """Title, ranking score and columns of a board.

    `columns` and, on request, `on_request` are keys of `report.board_definitions.COLUMNS`. Entries
    are ranked in each of `divisions`: all of them (offline), and the causal ones among themselves;
    the first orders the rows. Boards with a lower `order` come first. `scale` is the value of the
    ranking score at the right end of bars and profiles.
    """

    title: str
    description: str = ""
    ranks_by: str = "nrmse"
    columns: tuple[str, ...] = ("nrmse", "interval", "worst", "r")
    on_request: tuple[str, ...] = ()
    divisions: tuple[Literal["offline", "causal"], ...] = ("offline", "causal")
    scale: Positive = 2.0
    order: int = 100

    def __post_init__(self):
        super().__post_init__()
        low = [key for key, x in SCORES.items() if x.better == "low" and x.compute is not None]
        config.validate_choice("score to rank by, of which less is better:", self.ranks_by, low)


@cache
def shipped_boards() -> dict[str, BoardDefinition]:
    """Return the shipped boards by name, in their order. Raises ConfigError."""
    boards = {name: config.load(BoardDefinition, "boards", name) for name in config.names("boards")}
    return dict(sorted(boards.items(), key=lambda item: (item[1].order, item[0])))
