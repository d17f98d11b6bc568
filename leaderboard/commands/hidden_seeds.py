"""Command `season`: a hidden test set, published first as a hash and later with its seeds."""

import secrets
from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import console, print_json
from leaderboard.commands.options import Json
from leaderboard.evaluation import hidden_seeds
from leaderboard.evaluation.tasks import load_task, shipped_tasks
from road_envs.core.config import ConfigError

RANDOM_ROAD_BOARDS = ("new_road", "field", "class")
"""Boards with random roads."""


def season(
    out: Annotated[Path, typer.Option(help="Folder of the hidden test set.")],
    salt: Annotated[
        str | None, typer.Option(help="Secret salt; if missing, one is drawn and printed once.")
    ] = None,
    task: Annotated[
        list[str] | None,
        typer.Option(help="Shipped task; may be given again. Default: all with random roads."),
    ] = None,
    reveal: Annotated[
        bool, typer.Option("--reveal", help="Verify the salt and write the tasks with their seeds.")
    ] = False,
    json: Json = False,
) -> None:
    """Publish the hash of a hidden test set, and later, with --reveal, its seeds."""
    if reveal:
        if salt is None:
            raise ConfigError("--reveal needs the --salt of the hidden test set")
        if task:
            raise ConfigError("--reveal uses the tasks of the hidden test set; leave out --task")
        paths = [str(path) for path in hidden_seeds.reveal(salt, out)]
        facts = {"commitment": hidden_seeds.load(out).commitment, "salt": salt, "tasks": paths}
    else:
        chosen = [load_task(name) for name in task] if task else _random_road_tasks()
        is_drawn, salt = salt is None, salt or secrets.token_urlsafe(24)
        hidden = hidden_seeds.commit(salt, chosen)
        path = hidden_seeds.save(hidden, out)
        facts = {"commitment": hidden.commitment, "publish": str(path)}
        if is_drawn:
            facts["salt, to be kept secret"] = salt
    if json:
        print_json(facts)
        return
    for name, value in facts.items():
        console.print(f"{name}: {', '.join(value) if isinstance(value, list) else value}")


def _random_road_tasks():
    return [task for task in shipped_tasks() if task.board_name in RANDOM_ROAD_BOARDS]
