"""Jinja templates of the pages: one environment for the board, the policies and the paper."""

import json
import re
from functools import cache
from typing import Any

from road_envs._extras import optional_import


def file_name(estimator: str) -> str:
    """Return the file name of the page of an estimator, for any name."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", estimator) + ".html"


@cache
def _environment() -> Any:
    with optional_import("a page"):
        from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("leaderboard.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    # JSON stands inside <script>, which only "<" could end
    environment.filters["data"] = lambda x: Markup(
        json.dumps(x, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    )
    environment.filters["file"] = file_name
    return environment


def render(template: str, **values: Any) -> str:
    """Render a template of `leaderboard/report/templates`. Raises MissingExtraError."""
    return _environment().get_template(template).render(values)
