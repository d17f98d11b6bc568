"""Estimator cards: the probe results of each estimator, stored like evaluation results.

    <out>/cards/<identity>.json

The identity is the digest of the estimator (name, settings, code, weights, imports) and of this
package with its configurations, by which the probes drive, so a card is never modified.
"""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leaderboard.conformance.checks import check_drives, probe_entry
from leaderboard.conformance.probes import CheckResult
from leaderboard.entries.entry import BUILTIN, Entry, EntryError
from leaderboard.evaluation.provenance import package_code
from leaderboard.evaluation.results import Result
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs.core.artifacts import Kind
from road_envs.core.config import Settings, build

CARD = Kind("card", 1, ("leaderboard.conformance.checks",))


@dataclass(frozen=True, kw_only=True)
class EstimatorCard(Settings):
    """Probe results of an estimator on the described `drive`, or the `failure` of the probes."""

    identity: str
    estimator: str
    settings: dict[str, Any]
    code: str
    drive: str
    probes: tuple[CheckResult, ...] = ()
    failure: str | None = None


def card_identity(of: Entry | Result) -> str:
    """Return the digest of all inputs of a card: entries by others may build on all of ours."""
    name = of.estimator if isinstance(of, Result) else of.name
    imported = of.environment.get("imports", "") if isinstance(of, Result) else of.imported
    return CARD.identity(name, of.settings, of.code, imported, package_code())


def find_card(out: Path, identity: str) -> EstimatorCard | None:
    """Return the card of that identity; None if it is missing or damaged."""
    more, path = {"identity": identity}, _card_path(out, identity)
    return CARD.find(path, identity, lambda x: build(EstimatorCard, x | more, "card"))


def probe_entries(
    entries: Iterable[Entry],
    out: Path,
    limits: Limits,
    report: Callable[[str], None] = lambda text: None,
) -> int:
    """Probe entries without a card or whose probes could not run; return the number of cards."""
    missing = {
        identity: e
        for e in entries
        if e.reference != BUILTIN
        and e.failure is None
        and ((card := find_card(out, identity := card_identity(e))) is None or card.failure)
    }
    if not missing:
        return 0
    with SandboxClient(limits) as sandbox:
        for identity, entry in missing.items():
            report(f"probing {entry.name}")
            card = EstimatorCard(
                identity=identity, estimator=entry.name, settings=entry.settings, code=entry.code,
                drive=check_drives().description,
            )  # fmt: skip
            try:
                card = dataclasses.replace(card, probes=tuple(probe_entry(entry, sandbox)))
            except EntryError as error:
                card = dataclasses.replace(card, failure=str(error))
            content = dataclasses.asdict(card)
            CARD.write(_card_path(out, identity), content, content.pop("identity"))
    return len(missing)


def _card_path(out: Path, identity: str) -> Path:
    """File of the card of that identity in a folder of results."""
    return out / "cards" / f"{identity}.json"
