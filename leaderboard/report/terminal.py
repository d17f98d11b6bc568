"""The boards as tables in a terminal."""

import textwrap
from collections.abc import Mapping
from itertools import zip_longest
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from leaderboard.metrics import UNDEFINED
from leaderboard.report.board_definitions import BOUND_NAME, WORST
from leaderboard.report.sentences import Report
from leaderboard.report.tables import BoardView, Row, Section, nonempty_columns

_CASE_WIDTH = 18  # width of the column with the titles of the tasks that share a table [characters]
_LOOK: Any = {"title_justify": "left", "box": None, "padding": (0, 1, 0, 0), "pad_edge": False}
_STYLES = dict(scored="bold", baseline="dim", claim="italic", failed="red", stale="yellow")
_LEGEND = (
    "NRMSE: error over truth, RMS, in 0.2 to min(1.8, 22.5 Hz / v) cycles/m; a flat road has 1. "
    "Interquartile means over roads and trainings; worst: the worst drive; > 0.3, > 1: shares of "
    f"drives above. The row bound is the {BOUND_NAME}. eq. 12: error of the RMS level alone, as "
    "printed, and about the mean; it is that of the longest waves, which kalman_lag for one cuts "
    "off. Rank: the place by score, shared unless more entries are significantly better. No rank, "
    "interval or worst drive from fewer than 5 roads. Dim rows: baselines. 5/5 beside a name: "
    "probes passed, of those that apply (--probes)."
)


def print_tables(report: Report, console: Console) -> None:
    """Print every board, with failed and stale results, and the findings."""
    for view in report.views:
        one_table = view.board == "paper" and len(view.sections) > 1
        for sections in [view.sections] if one_table else [(s,) for s in view.sections]:
            console.print(_table(view, sections))
            for section in sections:
                if (families := _family_table(view, section)) is not None:
                    console.print(families)
                    console.print()
        _remarks(view, console)
    console.print(Text(_LEGEND, style="dim"))
    for sentence in report.findings:
        console.print(Text(f"- {sentence}"))


def _table(view: BoardView, sections: tuple[Section, ...]) -> Table:
    """Return the table of one section with its title, or of several that share columns."""
    columns = [column for column in nonempty_columns(view, *sections) if not column.wide]
    grouped = len(sections) > 1
    of_task = "" if grouped else f": {sections[0].task.heading}"
    table = Table(title=view.definition.title + of_task, **_LOOK)
    if grouped:
        table.add_column("case", width=_CASE_WIDTH)
    table.add_column("estimator", no_wrap=True)
    for column in columns:
        table.add_column(f"{column.label}\n{column.unit}".rstrip("\n"), justify="right")
    for section in sections:
        name = f"{section.task.name}: {section.task.heading}"
        case = textwrap.wrap(name, _CASE_WIDTH) if grouped else []
        cells = [_cells(row, [column.key for column in columns]) for row in section.rows]
        blank = [""] * (len(columns) + 1)
        for text, row in zip_longest(case, cells, fillvalue=None):
            table.add_row(*([text or ""] if grouped else []), *(row or blank))
        table.add_row()
    return table


def _family_table(view: BoardView, section: Section) -> Table | None:
    """Return the ranking score by family of roads: mean and worst drive; None if there is one."""
    names = section.groups.get("family", ())
    if not names or view.definition.ranks_by != "nrmse":
        return None
    shown = [row.groups.get(name, {}) for row in section.rows for name in names]
    worst = " (worst drive)" if any(values.get(WORST) is not None for values in shown) else ""
    table = Table(title=f"NRMSE by family of roads: interquartile mean{worst}", **_LOOK)
    table.add_column("estimator", no_wrap=True)
    for name in names:
        table.add_column(Text(name), justify="right")
    for row in section.rows:
        if row.groups:
            style = _STYLES[row.state]
            cells = [_mean_and_worst(row.groups.get(name, {})) for name in names]
            table.add_row(*(Text(text, style=style) for text in [row.name, *cells]))
    return table


def _mean_and_worst(values: Mapping[str, float | None]) -> str:
    """Return the mean of a group with its worst drive in brackets, where it has them."""
    mean, worst = values.get("nrmse"), values.get(WORST)
    if mean is None:
        return UNDEFINED
    return f"{mean:.2f}" if worst is None else f"{mean:.2f} ({worst:.2f})"


def _cells(row: Row, keys: list[str]) -> list[Text]:
    style = _STYLES[row.state]
    mark = (f" {row.cells['probes']}", "dim") if row.cells.get("probes") else ""
    name = Text.assemble((row.name, style), mark)
    if row.state in ("failed", "stale"):
        return [name, Text(row.state, style=style), *[Text("")] * (len(keys) - 1)]
    return [name, *(Text(row.cells.get(key, ""), style=style) for key in keys)]


def _remarks(view: BoardView, console: Console) -> None:
    """Print each note of the tasks once, and the message of each failed or stale result."""
    notes: dict[str, list[str]] = {}
    for section in view.sections:
        failed = [f"{x.name} {x.state}: {x.message}" for x in section.rows if x.message]
        for note in (*section.notes, *failed):
            notes.setdefault(note, []).append(section.task.name)
    for note, tasks in notes.items():
        console.print(Text.assemble((f"{', '.join(tasks)}:", "dim"), f" {note}"))
    console.print()
