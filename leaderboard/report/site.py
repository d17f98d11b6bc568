"""The boards as a static site that is opened from disk: no server, no network, one folder.

    index.html               all boards, with filters, sorting and what the numbers say
    tasks/<task>.html        one task: every score, and its drawings
    estimators/<name>.html   one entry: its card, all its results, where they come from
    export/                  the same for programs and papers

Each page stands alone: style, scripts and numbers are inside. Without scripts the tables are still
there; filters and drawings need them. The index is written last, so an interrupted build leaves the
old one; what no longer belongs is swept away.
"""

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from leaderboard.evaluation.results import Result
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics.baselines import NOISE
from leaderboard.report import charts, export
from leaderboard.report.cache import Shown
from leaderboard.report.sentences import UNRELATED, unrelated_levels
from leaderboard.report.tables import BOUND, Section, View, filled
from leaderboard.running.board import Board
from road_envs._atomic_io import write_text

DRAWN = 8
"""How many entries of a task are drawn, best first; each has a colour and a dash of its own."""

FOLDERS = ("tasks", "estimators")
STAMP = ".page.json"
"""What the site in a folder shows, by key, and how large its files are."""


def write_page(board: Board, shown: Shown, out: Path) -> Path:
    """Write the site into `out` and return its index; each file whole or not at all.

    Nothing is written if the site that stands there shows the same.
    """
    index = out / "index.html"
    if _stands(out, shown.key):
        return index
    (out / STAMP).unlink(missing_ok=True)
    written = []
    for name, text in pages(board, shown):  # the index comes last
        if name == index.name:
            export.write(shown.views, out)
        write_text(out / name, text)
        written.append(name)
    for folder in FOLDERS:
        for path in (out / folder).glob("*.html"):
            if f"{folder}/{path.name}" not in written:
                path.unlink()
    sizes = {name: (out / name).stat().st_size for name in written}
    write_text(out / STAMP, json.dumps({"key": shown.key, "sizes": sizes}) + "\n")
    return index


def _stands(out: Path, key: str) -> bool:
    """Whether the whole site of a board stands in `out`."""
    try:
        stamp = json.loads((out / STAMP).read_text(encoding="utf-8"))
        sizes = {name: (out / name).stat().st_size for name in stamp["sizes"]}
        return bool(stamp["key"] == key and stamp["sizes"] == sizes)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def pages(board: Board, shown: Shown) -> Iterator[tuple[str, str]]:
    """Every page, the index last: its place and its text."""
    render = _renderer()
    results: dict[str, list[tuple[Task, Result]]] = {}
    for view in shown.views:
        for section in view.sections:
            task = next(task for task in board.tasks if task.name == section.task)
            for result in board.results[task.name]:
                results.setdefault(result.estimator, []).append((task, result))
            yield f"tasks/{task.name}.html", render("task.html", _task(board, view, section, task))
    for name, found in results.items():
        yield (
            f"estimators/{file_name(name)}",
            render("estimator.html", _estimator(board, shown.views, name, found)),
        )
    yield "index.html", render("index.html", _index(board, shown))


def file_name(estimator: str) -> str:
    """The page of an estimator, whatever it is called."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", estimator) + ".html"


def _renderer() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("leaderboard.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    # inside a script only "<" could end it
    environment.filters["data"] = lambda x: Markup(
        json.dumps(x, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    )
    environment.filters |= {"file": file_name}

    def render(template: str, values: dict[str, Any]) -> str:
        return environment.get_template(f"site/{template}").render(values)

    return render


def _index(board: Board, shown: Shown) -> dict[str, Any]:
    errors, _ = unrelated_levels()
    claims = [t.claimed_level_error for t in board.tasks if t.claimed_level_error is not None]
    return {
        "root": "",
        "findings": shown.findings,
        "levels": {
            "x": [charts.rounded(100.0 * x) for x in sorted(errors.tolist())],
            "claims": sorted(100.0 * x for x in claims),
        },
        "pairs": f"{errors.size} wheel paths of class {UNRELATED['road_class']}",
        "boards": [(view, [_table(view, s) for s in view.sections]) for view in shown.views],
        "noise": NOISE,
        "provenance": provenance(board),
    }


def _table(view: View, section: Section) -> dict[str, Any]:
    """One table: its columns, and the numbers behind it."""
    columns = filled(view, section)
    groups = dict.fromkeys(section.conditions)
    groups |= dict.fromkeys(name for names in section.groups.values() for name in names)
    return {
        "section": section,
        "columns": columns,
        "groups": list(groups),
        "data": charts.table(view, section, columns),
    }


def _task(board: Board, view: View, section: Section, task: Task) -> dict[str, Any]:
    lines = {line.name: line for line in section.lines}
    by_name = {result.estimator: result for result in board.scored(task)}
    order = [name for name, line in lines.items() if line.state == "scored"] or [
        name for name, line in lines.items() if line.state == "sentinel" and name != BOUND
    ]
    drawn = {name: by_name[name] for name in order[:DRAWN]}
    return {
        "root": "../",
        "view": view,
        "table_made": _table(view, section),
        "task": task,
        "drawn": charts.scenes(task, view.kind, drawn, lines) if drawn else None,
        "left_out": order[DRAWN:],
        "spread": any(line.values.get("low") is not None for line in lines.values()),
        "facts_rows": [("drives", _drives(task, board.scored(task))), ("digest", task.digest)],
    }


def _estimator(
    board: Board, shown: Sequence[View], name: str, found: Sequence[tuple[Task, Result]]
) -> dict[str, Any]:
    rows = [
        (view, section, line)
        for view in shown
        for section in view.sections
        for line in section.lines
        if line.name == name
    ]
    first = found[0][1]
    return {
        "root": "../",
        "name": name,
        "role": first.role,
        "causal": first.causal,
        "settings": first.settings,
        "cards": list(
            {card.identity: card for _, result in found if (card := board.card(result))}.values()
        ),
        "rows": rows,
        "results": [(task, result, origin(board, task, result)) for task, result in found],
    }


def provenance(board: Board) -> list[tuple[str, str]]:
    """Where the numbers come from: machines and versions, and the tasks with their digests."""
    made: dict[str, None] = {}
    rows = []
    for task in board.tasks:
        scored = board.scored(task)
        made |= dict.fromkeys(_machine(result) for result in scored)
        rows.append((task.name, f"{_drives(task, scored)}; digest {task.digest[:12]}"))
    return [*(("Made by", text) for text in made), *rows]


def origin(board: Board, task: Task, result: Result) -> list[tuple[str, str]]:
    """Where the numbers of one result come from."""
    told = {
        "file": f"results/{result.task}/{result.estimator}.json",
        "task": f"version {task.version}, digest {result.task_digest}",
        "state": board.why_stale(task, result) or "fresh",
        "package": f"roadrecon {result.package_version}, metrics {result.metric_version}",
        "training seeds": ", ".join(map(str, result.seeds)),
        "settings": json.dumps(result.settings) if result.settings else "none",
    }
    return [*told.items(), *result.environment.items()]


def _machine(result: Result) -> str:
    versions = {"roadrecon": result.package_version, "metrics": result.metric_version}
    return ", ".join(f"{name} {value}" for name, value in (versions | result.environment).items())


def _drives(task: Task, results: Sequence[Result]) -> str:
    seeds = max((len(r.seeds) for r in results), default=0)
    return (
        f"version {task.version}; conditions: {len(task.conditions)}, each with "
        f"{len(task.training.pairs)} training and {len(task.test.pairs)} test drives; "
        f"trainings: {seeds}"
    )
