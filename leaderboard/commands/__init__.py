"""Subcommands of `road-recon`, and their common option parsing, progress bar and output."""

import contextlib
import json
import math
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from road_envs.core.artifacts import nan_to_none
from road_envs.core.config import ConfigError

console = Console(markup=False, emoji=False)
notices = Console(stderr=True, markup=False, emoji=False)
PICTURES, YAML = (".png", ".svg", ".pdf"), (".yaml", ".yml")  # suffixes of output paths


def parse_mode(text: str) -> str | dict[str, str]:
    """Parse a mode of the struts, "ride" or "front=ride,rear=handling". Raises ConfigError."""
    return parse_pairs("mode", text) if "=" in text else text


def parse_pairs(option: str, text: str) -> dict[str, str]:
    """Return the mapping of "key=value,key=value". Raises ConfigError."""
    pairs = [part.partition("=") for part in text.split(",")]
    if wrong := [f"{key}{equals}{value}" for key, equals, value in pairs if not (key and value)]:
        raise ConfigError(f"--{option} must be key=value,key=value, got {wrong[0]!r}")
    return {key.strip(): value.strip() for key, _, value in pairs}


def parse_settings(pairs: list[str] | None) -> dict[str, Any]:
    """Parse settings from "key=value" pairs with YAML values. Raises ConfigError."""
    settings = {}
    for pair in pairs or ():
        key, equals, value = pair.partition("=")
        if not (key and equals):
            raise ConfigError(f"a setting must have the form key=value, got {pair!r}")
        settings[key] = yaml.safe_load(value)
    return settings


def find_from_here(references: Iterable[str]) -> None:
    """Find the modules of `references` "module:Class" also in this folder, and import none."""
    from leaderboard.entries.entry_files import CLASS_FOLDER

    if any(":" in reference for reference in references):
        os.environ[CLASS_FOLDER] = os.getcwd()


def import_from_here(reference: str) -> None:
    """Import the module of a `reference` "module:Class" also from this folder, in this process."""
    find_from_here([reference])
    if ":" in reference and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last: a file here takes the place of no installed module


def check_output_path(path: Path | None, *suffixes: str) -> None:
    """Raise ConfigError unless the suffix of a path is allowed and its folder exists."""
    if path is not None and path.suffix.lower() not in suffixes:
        raise ConfigError(f"{path}: the name must end in {' or '.join(suffixes)}")
    if path is not None and not path.parent.is_dir():
        raise ConfigError(f"{path}: the folder {path.parent} does not exist")


def check_output_folder(path: Path | None) -> None:
    """Raise ConfigError if a path is one of a file."""
    if path is not None and path.exists() and not path.is_dir():
        raise ConfigError(f"--out must be a folder, {path} is a file")


def make_table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], *, texts: Sequence[str] = (), **look: Any
) -> Table:
    """Return a table: the first column and those headed by `texts` on the left, numbers right."""
    table = Table(**look)
    for head in heads:
        is_text = head == heads[0] or head in texts
        table.add_column(head, justify="left" if is_text else "right", no_wrap=head == heads[0])
    for row in rows:
        table.add_row(*row)
    return table


def to_json(data: object) -> str:
    """Return `data` as JSON; NaN and infinity become null."""
    return json.dumps(nan_to_none(data), indent=2, allow_nan=False) + "\n"


def print_json(data: object) -> None:
    """Write `data` to standard output as JSON."""
    print(to_json(data), end="")


@contextlib.contextmanager
def progress_bar(kept: str = "") -> Iterator[Callable[[str, float], None]]:
    """Show progress on standard error; yield its update(description, share of 0 to 1).

    A terminal shows a bar; a file or pipe gets a line every LINE_INTERVAL with the time left.
    SIGINT ends the command with a sentence on what is `kept` and how to continue, if anything is.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    try:
        if not notices.is_terminal:
            yield _progress_lines(partial(notices.print, soft_wrap=True, highlight=False))
            return
        with Progress(*columns, console=notices, transient=True) as bar:
            task, left = bar.add_task("starting", total=1.0), _time_left()
            yield lambda text, share: bar.update(
                task, description=text + left(share), completed=share
            )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(kept) from None


LINE_INTERVAL = 10.0  # time [s] between two lines of progress without a terminal


def _time_left(clock: Callable[[], float] = time.monotonic) -> Callable[[float], str]:
    """Return a function of the share done that tells the time left as ", about 40 s left", if any.

    The rest is taken to be as fast as what is done since the last update with the first share:
    neither stored results nor what was prepared before count.
    """
    begin, first_share = clock(), math.inf

    def remains(share: float) -> str:
        nonlocal begin, first_share
        if share <= first_share:
            begin, first_share = clock(), share
        done = share - first_share
        left = (clock() - begin) * (1.0 - share) / done if done > 0.0 else 0.0
        return f", about {_describe_duration(left)} left" if left > 0.0 else ""

    return remains


def _progress_lines(
    write: Callable[[str], object], clock: Callable[[], float] = time.monotonic
) -> Callable[[str, float], None]:
    """Return an update that writes lines: share done, description, and the time left."""
    left, due = _time_left(clock), clock() + LINE_INTERVAL

    def update(text: str, share: float) -> None:
        nonlocal due
        remains = left(share)
        if clock() >= due:
            due = clock() + LINE_INTERVAL
            write(f"{100.0 * share:3.0f} %  {text}{remains}")

    return update


def _describe_duration(seconds: float) -> str:
    """Return a time in whole seconds, minutes or hours, as "40 s", "12 min" or "3 h 05 min"."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def command_line() -> str:
    """Return the command line without the folder of the program."""
    return shlex.join(["road-recon", *sys.argv[1:]])
