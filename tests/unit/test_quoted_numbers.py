"""Figures that pages quote from a kept output are in it.

A comment such as `<!-- from docs/runs/field.txt -->` names the outputs of the block in which it
stands, or of the next one if it stands alone; a block is a paragraph, a table or an item of a list.
A table behind a paragraph whose last line is such a comment belongs to it. A row of a table names
the outputs to which it links, for what it says behind its first cell, the aim. Every number of the
block must be in one of them, at the digits that are quoted, as it is or in per cent. Numbers in
code, links and file names do not count.
"""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]
COMMENT = re.compile(r"<!-- from\s+([^>]+?) -->")
LINK = re.compile(r"\]\((?:\.\./)*(?:docs/)?(runs/[^)]+)\)")
NOT_QUOTED = re.compile(r"`[^`]*`|\]\([^)]*\)|<!--.*?-->|https?://\S+", re.S)
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.]*[A-Za-z_])(\s?%)?")


def blocks(text: str) -> Iterator[tuple[list[str], str]]:
    """Yield the outputs that each block names, and its text."""
    waiting: list[str] = []
    above: list[str] = []
    for block in re.split(r"\n\s*\n|\n(?=- )", text):
        named = [name for found in COMMENT.findall(block) for name in found.split(", ")]
        if named and not COMMENT.sub("", block).strip():
            waiting = named
            continue
        is_table = block.startswith("|")
        yield named or waiting or (above if is_table else []), block
        waiting = []
        above = named if COMMENT.fullmatch(block.rsplit("\n", 1)[-1].strip()) else []
        for row in block.splitlines() if is_table else []:
            if outputs := [f"docs/{path}" for path in LINK.findall(row)]:
                yield outputs, row.split("|", 2)[2]


@cache
def kept_numbers(name: str) -> list[float]:
    """Return the magnitudes of all numbers in a kept output."""
    text = (ROOT / name).read_text(encoding="utf-8")
    return [float(x) for x in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?:e[-+]?\d+)?", text)]


def missing(block: str, outputs: list[str]) -> list[str]:
    """Return the numbers of a block that are in none of its outputs."""
    kept = [x for name in outputs for x in kept_numbers(name)]
    lacking = []
    for found in NUMBER.finditer(NOT_QUOTED.sub(" ", block)):
        text = found[0].rstrip("% \n")
        digits = len(text.partition(".")[2])
        half = 0.5 * 10.0**-digits + 1e-9
        factors = (1.0, 100.0) if found[1] else (1.0,)
        if not any(abs(f * x - float(text)) <= half for f in factors for x in kept):
            lacking.append(found[0])
    return lacking


QUOTING = [
    pytest.param(outputs, block, id=f"{page.stem}: {' '.join(block.split())[:40]}")
    for page in PAGES
    for outputs, block in blocks(page.read_text(encoding="utf-8"))
    if outputs
]


@pytest.mark.parametrize(("outputs", "block"), QUOTING)
def test_every_quoted_number_is_in_the_kept_output(outputs, block):
    assert missing(block, outputs) == []


def test_enough_pages_name_their_outputs():
    pages = [page.name for page in PAGES if COMMENT.search(page.read_text(encoding="utf-8"))]
    assert {"README.md", "observability.md", "paper.md", "precision.md"} <= set(pages)
    assert len(QUOTING) >= 7


def test_a_wrong_number_is_found(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / "run.txt").write_text("flat 1.000\nours 0.394 share 0.77 count 12\n")
    text = (
        "Ours has 0.39, 77 % of 12 `99`.<!-- from run.txt -->\n\n<!-- from run.txt -->\n\n| 0.38 |"
    )
    (first, second) = list(blocks(text))
    kept_numbers.cache_clear()
    assert missing(first[1], first[0]) == [] and missing(second[1], second[0]) == ["0.38"]
    kept_numbers.cache_clear()


def test_tables_name_their_outputs_by_links_and_by_the_paragraph_before():
    text = (
        "Ours: <!-- from a.txt -->\n\n| 0.5 |\n\nTheirs 0.1\n<!-- from b.txt -->\n\n| 0.2 |\n\n"
        "| below 0.3 | 0.4 | [output](runs/c.txt) |\n"
    )
    paragraph, table, theirs, below, linked, row = blocks(text)
    assert paragraph[0] == ["a.txt"] and table[0] == []  # a sentence ends in it
    assert theirs[0] == below[0] == ["b.txt"]
    assert linked[0] == [] and row == (["docs/runs/c.txt"], " 0.4 | [output](runs/c.txt) |")
