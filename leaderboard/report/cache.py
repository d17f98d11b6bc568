"""The report of a board (rows and findings), cached with the sizes of its pages.

The key is the digest of everything that determines the report: tasks, stored results by their
checksums, conformance cards, and the code, templates and scripts of the pages. One file,

    <out>/.shown.json

spares a run without new results the bootstrap and the pages; `site.py` writes it with the pages.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path

from leaderboard.evaluation import store
from leaderboard.evaluation.provenance import package_version
from leaderboard.report.sentences import findings
from leaderboard.report.tables import BoardView, board_views
from leaderboard.running.board import Board
from road_envs.core.atomic_io import write_text
from road_envs.core.code_digest import closure, digest
from road_envs.core.config import build

CACHE_FILE = ".shown.json"
FORMAT = 2
MAX_CACHED_ROWS = 2000
"""Largest number of rows that is cached; a larger cache takes long to write and to read."""

SITE_MODULE = "leaderboard.report.site"
PAGE_FILES = [Path(__file__).parent / folder for folder in ("templates", "static")]


@dataclass(frozen=True)
class Report:
    """Boards, the main one first; findings in sentences; the key; and the sizes of its pages.

    `pages` is empty until they are written.
    """

    views: tuple[BoardView, ...]
    findings: tuple[str, ...]
    key: str
    pages: dict[str, int] = field(default_factory=dict)
    format: int = FORMAT


def build_report(board: Board, out: Path | None = None) -> Report:
    """Return the report of a board, from the cache under `out` if nothing has changed."""
    key = report_key(board)
    make = partial(build, Report, where=CACHE_FILE)
    if out and (cached := store.load_cached(out / CACHE_FILE, FORMAT, make, key=key)) is not None:
        return cached
    views = tuple(board_views(board))
    return Report(views, tuple(findings(views)), key)


def save_report(report: Report, out: Path) -> None:
    """Cache a report whose pages are written; a large one is not worth its file."""
    if sum(len(s.rows) for view in report.views for s in view.sections) <= MAX_CACHED_ROWS:
        write_text(out / CACHE_FILE, store.with_checksum(dataclasses.asdict(report)))
    else:
        (out / CACHE_FILE).unlink(missing_ok=True)


def report_key(board: Board) -> str:
    """Return the digest of everything that determines the report of a board."""
    total = hashlib.sha256()
    for part in _key_parts(board):
        total.update(f"{part}\n".encode())
    return total.hexdigest()


def _key_parts(board: Board) -> Iterator[str]:
    yield f"{package_version()} {_page_code_digest()}"
    for task in board.tasks:
        yield repr(task)
        for result in board.results[task.name]:
            card = board.card(result)
            yield json.dumps(
                [
                    store.row_checksum(result),
                    result.estimator,
                    result.failure,
                    board.stale_reason(task, result),
                    card and [card.identity, card.failure, card.passed_count],
                ]
            )


@cache
def _page_code_digest() -> str:
    files = [path for folder in PAGE_FILES for path in folder.rglob("*") if path.is_file()]
    return digest([*closure(SITE_MODULE), *files])
