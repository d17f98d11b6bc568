"""Subcommands of `road-recon`, and their common option parsing, progress bar and output."""

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from leaderboard.json_values import nan_to_none
from road_envs.config import ConfigError

console = Console(markup=False)
notices = Console(stderr=True, markup=False)


def parse_mode(text: str) -> str | dict[str, str]:
    """Parse a 4S4 mode, "ride" or "front=ride,rear=handling"."""
    if "=" not in text:
        return text
    parts = [part.partition("=") for part in text.split(",")]
    return {wheel.strip(): mode.strip() for wheel, _, mode in parts}


def parse_settings(pairs: list[str]) -> dict[str, Any]:
    """Parse settings from "key=value" pairs with YAML values. Raises ConfigError."""
    settings = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key and equals):
            raise ConfigError(f"a setting must have the form key=value, got {pair!r}")
        settings[key] = yaml.safe_load(value)
    return settings


def check_output_path(path: Path | None, *suffixes: str) -> Path | None:
    """Return `path` if its suffix is allowed and its folder exists. Raises ConfigError."""
    if path is not None:
        if path.suffix.lower() not in suffixes:
            raise ConfigError(f"{path}: the name must end in {' or '.join(suffixes)}")
        if not path.parent.is_dir():
            raise ConfigError(f"{path}: the folder {path.parent} does not exist")
    return path


def to_json(data: object) -> str:
    """Return `data` as JSON; NaN and infinity become null."""
    return json.dumps(nan_to_none(data), indent=2, allow_nan=False) + "\n"


def print_json(data: object) -> None:
    """Write `data` to standard output as JSON."""
    print(to_json(data), end="")


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar on standard error; yield its update(description, share of 0 to 1)."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(
        *columns, console=notices, transient=True, disable=not notices.is_terminal
    ) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda text, share: bar.update(task, description=text, completed=share)
