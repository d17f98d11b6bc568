"""Jinja templates of the pages: one environment for the board, the policies and the paper."""

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

from road_envs.core.atomic_io import copy_file, write_text
from road_envs.core.extras import optional_import

STATIC = Path(__file__).parent / "static"  # style, scripts and pictures of all pages
BOARD_PAGE = "index.html"  # the comparison of policies links to it if it is there
POLICY_PAGE = "policies.html"  # all others link to it if it is there


def file_name(estimator: str) -> str:
    """Return the file name of the page of an estimator, for any name."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", estimator) + ".html"


@cache
def _environment() -> Any:
    with optional_import("a page"):
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup, escape

    loader = FileSystemLoader([STATIC.with_name("templates"), STATIC])
    blocks: Any = {"trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, **blocks)
    # JSON stands inside <script>, which only "<" could end
    environment.filters["data"] = lambda x: Markup(
        json.dumps(x, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    )
    environment.filters["file"] = file_name
    # `code` as in the docstrings
    environment.filters["code"] = lambda text: Markup(
        re.sub("`+([^`]+)`+", r"<code>\1</code>", str(escape(text)))
    )
    return environment


def render(template: str, **values: Any) -> str:
    """Render a template of `leaderboard/report/templates`. Raises MissingExtraError."""
    return _environment().get_template(template).render(values)


def write_pending(page: Path, title: str, command: str) -> None:
    """Write a page that says which command will write it, unless there is one: the board and the
    comparison of policies of one folder link to each other, whichever ends first.
    """
    if not page.exists():
        write_static(page.parent)
        own = {"title": title, "command": command, "root": "", "board": False, "policies": False}
        write_text(page, render("site/pending.html", **own))


def write_static(out: Path) -> None:
    """Copy the shared files of a site into `out`."""
    for source in sorted(STATIC.iterdir()):
        copy_file(source, out / STATIC.name / source.name)
