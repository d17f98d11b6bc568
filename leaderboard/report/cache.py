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
from leaderboard.evaluation.code_version import closure, digest
from leaderboard.evaluation.provenance import version
from leaderboard.evaluation.tasks import BoardName
from leaderboard.report.board_definitions import BOARDS
from leaderboard.report.sentences import findings
from leaderboard.report.tables import Section, View, views
from leaderboard.running.board import Board
from road_envs.config import ConfigError, build

KEPT = ".shown.json"
FORMAT = 1
MOST = 2000
"""Rows of a board that is kept; what is larger would take long to write and to read."""

PAGES = "leaderboard.report.site"
TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Shown:
    """Boards, the main one first; what their numbers say; and the key."""

    views: tuple[View, ...]
    findings: tuple[str, ...]
    key: str


@dataclass(frozen=True)
class _KeptView:
    board: BoardName
    sections: tuple[Section, ...]


@dataclass(frozen=True)
class _Kept:
    format: int
    key: str
    views: tuple[_KeptView, ...]
    findings: tuple[str, ...]


def shown(board: Board, out: Path | None = None) -> Shown:
    """What a board shows; kept under `out`, and taken from there if nothing has changed."""
    key = key_of(board)
    if out is not None and (kept := _kept(out / KEPT, key)) is not None:
        return kept
    made = tuple(views(board))
    found = Shown(made, tuple(findings(made)), key)
    if out is not None and sum(map(len, board.results.values())) <= MOST:
        store.write_text(out / KEPT, store.sealed(_plain(found)))
    return found


def key_of(board: Board) -> str:
    """Digest of all that decides what is shown of a board."""
    total = hashlib.sha256()
    for part in _parts(board):
        total.update(f"{part}\n".encode())
    return total.hexdigest()


def _parts(board: Board) -> Iterator[str]:
    yield f"{version()} {_code()}"
    for task in board.tasks:
        yield repr(task)
        for result in board.results[task.name]:
            card = board.card(result)
            yield json.dumps(
                [
                    store.checksum(result),
                    result.estimator,
                    result.failure,
                    board.why_stale(task, result),
                    card and [card.identity, card.failure, card.mark],
                ]
            )


@cache
def _code() -> str:
    templates = [path for path in TEMPLATES.rglob("*") if path.is_file()]
    return digest([*closure(PAGES), *templates])


def _plain(made: Shown) -> dict[str, Any]:
    rows = [
        {"board": view.board, "sections": [dataclasses.asdict(s) for s in view.sections]}
        for view in made.views
    ]
    return {"format": FORMAT, "key": made.key, "views": rows, "findings": list(made.findings)}


def _kept(path: Path, key: str) -> Shown | None:
    try:
        data, _ = store.unsealed(path, FORMAT)
        if data.get("key") != key:
            return None
        kept = build(_Kept, data, str(path))
    except ConfigError:  # none there, or a damaged one
        return None
    found = tuple(View(view.board, BOARDS[view.board], view.sections) for view in kept.views)
    return Shown(found, kept.findings, key)
