"""The boards in a terminal, and for a program."""

import textwrap
from itertools import zip_longest
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from leaderboard.report import export
from leaderboard.report.cache import Report
from leaderboard.report.tables import BoardView, Row, Section, nonempty_columns

CASE_WIDTH = 18
STYLES = {
    "scored": "bold",
    "baseline": "dim",
    "claim": "italic",
    "failed": "red",
    "stale": "yellow",
}
LEGEND = (
    "NRMSE: error over truth, RMS, in 0.2 to min(1.8, 22.5 Hz / v) cycles/m; a flat road has 1, "
    "the bound is what the sensors allow. level, eq. 12: error of the level alone, about the mean "
    "and as printed. class: octaves in the true ISO 8608 class. Interquartile means over roads and "
    "trainings; entries that cannot be told apart share a rank. Dim rows: sentinels. 5/5 beside a "
    "name: the probes passed, of those that apply (--probes)."
)


def print_tables(report: Report, console: Console) -> None:
    """Print every board, what failed or is stale, and what the numbers say."""
    for view in report.views:
        together = view.board == "paper" and len(view.sections) > 1
        for sections in [view.sections] if together else [(s,) for s in view.sections]:
            console.print(_table(view, sections))
        _remarks(view, console)
    console.print(f"[dim]{escape(LEGEND)}[/dim]")
    for sentence in report.findings:
        console.print(f"- {escape(sentence)}")


def as_json(report: Report) -> list[dict[str, Any]]:
    """The same rows for a program."""
    return export.as_json(report.views)


def _table(view: BoardView, sections: tuple[Section, ...]) -> Table:
    """One section with its title, or several that share columns and stand behind each other."""
    columns = [column for column in nonempty_columns(view, *sections) if not column.wide]
    grouped = len(sections) > 1
    title = view.definition.title if grouped else f"{view.definition.title}: {sections[0].title}"
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0), pad_edge=False)
    if grouped:
        table.add_column("case", width=CASE_WIDTH)
    table.add_column("estimator", no_wrap=True)
    for column in columns:
        table.add_column(
            column.label + (f"\n{column.unit}" if column.unit else ""), justify="right"
        )
    for section in sections:
        case = textwrap.wrap(f"{section.task}: {section.title}", CASE_WIDTH) if grouped else []
        cells = [_cells(row, [column.key for column in columns]) for row in section.rows]
        blank = [""] * (len(columns) + 1)
        for text, row in zip_longest(case, cells, fillvalue=None):
            table.add_row(*([text or ""] if grouped else []), *(row or blank))
        table.add_row()
    return table


def _cells(row: Row, keys: list[str]) -> list[str]:
    style = STYLES[row.state]
    mark = f" [dim]{row.cells['probes']}[/dim]" if row.cells.get("probes") else ""
    name = f"[{style}]{escape(row.name)}[/{style}]{mark}"
    if row.state in ("failed", "stale"):
        return [name, *[f"[{style}]{row.state}[/{style}]", *[""] * len(keys)][: len(keys)]]
    return [name, *(f"[{style}]{row.cells.get(key, '')}[/{style}]" for key in keys)]


def _remarks(view: BoardView, console: Console) -> None:
    """Notes of each task, each said once, and the sentence of each failed or stale result."""
    said: dict[str, list[str]] = {}
    for section in view.sections:
        for note in section.notes:
            said.setdefault(note, []).append(section.task)
        for row in section.rows:
            if row.message:
                said.setdefault(f"{row.name} {row.state}: {row.message}", []).append(section.task)
    for note, tasks in said.items():
        console.print(f"[dim]{escape(', '.join(tasks))}:[/dim] {escape(note)}")
    console.print()
