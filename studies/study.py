"""Results of a study that are not computed again: a row of a file for each case."""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]


def study_parser(description: str) -> argparse.ArgumentParser:
    """Return a parser of the file of results and of the plot."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("results", type=Path, help="one line of JSON for each case")
    parser.add_argument("--plot", type=Path)
    return parser


def run_study(
    chosen: argparse.Namespace,
    cases: Sequence[Row],
    compute: Callable[..., Row],
    summary: Callable[[list[Row]], str],
    draw: Callable[[list[Row], Path], None],
) -> None:
    """Append `compute(**case)` of the cases that are missing; print and draw all results.

    `chosen` are the parsed options of `study_parser`. A row begins with its case.
    """
    path: Path = chosen.results
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    rows = [json.loads(line) for line in text.splitlines()]
    for case in cases:
        if not any(case.items() <= row.items() for row in rows):
            rows.append(case | compute(**case))
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    print(summary(rows))
    if chosen.plot:
        draw(rows, chosen.plot)
