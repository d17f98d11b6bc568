"""What a board shows, made once: its rows, what they say in sentences, and a key to both.

The key is the digest of all that decides them: tasks, stored results by their checksums, cards, and
the code and templates of the pages. Under a folder the rows are kept beside it,

    <out>/.shown.json

so that a run to which nothing is new need not draw the bootstrap again; `page.py` goes by the same
key.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from leaderboard.evaluation import store
from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.tasks import BoardName
from leaderboard.report.board_definitions import BOARDS
from leaderboard.report.sentences import findings
from leaderboard.report.tables import BoardView, Section, board_views
from leaderboard.running.board import Board
from road_envs._code_digest import closure, digest
from road_envs.config import ConfigError, build

CACHE_FILE = ".shown.json"
FORMAT = 1
MAX_CACHED_ROWS = 2000
"""Rows of a board that is kept; what is larger would take long to write and to read."""

SITE_MODULE = "leaderboard.report.site"
TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Report:
    """Boards, the main one first; what their numbers say; and the key."""

    views: tuple[BoardView, ...]
    findings: tuple[str, ...]
    key: str


@dataclass(frozen=True)
class _CachedView:
    board: BoardName
    sections: tuple[Section, ...]


@dataclass(frozen=True)
class _CachedReport:
    format: int
    key: str
    views: tuple[_CachedView, ...]
    findings: tuple[str, ...]


def build_report(board: Board, out: Path | None = None) -> Report:
    """What a board shows; kept under `out`, and taken from there if nothing has changed."""
    key = report_key(board)
    if out is not None and (kept := _load_cached(out / CACHE_FILE, key)) is not None:
        return kept
    made = tuple(board_views(board))
    found = Report(made, tuple(findings(made)), key)
    if out is not None and sum(map(len, board.results.values())) <= MAX_CACHED_ROWS:
        store.write_text(out / CACHE_FILE, store.with_checksum(_as_dict(found)))
    return found


def report_key(board: Board) -> str:
    """Digest of all that decides what is shown of a board."""
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
    templates = [path for path in TEMPLATES.rglob("*") if path.is_file()]
    return digest([*closure(SITE_MODULE), *templates])


def _as_dict(made: Report) -> dict[str, Any]:
    rows = [
        {"board": view.board, "sections": [dataclasses.asdict(s) for s in view.sections]}
        for view in made.views
    ]
    return {"format": FORMAT, "key": made.key, "views": rows, "findings": list(made.findings)}


def _load_cached(path: Path, key: str) -> Report | None:
    try:
        data, _ = store.read_checked_json(path, FORMAT)
        if data.get("key") != key:
            return None
        kept = build(_CachedReport, data, str(path))
    except ConfigError:  # none there, or a damaged one
        return None
    found = tuple(BoardView(view.board, BOARDS[view.board], view.sections) for view in kept.views)
    return Report(found, kept.findings, key)
