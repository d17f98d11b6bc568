"""`season`: a hidden test set, its hash before its seeds."""

import secrets
from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import console, print_json
from leaderboard.commands.simulate import Json
from leaderboard.evaluation import hidden_seeds
from leaderboard.evaluation.tasks import load_task, shipped_tasks
from road_envs.config import ConfigError

RANDOM_ROAD_BOARDS = ("new_road", "field", "class")
"""Boards whose roads are drawn."""


def season(
    out: Annotated[Path, typer.Option(help="Folder of the season.")],
    salt: Annotated[
        str | None, typer.Option(help="The secret; without one it is drawn and printed once.")
    ] = None,
    task: Annotated[
        list[str] | None, typer.Option(help="Shipped task; may be given again. Default: all drawn.")
    ] = None,
    reveal: Annotated[
        bool, typer.Option("--reveal", help="Check the salt and write the tasks with their seeds.")
    ] = False,
    json: Json = False,
) -> None:
    """Publish the hash of a hidden test set, and later, with --reveal, its seeds."""
    if reveal:
        if salt is None:
            raise ConfigError("--reveal needs the season's --salt")
        if task:
            raise ConfigError("--reveal takes the tasks of the season; leave --task away")
        paths = [str(path) for path in hidden_seeds.reveal(salt, out)]
        facts = {"commitment": hidden_seeds.load(out).commitment, "salt": salt, "tasks": paths}
    else:
        chosen = [load_task(name) for name in task] if task else _random_road_tasks()
        drawn, salt = salt is None, salt or secrets.token_urlsafe(24)
        made = hidden_seeds.commit(salt, chosen)
        path = hidden_seeds.save(made, out)
        facts = {"commitment": made.commitment, "publish": str(path)}
        if drawn:
            facts["salt, to be kept secret"] = salt
    if json:
        print_json(facts)
        return
    for name, value in facts.items():
        console.print(f"{name}: {', '.join(value) if isinstance(value, list) else value}")


def _random_road_tasks():
    return [one for one in shipped_tasks() if one.board in RANDOM_ROAD_BOARDS]
