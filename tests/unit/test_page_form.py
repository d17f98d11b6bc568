"""Pages of the documentation: their length, the words they do not use, tables that render."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("**/*.md"))]
SOURCES = [
    p for name in ("road_envs", "estimators", "leaderboard") for p in (ROOT / name).rglob("*.py")
]
MAX_WORDS, MAX_README_LINES, MAX_CHANGELOG_LINES = 1500, 120, 150
OUTDATED = re.compile(
    r"\b(of before|all rows are of|printed before|earlier program|stood here|until lately)\b",
    re.I,
)
"""Of a figure that another program made: it is made again, and the build marks it until then."""


def broken_tables(text: str) -> list[str]:
    """Return the first rows of Markdown tables that no blank line precedes."""
    lines = re.sub(r"^ *```.*?^ *```", "```", text, flags=re.S | re.M).splitlines()
    rows = [line.lstrip().startswith("|") for line in lines]
    return [
        line
        for k, line in enumerate(lines)
        if rows[k] and k and not rows[k - 1] and lines[k - 1].strip()
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_short_and_its_tables_render(page):
    text = page.read_text(encoding="utf-8")
    assert len(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL).split()) < MAX_WORDS
    assert OUTDATED.findall(text) == []
    assert broken_tables(text) == []


def test_the_readme_and_the_changelog_are_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= MAX_README_LINES
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert len(changes.splitlines()) < MAX_CHANGELOG_LINES


def test_the_tables_of_docstrings_render():
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    texts = {
        f"{path.name}: {row}"
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, documented)
        for row in broken_tables(ast.get_docstring(node) or "")
    }
    assert texts == set()


def test_a_table_without_a_blank_line_before_it_is_found():
    assert broken_tables("```\n| no |\n```\n| key |\n|---|\n") == ["| key |"]
    assert broken_tables("```\nx\n```\n\n| key |\n|---|\n") == []


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n")[1]
    named = set(re.findall(r"[\w/]+\.md", navigation))
    assert named == {p.relative_to(ROOT / "docs").as_posix() for p in PAGES[1:]}
