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

from leaderboard.conformance.probes import CheckResult, count_passed
from leaderboard.evaluation import store
from leaderboard.evaluation.entry import BUILTIN, Entry, EntryError
from leaderboard.evaluation.provenance import package_version
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs._code_digest import closure, digest
from road_envs.config import STRICT, ConfigError, build

FORMAT = 1
CHECKS_MODULE = "leaderboard.conformance.checks"
"""Everything that decides what is asked, and what is said, is imported from here on."""


@dataclass(frozen=True, kw_only=True)
class EstimatorCard:
    """What the probes said of an estimator, on a drive in words; or, in a sentence, why nothing."""

    __pydantic_config__ = STRICT

    identity: str
    estimator: str
    settings: dict[str, Any]
    code: str
    drive: str
    probes: tuple[CheckResult, ...] = ()
    failure: str | None = None
    format: int = FORMAT

    @property
    def passed_count(self) -> str:
        """Those passed of those that apply, such as "5/5"."""
        return count_passed(self.probes)


def card_identity(estimator: str, settings: Mapping[str, Any], code: str) -> str:
    """Digest of all that a card depends on."""
    known = [FORMAT, package_version(), _checks_version(), estimator, dict(settings), code]
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()[:32]


def find_card(
    out: Path, estimator: str, settings: Mapping[str, Any], code: str
) -> EstimatorCard | None:
    """The card of an estimator as it is now, if it was examined and the card can be read."""
    known = card_identity(estimator, settings, code)
    try:
        data, _ = store.read_checked_json(_path(out, known), FORMAT)
        card = build(EstimatorCard, data, "card")
    except ConfigError:
        return None
    return card if card.identity == known else None


def probe_entries(
    entries: Iterable[Entry],
    out: Path,
    limits: Limits,
    report: Callable[[str], None] = lambda text: None,
) -> int:
    """Examine every entry that has no card yet, in processes of its own; how many there were."""
    wanted = {
        card_identity(e.name, e.settings, e.code): e
        for e in entries
        if e.reference != BUILTIN
        and e.failure is None
        and find_card(out, e.name, e.settings, e.code) is None
    }
    if not wanted:
        return 0
    hidden = [out / "results", out / "jobs", out / "cards"]
    for folder in hidden:
        folder.mkdir(parents=True, exist_ok=True)
    with SandboxClient(limits, hidden) as sandbox:
        for known, entry in wanted.items():
            report(f"probing {entry.name}")
            store.write_durable(_path(out, known), _text(_probe_entry(known, entry, sandbox)))
    return len(wanted)


def _probe_entry(known: str, entry: Entry, sandbox: SandboxClient) -> EstimatorCard:
    from leaderboard.conformance.checks import check_drives, probe_entry

    nothing = EstimatorCard(
        identity=known,
        estimator=entry.name,
        settings=entry.settings,
        code=entry.code,
        drive=check_drives().message,
    )
    try:
        return dataclasses.replace(nothing, probes=tuple(probe_entry(entry, sandbox)))
    except EntryError as error:
        return dataclasses.replace(nothing, failure=str(error))


def _text(card: EstimatorCard) -> str:
    return store.with_checksum(dataclasses.asdict(card))


def _path(out: Path, known: str) -> Path:
    return out / "cards" / f"{known}.json"


@cache
def _checks_version() -> str:
    return digest(closure(CHECKS_MODULE))
