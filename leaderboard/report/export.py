"""Export of the boards for other programs and for papers: Parquet, CSV, JSON, LaTeX and BibTeX.

<out>/export/<board>.parquet  every score of every run: a row for each estimate and score
<out>/export/<board>.csv      every score of every row, over all runs and over each group
<out>/export/<board>.json     the same, with notes
<out>/export/<board>.tex      the table of the page, for the package booktabs
<out>/export/road_recon.bib    citation of this project and of the paper
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leaderboard.evaluation.results import COLUMNS, scores_table
from leaderboard.metrics.registry import SCORES
from leaderboard.report.board_definitions import TAIL, WORST
from leaderboard.report.citation import as_bibtex
from leaderboard.report.tables import ALL_RUNS, BoardView, Section, nonempty_columns
from leaderboard.running.board import Board
from road_envs.core.atomic_io import atomic_write, write_text
from road_envs.sensing.perturbed_vehicle import GRADES

_ROW_FIELDS = ("board", "task", "group", "estimator", "state", "causal", "text")
_NUMBER_FIELDS = (
    "rank", "rank_causal", "low", "high", *SCORES,
    WORST, *TAIL, *(f"grade_{grade}" for grade in GRADES), "slope", "slope_low", "slope_high",
    "train_seconds", "calibrate_seconds", "estimate_ms_per_100m", "parameters",
)  # fmt: skip
_FORMULA_SIGNS = ("=", "+", "-", "@", "\t", "\r")  # first of a formula in a spreadsheet


def write_exports(board: Board, views: Sequence[BoardView], out: Path) -> None:
    """Write all exports, each atomically, and delete those of boards that are no longer there."""
    import pandas as pd

    boards = ", ".join(view.board.replace("_", " ") for view in views)
    texts = {"road_recon.bib": as_bibtex(f"results of board {boards}")}
    folder = out / "export"
    folder.mkdir(parents=True, exist_ok=True)
    for view in views:
        texts[f"{view.board}.csv"] = _as_csv(view)
        texts[f"{view.board}.json"] = json.dumps(as_json([view]), indent=1) + "\n"
        texts[f"{view.board}.tex"] = "\n".join(_as_latex(view, s) for s in view.sections)
        tasks = [section.task for section in view.sections]
        runs = pd.concat([scores_table(board.scored(x)).assign(task=x.name) for x in tasks])
        with atomic_write(folder / f"{view.board}.parquet") as partial:
            runs[["task", "estimator", *COLUMNS]].to_parquet(partial, index=False)
    for name, text in texts.items():
        write_text(folder / name, text)
    for name in {path.stem for path in folder.iterdir()} - {view.board for view in views}:
        files = [folder / f"{name}.{suffix}" for suffix in ("parquet", "csv", "tex", "json")]
        if all(file.is_file() for file in files):  # a single one is somebody else's
            for file in files:
                file.unlink()


def as_json(views: Sequence[BoardView]) -> list[dict[str, Any]]:
    """Return the rows as plain data: boards, their tasks, and the numbers of each entry."""
    return [
        {
            "task": section.task.name,
            "board": view.board,
            "title": section.task.heading,
            "notes": list(section.notes),
            "entries": [
                {"name": row.name, "state": row.state, "text": row.message, "causal": row.causal}
                | {**row.values, "groups": row.groups}
                for row in section.rows
            ],
        }
        for view in views
        for section in view.sections
    ]


def _as_csv(view: BoardView) -> str:
    """Return one line for each row and group; undefined scores are empty."""
    import pandas as pd

    lines: list[dict[str, Any]] = [
        {"board": view.board, "task": section.task.name, "group": group, "estimator": row.name}
        | {"state": row.state, "causal": row.causal, "text": row.message, **values}
        for section in view.sections
        for row in section.rows
        for group, values in {ALL_RUNS: row.values, **row.groups}.items()
    ]
    table = pd.DataFrame(lines, columns=[*_ROW_FIELDS, *_NUMBER_FIELDS])
    table["causal"] = table["causal"].map({True: "true", False: "false"})
    texts = table[[*_ROW_FIELDS]].map(lambda x: f"'{x}" if str(x).startswith(_FORMULA_SIGNS) else x)
    numbers = table[[*_NUMBER_FIELDS]].astype(float)
    return texts.join(numbers).to_csv(index=False, float_format="%.6g", lineterminator="\n")


def _as_latex(view: BoardView, section: Section) -> str:
    """Table of a task in LaTeX, with the columns of the page."""
    import pandas as pd

    columns = [column for column in nonempty_columns(view, section) if not column.wide]
    heads = [column.heading for column in columns] or [""]
    lines = []
    for row in section.rows:
        cells = [row.cells.get(column.key, "") for column in columns] or [""]
        if row.message:
            cells = [f"{row.state}: {row.message}", *cells[1:]]
        lines.append([row.name, *cells])
    table = pd.DataFrame(lines, columns=["estimator", *heads]).map(lambda x: " ".join(x.split()))
    text = table.to_latex(index=False, escape=True, column_format="l" + "r" * len(heads))
    return f"% {section.task.name}: {' '.join(section.task.heading.split())}\n{text}"
