"""Tables of README and docs that are copies of kept outputs, written from them.

    <!-- output: docs/runs/new_road.txt 0 -->
    ```text
    ...
    ```

The block of code becomes the output without its commands; a number behind the path takes the one
part, of those that blank lines separate, and a regular expression in slashes lines with it.

    <!-- rows: docs/runs/bench.json what measured aim met -->

    | ... |

The table becomes these columns of an output that is a list of rows as JSON, with three digits of
each number that is none of a text, and the first and last of a list.

    <!-- scores: docs/runs/new_road.csv nrmse .3f; nrmse .2f Belgian; coverage_90 .0% -->

    | | all | Belgian | inside 90 % |
    |---|---|---|---|
    | `map_smoother` | ... |

Each cell becomes the score of its column in that format, over all drives or over a group of them,
for the estimators that the table names, best first by the first column.
`python -m studies.results make` writes all pages.
"""

import io
import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from road_envs.core.atomic_io import write_text
from road_envs.core.code_digest import ROOT
from road_envs.core.config import ConfigError

COPY = re.compile(
    r"(<!-- output: (\S+?)(?: (\d+))?(?: /(.+)/)? -->\n```text\n)(?:(?!```).*\n)*(```\n)",
    re.MULTILINE,
)
ROWS = re.compile(r"(<!-- rows: (\S+) ([\w ]+?) -->\n\n)((?:\|.*\n)*)")
SCORES = re.compile(r"(<!-- scores: (\S+) ([^>]+?) -->\n\n\|.*\n\|[-|]+\n)((?:\|.*\n)+)")
WORDS = {"True": "met", "False": "missed", "None": ""}
"""How verdicts are written."""


def pages(root: Path = ROOT) -> list[Path]:
    """README and every page of the docs."""
    return [root / "README.md", *sorted((root / "docs").glob("**/*.md"))]


def with_outputs(text: str, read: Callable[[str], str]) -> str:
    """Text of a page with its copies as today's outputs are. Raises ConfigError."""

    def copy(found: re.Match[str]) -> str:
        head, path, part, wanted, end = found.groups()
        lines = [line for line in read(path).splitlines() if not line.startswith("$ ")]
        parts = "\n".join(lines).strip("\n").split("\n\n")
        if part is not None and int(part) >= len(parts):
            raise ConfigError(f"{path} has {len(parts)} parts, and a page asks for part {part}")
        chosen = "\n\n".join(parts) if part is None else parts[int(part)]
        lines = [line for line in chosen.splitlines() if not wanted or re.search(wanted, line)]
        return head + "\n".join(lines) + "\n" + end

    def table(found: re.Match[str]) -> str:
        head, path, names, _ = found.groups()
        columns = names.split()
        cells = [[_cell(row.get(name, "")) for name in columns] for row in json.loads(read(path))]
        cells = [[WORDS.get(cell, cell) for cell in row] for row in cells]
        lines = [columns, ["---"] * len(columns), *cells]
        return head + "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def scores(found: re.Match[str]) -> str:
        head, path, wanted, old = found.groups()
        known = pd.read_csv(io.StringIO(read(path)), index_col=["estimator", "group"]).sort_index()
        columns = [re.fullmatch(r"(\S+) (\S+) ?(.*)", column) for column in wanted.split("; ")]
        rows = {}
        for name in re.findall(r"^\| `(\w+)` ", old, re.MULTILINE):
            try:
                rows[name] = [
                    (known.loc[(name, group or math.nan), score].item(), form)
                    for score, form, group in (column.groups() for column in columns if column)
                ]
            except KeyError as error:
                raise ConfigError(f"{path} has no {error} of {name}, which a page shows") from None
        lines = []
        for name, cells in sorted(rows.items(), key=lambda row: row[1][0][0]):
            shown = ["" if math.isnan(value) else f"{value:{form}}" for value, form in cells]
            lines.append(f"| {' | '.join([f'`{name}`', *shown])} |\n")
        return head + "".join(lines).replace("%", " %")

    return SCORES.sub(scores, ROWS.sub(table, COPY.sub(copy, text)))


def _cell(value: object) -> str:
    if isinstance(value, list):
        return f"{_cell(value[0])} to {_cell(value[-1])}"
    if isinstance(value, float) and not value.is_integer():
        return f"{value:.3g}"
    return f"{value:.0f}" if isinstance(value, float) else str(value)


def write_pages(root: Path = ROOT) -> list[Path]:
    """Write the copies of all pages; returns the pages that changed. Raises ConfigError."""

    def read(path: str) -> str:
        try:
            return (root / path).read_text(encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"a page shows {path}, which cannot be read: {error}") from None

    changed = []
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        new = with_outputs(text, read)
        if new != text:
            write_text(page, new)
            changed.append(page)
    return changed
