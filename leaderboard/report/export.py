"""Export of the boards for other programs and for papers: CSV, JSON, LaTeX and BibTeX.

<out>/export/<board>.csv    every score of every row, over all runs and over each group
<out>/export/<board>.json   the same, with notes
<out>/export/<board>.tex    the table of the page, for the package booktabs
<out>/export/road_recon.bib  citation of this project and of the paper
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leaderboard.metrics.registry import SCORES
from leaderboard.report.citation import as_bibtex
from leaderboard.report.tables import ALL_RUNS, BoardView, Row, Section, nonempty_columns
from road_envs.core.atomic_io import write_text

FOLDER = "export"
ROW_FIELDS = ("board", "task", "group", "estimator", "state", "causal", "text")
NUMBER_FIELDS = (
    "rank", "rank_causal", "low", "high", *SCORES,
    "grade_S0", "grade_S1", "grade_S2", "grade_S3", "slope", "slope_low", "slope_high",
    "train_seconds", "calibrate_seconds", "estimate_ms_per_100m", "parameters",
)  # fmt: skip
LATEX_ESCAPES = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {"–": "--", "²": "$^2$", "~": "\\~{}", "^": "\\^{}", "\\": "\\textbackslash{}"}
)
FORMULA_SIGNS = ("=", "+", "-", "@", "\t", "\r")
"""First characters by which a spreadsheet takes a text for a formula."""


def write_exports(views: Sequence[BoardView], out: Path) -> list[Path]:
    """Write all exports, each atomically; return their paths."""
    boards = ", ".join(view.board.replace("_", " ") for view in views)
    texts = {"road_recon.bib": as_bibtex(f"results of board {boards}")}
    for view in views:
        texts[f"{view.board}.csv"] = as_csv(view)
        texts[f"{view.board}.json"] = json.dumps(as_json([view]), indent=1) + "\n"
        texts[f"{view.board}.tex"] = as_latex(view)
    paths = [out / FOLDER / name for name in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        write_text(path, text)
    return paths


def as_json(views: Sequence[BoardView]) -> list[dict[str, Any]]:
    """Return the rows as plain data: boards, their tasks, and the numbers of each entry."""
    return [
        {
            "task": section.task,
            "board": view.board,
            "title": section.title,
            "notes": list(section.notes),
            "entries": [
                {
                    "name": row.name,
                    "state": row.state,
                    "text": row.message,
                    "causal": row.causal,
                    **row.values,
                    "groups": row.groups,
                }
                for row in section.rows
            ],
        }
        for view in views
        for section in view.sections
    ]


def as_csv(view: BoardView) -> str:
    """Return one line for each row and group; undefined scores are empty."""
    import pandas as pd

    lines: list[dict[str, Any]] = [
        {"board": view.board, "task": section.task, "group": group, "estimator": row.name}
        | {"state": row.state, "causal": row.causal, "text": row.message, **values}
        for section in view.sections
        for row in section.rows
        for group, values in {ALL_RUNS: row.values, **row.groups}.items()
    ]
    table = pd.DataFrame(lines, columns=[*ROW_FIELDS, *NUMBER_FIELDS])
    table["causal"] = table["causal"].map({True: "true", False: "false"})
    texts = table[[*ROW_FIELDS]].map(lambda x: f"'{x}" if str(x).startswith(FORMULA_SIGNS) else x)
    numbers = table[[*NUMBER_FIELDS]].astype(float)
    return texts.join(numbers).to_csv(index=False, float_format="%.6g", lineterminator="\n")


def as_latex(view: BoardView) -> str:
    """Return a LaTeX table of each task, with the columns of the page."""
    return "\n".join(_tabular(view, section) for section in view.sections)


def _tabular(view: BoardView, section: Section) -> str:
    columns = [column for column in nonempty_columns(view, section) if not column.wide]
    heads = [column.label + (f" [{column.unit}]" if column.unit else "") for column in columns]
    lines = [_latex_cells(["estimator", *heads]), "\\midrule"]
    lines += [_latex_row(row, [column.key for column in columns]) for row in section.rows]
    return "\n".join(
        [
            f"% {section.task}: {' '.join(section.title.split())}",
            f"\\begin{{tabular}}{{l{'r' * len(columns)}}}",
            "\\toprule",
            *lines,
            "\\bottomrule",
            "\\end{tabular}",
            "",
        ]
    )


def _latex_row(row: Row, keys: Sequence[str]) -> str:
    if row.message:
        name = row.name.translate(LATEX_ESCAPES)
        message = f"{row.state}: {row.message}".translate(LATEX_ESCAPES)
        return f"{name} & \\multicolumn{{{len(keys)}}}{{l}}{{{message}}} \\\\"
    return _latex_cells([row.name, *(row.cells.get(key, "") for key in keys)])


def _latex_cells(cells: Sequence[str]) -> str:
    return " & ".join(cell.translate(LATEX_ESCAPES) for cell in cells) + " \\\\"
