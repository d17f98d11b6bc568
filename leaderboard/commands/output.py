"""Output of a command, and the one layer that turns functions into commands.

A command returns an `Output` of facts; the layer adds the option --json and prints. A parameter
whose type is a dataclass, as `DriveOptions`, becomes its options; a default of its own has theirs.
"""

import functools
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, cast

import typer
from rich.table import Column, Table

from leaderboard.commands import console, print_json
from leaderboard.commands.options import Json


@dataclass(frozen=True, kw_only=True)
class Output:
    """Findings of a command: `facts`, and what a terminal `shows` of them, by default all."""

    facts: Any
    shows: Sequence[Any] | None = None
    status: int = 0  # of the process; 1: what was checked has failed


def facts_table(facts: dict[str, Any]) -> Sequence[Any]:
    """Return a table of facts, and below it their notes, one per line."""
    table = Table("", Column("", overflow="fold"), show_header=False, box=None, pad_edge=False)
    for key, value in facts.items():
        if key != "notes" and value not in ([], {}, None):
            table.add_row(key, _text(value))
    return [table, *(f"- {note}" for note in facts.get("notes", ()))]


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{k} {_text(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_text(v) for v in value)
    return str(value)


def as_command(function: Callable[..., Any]) -> Callable[..., None]:
    """Return the command of a function, with the options of its dataclasses and --json."""
    parameters: list[inspect.Parameter] = []
    groups: dict[str, type] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if not is_dataclass(parameter.annotation):
            parameters.append(parameter)
            continue
        groups[name] = cast(type, parameter.annotation)
        parameters += [
            _keyword(each.name, each.type, getattr(parameter.default, each.name, each.default))
            for each in fields(parameter.annotation)
        ]
    returns_output = inspect.signature(function).return_annotation is Output
    if returns_output:
        parameters.append(_keyword("json", Json, False))

    @functools.wraps(function)
    def run(**given: Any) -> None:
        json = given.pop("json") if returns_output else False
        for name, group in groups.items():
            given[name] = group(**{each.name: given.pop(each.name) for each in fields(group)})
        output = function(**given)
        if output is None:
            return
        if json:
            print_json(output.facts)
        else:
            for part in facts_table(output.facts) if output.shows is None else output.shows:
                console.print(part, highlight=False, soft_wrap=isinstance(part, str))
        if output.status:
            raise typer.Exit(output.status)

    del run.__wrapped__
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def _keyword(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=default, annotation=annotation)
