"""Cards of estimators: what the probes say of each, kept like results.

    <out>/cards/<identity>.json

The identity is the digest of the estimator, by name, settings and code with its weights, and of the
code that drives the sample and puts the questions. So a card never has to be changed; one that is
damaged is as good as none.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from leaderboard.conformance.probes import Probe, mark
from leaderboard.evaluation import store
from leaderboard.evaluation.code_version import closure, digest
from leaderboard.evaluation.entry import JUDGES_OWN, Entry, EntryError
from leaderboard.evaluation.provenance import version
from leaderboard.sandbox.client import Host
from leaderboard.sandbox.limits import Limits
from road_envs.config import STRICT, ConfigError, build

FORMAT = 1
EXAMINER = "leaderboard.conformance.checks"
"""Everything that decides what is asked, and what is said, is imported from here on."""


@dataclass(frozen=True, kw_only=True)
class Card:
    """What the probes said of an estimator, on a drive in words; or, in a sentence, why nothing."""

    __pydantic_config__ = STRICT

    identity: str
    estimator: str
    settings: dict[str, Any]
    code: str
    drive: str
    probes: tuple[Probe, ...] = ()
    failure: str | None = None
    format: int = FORMAT

    @property
    def mark(self) -> str:
        """Those passed of those that apply, such as "5/5"."""
        return mark(self.probes)


def identity(estimator: str, settings: Mapping[str, Any], code: str) -> str:
    """Digest of all that a card depends on."""
    known = [FORMAT, version(), _examiner(), estimator, dict(settings), code]
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()[:32]


def find(out: Path, estimator: str, settings: Mapping[str, Any], code: str) -> Card | None:
    """The card of an estimator as it is now, if it was examined and the card can be read."""
    known = identity(estimator, settings, code)
    try:
        data, _ = store.unsealed(_path(out, known), FORMAT)
        card = build(Card, data, "card")
    except ConfigError:
        return None
    return card if card.identity == known else None


def examine_all(
    entries: Iterable[Entry],
    out: Path,
    limits: Limits,
    report: Callable[[str], None] = lambda text: None,
) -> int:
    """Examine every entry that has no card yet, in processes of its own; how many there were."""
    wanted = {
        identity(e.name, e.settings, e.code): e
        for e in entries
        if e.reference != JUDGES_OWN
        and e.failure is None
        and find(out, e.name, e.settings, e.code) is None
    }
    if not wanted:
        return 0
    hidden = [out / "results", out / "jobs", out / "cards"]
    for folder in hidden:
        folder.mkdir(parents=True, exist_ok=True)
    with Host(limits, hidden) as host:
        for known, entry in wanted.items():
            report(f"probing {entry.name}")
            store.write(_path(out, known), _text(_examined(known, entry, host)))
    return len(wanted)


def _examined(known: str, entry: Entry, host: Host) -> Card:
    from leaderboard.conformance.checks import probe_entry, sample

    nothing = Card(
        identity=known,
        estimator=entry.name,
        settings=entry.settings,
        code=entry.code,
        drive=sample().said,
    )
    try:
        return dataclasses.replace(nothing, probes=tuple(probe_entry(entry, host)))
    except EntryError as error:
        return dataclasses.replace(nothing, failure=str(error))


def _text(card: Card) -> str:
    return store.sealed(dataclasses.asdict(card))


def _path(out: Path, known: str) -> Path:
    return out / "cards" / f"{known}.json"


@cache
def _examiner() -> str:
    return digest(closure(EXAMINER))
