"""The boards as a static site that is opened from disk: no server, no network, one folder.

    index.html               who is best; all boards, with filters, sorting and findings
    tasks/<task>.html        one task: every score, and its charts
    estimators/<name>.html   one entry: method, errors, calibration, cost, failures, provenance
    seasons/<name>/          sites of past seasons, as they were built then, if they lie there
    static/                  style, scripts and the charts' library, shared by all pages
    export/                  the same for programs and papers

Each page contains its data; its tables need no scripts. The index is written last, so an
interrupted build leaves the old one; pages of removed tasks and entries and exports of removed
boards are deleted.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from leaderboard.evaluation.results import Result
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics.baselines import NOISE_LEVEL
from leaderboard.report import estimator_page, export, overview, tables
from leaderboard.report.board_definitions import LIMIT_ROWS, TEXT_COLUMNS, column_forms, rank_column
from leaderboard.report.charts import task_charts
from leaderboard.report.figures import rounded
from leaderboard.report.notes import PUBLIC_ROADS, has_public_roads, isolation_notice
from leaderboard.report.rendering import BOARD_PAGE, POLICY_PAGE, file_name, render, write_static
from leaderboard.report.sentences import UNRELATED_ROAD, Report, headline, unrelated_level_errors
from leaderboard.report.tables import BoardView, Row, Section
from leaderboard.running.board import Board
from road_envs.core.atomic_io import write_text

_MAX_DRAWN = 8  # number of entries of a task that are drawn, best first


def write_site(board: Board, report: Report, out: Path) -> Path:
    """Write the site into `out`, each file atomically, and return its index."""
    index, written = out / BOARD_PAGE, set()
    write_static(out)
    policies = (out / POLICY_PAGE).is_file()
    past = sorted(x.parent.name for x in out.glob(f"seasons/*/{BOARD_PAGE}"))
    for name, text in _render_pages(board, report, policies, past):  # the index comes last
        if name == index.name:
            export.write_exports(board, report.views, out)
        write_text(out / name, text)
        written.add(out / name)
    for path in {*out.glob("tasks/*.html"), *out.glob("estimators/*.html")} - written:
        path.unlink()
    return index


def _render_pages(
    board: Board, report: Report, policies: bool = False, past: Sequence[str] = ()
) -> Iterator[tuple[str, str]]:
    """Yield path and text of every page, with `policies` with links to their comparison; the index
    comes last and links to the sites of the `past` seasons.
    """
    linked = {"board": True, "policies": policies}
    results: dict[str, list[tuple[Task, Result]]] = {}
    for view in report.views:
        for section in view.sections:
            task = section.task
            for result in board.results[task.name]:
                results.setdefault(result.estimator, []).append((task, result))
            values = _task(board, view, section)
            yield f"tasks/{task.name}.html", render("site/task.html", **linked, **values)
    for name, own in results.items():
        values = estimator_page.page_values(board, report.views, name, own)
        yield f"estimators/{file_name(name)}", render("site/estimator.html", **linked, **values)
    yield BOARD_PAGE, render("site/index.html", **linked, past=past, **_index(board, report))


def _index(board: Board, report: Report) -> dict[str, Any]:
    errors, _ = unrelated_level_errors()
    claims = [x for task in board.tasks if (x := task.claimed_level_error) is not None]
    boards = [(view, [_table(view, s) for s in view.sections]) for view in report.views]
    explained = {(c.label, c.help): c for _, made in boards for t in made for c in t["columns"]}
    view = report.views[0]
    section = view.sections[0]
    scored = [result for task in board.tasks for result in board.scored(task)]
    scored.sort(key=lambda result: result.estimator)
    return {
        "root": "",
        "section": section,
        "ranking": overview.ranking_chart(section),
        "strip": overview.strip_chart(section, board.scored(section.task)),
        "headline": headline(section),
        "ranked_by": view.definition.ranks_by,
        "notice": isolation_notice(scored),
        "public": PUBLIC_ROADS if any(map(has_public_roads, board.tasks)) else None,
        "findings": report.findings,
        "levels": overview.levels_chart(sorted(claims)),
        "claims": claims,
        "pairs": f"{errors.size} wheel paths of class {UNRELATED_ROAD['road_class']}",
        "boards": boards,
        "explained": list(explained.values()),
        "noise": NOISE_LEVEL,
        "provenance": _board_provenance(board),
    }


def _table(view: BoardView, section: Section) -> dict[str, Any]:
    """Return a table: its columns, and for the scripts the rows by group, each [number, text]."""
    columns, ranks_by = tables.nonempty_columns(view, section), view.definition.ranks_by
    groups = dict.fromkeys(condition.label for condition in section.task.conditions)
    groups |= dict.fromkeys(name for names in section.groups.values() for name in names)
    keys = dict.fromkeys([*(column.key for column in columns), ranks_by, "rank_causal"])
    known = column_forms(view.definition)
    forms = {key: known[key] for key in keys if key not in TEXT_COLUMNS}
    numeric = {**forms, "low": known[ranks_by], "high": known[ranks_by]}
    data = {
        "ranks_by": ranks_by,
        "rank": rank_column(view.definition),
        "scale": view.definition.scale,
        "flat": 1.0 if ranks_by == "nrmse" else None,
        "groups": {kind: list(names) for kind, names in section.groups.items()},
        "columns": {k: {"better": form.better, "blank": form.blank} for k, form in forms.items()},
        "rows": [_row_data(row, numeric) for row in section.rows],
    }
    return {"section": section, "columns": columns, "groups": list(groups), "data": data}


def _row_data(row: Row, forms: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": row.name,
        "state": row.state,
        "causal": bool(row.causal),
        "message": row.message,
        # rows with few scores have empty cells instead of dashes
        "sparse": row.state == "claim" or row.name in LIMIT_ROWS,
        "cells": {key: row.cells[key] for key in TEXT_COLUMNS if row.cells.get(key)},
        "groups": {
            name: {
                key: [rounded(x, 5), form.format_value(x)]  # it sorts and draws; the text is read
                for key, form in forms.items()
                if (x := values.get(key)) is not None
            }
            for name, values in {tables.ALL_RUNS: row.values, **row.groups}.items()
        },
    }


def _task(board: Board, view: BoardView, section: Section) -> dict[str, Any]:
    task, rows = section.task, {row.name: row for row in section.rows}
    scored = board.scored(task)
    by_name = {result.estimator: result for result in scored}
    # without entries, the baselines are drawn
    order = [name for name, row in rows.items() if row.state == "scored"] or [
        name for name, row in rows.items() if row.state == "baseline" and name not in LIMIT_ROWS
    ]
    drawn = {name: by_name[name] for name in order[:_MAX_DRAWN]}
    on_level = tables.level_runs(scored, view.definition)
    return {
        "root": "../",
        "view": view,
        "score_table": _table(view, section),
        "task": task,
        "charts": task_charts(task, drawn, rows, on_level) if drawn else {},
        "notice": isolation_notice(scored),
        "public": PUBLIC_ROADS if has_public_roads(task) else None,
        "left_out": order[_MAX_DRAWN:],
        "facts_rows": [("drives", _drive_counts(task, scored)), ("digest", task.digest)],
    }


def _board_provenance(board: Board) -> list[tuple[str, str]]:
    """Return machines and versions, and the tasks with their digests."""
    machines: dict[str, Any] = {}
    rows = []
    for task in board.tasks:
        scored = board.scored(task)
        for result in scored:
            versions = {"road-envs": result.package_version, "metrics": result.metric_version}
            versions |= {k: x for k, x in result.environment.items() if k != "imports"}
            machines[", ".join(f"{name} {value}" for name, value in versions.items())] = None
        rows.append((task.name, f"{_drive_counts(task, scored)}; digest {task.digest[:12]}"))
    return [*(("Made by", text) for text in machines), *rows]


def _drive_counts(task: Task, results: Sequence[Result]) -> str:
    seeds = [*tables.training_counts(results).values()]
    asked = max((len(r.seeds) for r in results), default=0)
    tests = [len(task.drives_of(task.test, condition)) for condition in task.conditions]
    return (
        f"version {task.version}; conditions: {len(tests)}, each with "
        f"{len(task.training.roads_and_seeds)} training and "
        f"{_range(tests)} test drives; trainings: {_range(seeds or [asked])}"
    )


def _range(counts: Sequence[int]) -> str:
    return " to ".join(map(str, sorted({min(counts), max(counts)})))
