"""The boards for other programs and for papers: CSV, JSON, LaTeX and BibTeX.

<out>/export/<board>.csv    every score of every line, over all runs and over each group
<out>/export/<board>.json   the same, with notes
<out>/export/<board>.tex    the table of the page, for the package booktabs
<out>/export/roadrecon.bib  how to cite this project and the paper
"""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leaderboard.evaluation.provenance import version
from leaderboard.metrics.registry import SCORES
from leaderboard.report.tables import ALL, Line, Section, View, filled
from road_envs._atomic_io import write_text

FOLDER = "export"
FIELDS = ("board", "task", "group", "estimator", "state", "causal", "text")
NUMBERS = ("rank", "rank_causal", "low", "high", *SCORES)
OVER_GRADES = ("grade_S0", "grade_S1", "grade_S2", "grade_S3", "slope", "slope_low", "slope_high")
COST = ("train_seconds", "estimate_ms_per_100m", "parameters")
BIBLIOGRAPHY = """@software{{roadrecon,
  title = {{RoadRecon: road profile reconstruction from vehicle responses, an honest benchmark}},
  version = {{{version}}},
  note = {{results of board {boards}}},
}}

@article{{ngwangwa_reconstruction,
  title = {{Reconstruction of road defects and road roughness classification using Artificial
           Neural Networks simulation and vehicle dynamic responses: Application to experimental
           data}},
  author = {{Ngwangwa, H. M. and Heyns, P. S. and Breytenbach, H. G. A. and Els, P. S.}},
  journal = {{Journal of Terramechanics}},
}}
"""
ESCAPED = str.maketrans({c: f"\\{c}" for c in "&%$#_{}"} | {"–": "--", "²": "$^2$", "~": "\\~{}"})


def write(views: Sequence[View], out: Path) -> list[Path]:
    """Write all of them, each whole or not at all."""
    texts = {"roadrecon.bib": bibtex(views)}
    for view in views:
        texts[f"{view.board}.csv"] = as_csv(view)
        texts[f"{view.board}.json"] = json.dumps(as_json([view]), indent=1) + "\n"
        texts[f"{view.board}.tex"] = latex(view)
    paths = [out / FOLDER / name for name in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        write_text(path, text)
    return paths


def as_json(views: Sequence[View]) -> list[dict[str, Any]]:
    """The rows for a program: boards, their tasks, and the numbers of each entry."""
    return [
        {
            "task": section.task,
            "board": view.board,
            "title": section.title,
            "notes": list(section.notes),
            "entries": [
                {
                    "name": line.name,
                    "state": line.state,
                    "text": line.text,
                    "causal": line.causal,
                    **line.values,
                    "groups": line.groups,
                }
                for line in section.lines
            ],
        }
        for view in views
        for section in view.sections
    ]


def as_csv(view: View) -> str:
    """One row for each line and group; a score that is not defined is empty."""
    text = io.StringIO()
    rows = csv.DictWriter(text, [*FIELDS, *NUMBERS, *OVER_GRADES, *COST], lineterminator="\n")
    rows.writeheader()
    for section in view.sections:
        for line in section.lines:
            for group, values in {ALL: line.values, **line.groups}.items():
                known = {name: values.get(name) for name in (*NUMBERS, *OVER_GRADES, *COST)}
                rows.writerow(
                    {
                        "board": view.board,
                        "task": section.task,
                        "group": group,
                        "estimator": line.name,
                        "state": line.state,
                        "causal": "" if line.causal is None else str(line.causal).lower(),
                        "text": line.text,
                        **{name: "" if x is None else f"{x:.6g}" for name, x in known.items()},
                    }
                )
    return text.getvalue()


def latex(view: View) -> str:
    """A table of each task with the columns of the page."""
    return "\n".join(_tabular(view, section) for section in view.sections)


def bibtex(views: Sequence[View]) -> str:
    """How to cite this project and the paper that it follows."""
    boards = ", ".join(view.board.replace("_", " ") for view in views)
    return BIBLIOGRAPHY.format(version=version(), boards=boards)


def _tabular(view: View, section: Section) -> str:
    columns = [column for column in filled(view, section) if not column.wide]
    heads = [column.label + (f" [{column.unit}]" if column.unit else "") for column in columns]
    lines = [_row(["estimator", *heads]), "\\midrule"]
    lines += [_latex_line(line, [column.key for column in columns]) for line in section.lines]
    return "\n".join(
        [
            f"% {section.task}: {section.title}",
            f"\\begin{{tabular}}{{l{'r' * len(columns)}}}",
            "\\toprule",
            *lines,
            "\\bottomrule",
            "\\end{tabular}",
            "",
        ]
    )


def _latex_line(line: Line, keys: Sequence[str]) -> str:
    if line.text:
        said = f"{line.state}: {line.text}".translate(ESCAPED)
        return f"{line.name.translate(ESCAPED)} & \\multicolumn{{{len(keys)}}}{{l}}{{{said}}} \\\\"
    return _row([line.name, *(line.cells.get(key, "") for key in keys)])


def _row(cells: Sequence[str]) -> str:
    return " & ".join(cell.replace("\\", "/").translate(ESCAPED) for cell in cells) + " \\\\"
