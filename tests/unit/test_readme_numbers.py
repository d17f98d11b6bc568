"""Figures that the README quotes are those of the kept output of the command that it names."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
KEPT = (ROOT / "docs/runs/new_road.txt").read_text(encoding="utf-8")


def rows(text: str) -> dict[str, list[str]]:
    """Return the numbers of each row of the first table, by estimator."""
    table = text[re.search(r"estimator +rank", text).start() :].splitlines()[1:]
    ends = (k for k, line in enumerate(table) if not line.strip() or line.startswith("```"))
    end = next(ends, len(table))
    return {line.split()[0]: line.split()[1:] for line in table[:end]}


def test_the_results_table_is_the_kept_output_of_its_command():
    command = KEPT.splitlines()[0].removeprefix("$ ")
    assert f"`{command}`" in README
    table = rows(README)
    assert table.items() <= rows(KEPT).items() and len(table) > 15


def test_errors_in_the_text_are_rows_of_the_table():
    text = README[README.index("NRMSE: RMS error of") : README.index("## Limits")]
    quoted = re.findall(r"(\d\.\d{3})[\s,(]+worst\s+drive\s+(\d\.\d\d)", text)
    assert len(quoted) >= 4
    assert set(quoted) <= {(row[1], row[3]) for row in rows(KEPT).values() if len(row) > 3}
