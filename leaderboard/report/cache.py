"""The report of a board (rows and findings), cached with the sizes of its pages.

The key is the digest of everything that determines the report: tasks, stored results by their
checksums, conformance cards, and the code, templates and scripts of the pages. One file,

    <out>/.shown.json

spares a run without new results the bootstrap and the pages; `site.py` writes it with the pages.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from leaderboard.evaluation import store
from leaderboard.evaluation.provenance import package_version
from leaderboard.report.sentences import findings
from leaderboard.report.tables import BoardView, board_views
from leaderboard.running.board import Board
from road_envs.core.artifacts import Kind
from road_envs.core.config import build

CACHE_FILE = ".shown.json"
REPORT = Kind("board report", 3, ("leaderboard.report.site",))
MAX_CACHED_ROWS = 2000
"""Largest number of rows that is cached; a larger cache takes long to write and to read."""

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


def build_report(board: Board, out: Path | None = None) -> Report:
    """Return the report of a board, from the cache under `out` if nothing has changed."""
    key = report_key(board)
    make = partial(build, Report, where=CACHE_FILE)
    if out and (cached := REPORT.find(out / CACHE_FILE, key, lambda x: make({**x, "key": key}))):
        return cached
    views = tuple(board_views(board))
    return Report(views, tuple(findings(views)), key)


def save_report(report: Report, out: Path) -> None:
    """Cache a report whose pages are written; a large one is not worth its file."""
    if sum(len(s.rows) for view in report.views for s in view.sections) <= MAX_CACHED_ROWS:
        content = dataclasses.asdict(report)
        REPORT.write(out / CACHE_FILE, content, content.pop("key"))
    else:
        (out / CACHE_FILE).unlink(missing_ok=True)


def report_key(board: Board) -> str:
    """Return the digest of everything that determines the report of a board."""
    files = [path for folder in PAGE_FILES for path in folder.rglob("*") if path.is_file()]
    return REPORT.identity(package_version(), *_shown(board), files=files)


def _shown(board: Board) -> Iterator[list[object]]:
    for task in board.tasks:
        yield [repr(task)]
        for result in board.results[task.name]:
            card = board.card(result)
            yield [
                store.row_checksum(result),
                result.estimator,
                result.failure,
                board.stale_reason(task, result),
                card and [card.identity, card.failure, card.passed_count],
                repr(board.methods.get(result.estimator)),
                [dataclasses.asdict(x) for x in board.verified.get(result.identity, ())],
            ]
