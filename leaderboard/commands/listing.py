"""Command `list`: the names that options take, each with a line on what it is."""

import inspect
import itertools
import re
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Annotated

from leaderboard.commands import make_table
from leaderboard.commands.options import argument
from leaderboard.commands.output import Output
from road_envs.core import config
from road_envs.core.config import validate_choice
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import ALL_MODES, PASSIVE_MODES

_Lines = dict[str, str]  # what a name stands for, by name


def _shipped(kind: str, describe: Callable[[str], str]) -> _Lines:
    return {name: describe(name) for name in config.names(kind)}


def _vehicle(name: str) -> str:
    car = load_vehicle(name)
    axles = "independent wheels" if car.front.kind == "independent" else "solid axles"
    return f"{car.m_b:.0f} kg on {axles}; modes {', '.join(car.modes)}"


def _sensors(name: str) -> str:
    each = load_instruments(name)
    noise = f"noise {each.noise_density:g} (m/s²)/sqrt(Hz)"
    return f"{', '.join(each.accelerometers)}; {each.fs:g} Hz, {noise}"


def _first_sentence(text: str) -> str:
    return re.split(r"(?<!et al)\. ", " ".join(text.split()))[0].rstrip(".")


def _registered(module: str) -> _Lines:
    """Return the first sentence, without backticks, of each class that a module has registered."""
    classes = sorted(import_module(module).available().items())
    heads = {name: (inspect.getdoc(cls) or "").partition("\n\n")[0] for name, cls in classes}
    return {name: _first_sentence(head).replace("`", "") for name, head in heads.items()}


def _boards() -> _Lines:
    from leaderboard.evaluation.boards import shipped_boards
    from leaderboard.evaluation.tasks import shipped_tasks

    tasks = shipped_tasks()
    return {
        name: f"{board.title}: {', '.join(t.name for t in tasks if t.board_name == name)}"
        for name, board in shipped_boards().items()
    }


def _tasks() -> _Lines:
    from leaderboard.evaluation.tasks import shipped_tasks

    return {task.name: task.title for task in shipped_tasks()}


def _conditions(name: str) -> str:
    from leaderboard.drive_report.conditions import load_conditions

    each = load_conditions(name)
    return f"{each.title}: {', '.join(each.categories)}"


def _modes() -> _Lines:
    cars = {name: load_vehicle(name) for name in config.names("vehicles")}
    lines = {}
    for mode, (stiff, high) in ALL_MODES.items():
        owners = ", ".join(name for name, car in cars.items() if mode in car.modes)
        spring, damper = "stiff" if stiff else "soft", "high" if high else "low"
        state = f"{spring} spring, {damper} damping"
        lines[mode] = f"{'nothing to switch' if mode in PASSIVE_MODES else state}: {owners}"
    return lines


def _road(name: str) -> str:
    """Return the first sentence of the comment at the head of a file."""
    text = config.find("roads", name).read_text(encoding="utf-8")
    head = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    return _first_sentence(" ".join(line.lstrip("# ") for line in head))


KINDS: dict[str, Callable[[], _Lines]] = {
    "vehicles": partial(_shipped, "vehicles", _vehicle),
    "sensors": partial(_shipped, "sensors", _sensors),
    "estimators": partial(_registered, "estimators.registry"),
    "policies": partial(_registered, "road_envs.policies"),
    "boards": _boards,
    "tasks": _tasks,
    "conditions": partial(_shipped, "conditions", _conditions),
    "modes": _modes,
    "roads": partial(_shipped, "roads", _road),
}


def list_names(
    kind: Annotated[str, argument(f"{', '.join([*KINDS][:-1])} or {[*KINDS][-1]}.")],
) -> Output:
    """List the names that an option takes, each with what it stands for.

    Estimators and policies of other installed packages are among them.
    """
    lines = KINDS[validate_choice("kind of names", kind, KINDS)]()
    heads = (kind, "what it is")
    return Output(facts=lines, shows=[make_table(heads, lines.items(), texts=heads[1:], box=None)])
