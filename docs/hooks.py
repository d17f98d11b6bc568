"""Hooks of the documentation build, which write the reference from the code.

These markers on a page are replaced: `<!-- commands -->` by the help of every command,
`<!-- scores -->` by the table of scores, `<!-- modules: road_envs.roads -->` by the documentation
of every module of that package, `<!-- keys: module:Class -->` by the keys of a dataclass.
"""

import dataclasses
import importlib
import re
from pathlib import Path
from typing import Any

import typer
from typer.cli import get_docs_for_click

from leaderboard.cli import app
from leaderboard.metrics.registry import SCORES
from studies import results

ROOT = Path(__file__).parents[1]


QUOTE = re.compile(r"<!-- (?:from|output:|rows:|scores:)\s+([^>]+?) -->")
LINK = re.compile(r"\]\((?:\.\./)*(?:docs/)?(runs/[^)]+)\)")
PICTURE = re.compile(r"!\[[^\]]*\]\((?:\.\./)*(?:docs/)?(images/[^)]+)\)")


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Replace the markers of a page, and mark figures that are not of today's program."""
    markdown = QUOTE.sub(_with_mark, markdown)
    markdown = LINK.sub(lambda found: found[0] + _mark([f"docs/{found[1]}"]), markdown)
    markdown = PICTURE.sub(lambda found: found[0] + _mark([f"docs/{found[1]}"]), markdown)
    for marker, content in (("<!-- commands -->", _commands), ("<!-- scores -->", _scores)):
        if marker in markdown:
            markdown = markdown.replace(marker, content())
    markdown = re.sub(r"<!-- keys: ([\w.:]+) -->", lambda found: _keys(found[1]), markdown)
    return re.sub(r"<!-- modules: ([\w.]+) -->", lambda found: _modules(found[1]), markdown)


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Take the script for searching from disk out of this folder, not from the network."""
    root = "../" * page.url.count("/")
    return output.replace("https://unpkg.com/iframe-worker/shim", f"{root}search_worker.js")


def _with_mark(found: re.Match[str]) -> str:
    return found[0] + _mark(found[1].replace(",", " ").split())


def _mark(outputs: list[str]) -> str:
    """Say by what program stale outputs were made; nothing for those of today's program."""
    names = dict.fromkeys(name for path in outputs if (name := results.result_of(path)))
    reasons = dict.fromkeys(reason for name in names if (reason := results.stale_reason(name)))
    return "".join(f' <span class="stale">{reason}</span>' for reason in reasons)


def _commands() -> str:
    """Return the help of every command, each under a heading of level 2."""
    command = typer.main.get_command(app)
    context = typer.Context(command, info_name="road-recon")
    text = get_docs_for_click(obj=command, ctx=context, name="road-recon")
    return "## " + text.partition("\n## ")[2]


def _scores() -> str:
    """Return the table of scores."""
    better = {"low": "lower", "high": "higher", "zero": "towards 0", "": ""}
    rows = [
        f"| `{key}` | {score.label} | {score.unit} | {better[score.better]} | {score.help} |"
        for key, score in SCORES.items()
    ]
    return "\n".join(
        ["| key | score | unit as printed | better | what it is |", "|---|---|---|---|---|", *rows]
    )


def _keys(reference: str) -> str:
    """Return the table of the keys of a dataclass "module:Class"."""
    module, _, name = reference.partition(":")
    rows = ["| key | unit | default | meaning |", "|---|---|---|---|"]
    for f in dataclasses.fields(getattr(importlib.import_module(module), name)):
        notes: list[Any] = [x for x in getattr(f.type, "__metadata__", ()) if isinstance(x, str)]
        unit, meaning = (*notes, "", "")[:2]
        is_empty = f.default is None or f.default is dataclasses.MISSING
        default = "" if is_empty or f.default in ((), "") else f"`{f.default}`"
        rows.append(f"| `{f.name}` | {unit} | {default} | {meaning} |")
    return "\n".join(rows)


def _modules(package: str) -> str:
    """Return the directives that document the public modules of a package, and itself first."""
    folder = ROOT / package.replace(".", "/")
    names = [package] if (folder / "__init__.py").read_text() else []
    for path in sorted(folder.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        if not path.name.startswith("_"):
            names.append(name)
    return "\n\n".join(
        f"::: {name}\n    options:\n      toc_label: {name.removeprefix(package + '.')}"
        for name in names
    )
