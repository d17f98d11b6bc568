"""Finished rows of a comparison, one file each, so that an interrupted run continues.

A row is valid while the scenarios, the seeds, the estimators, the policy with its settings, the
code and the configurations are the same. Rows of policies of other packages are not kept, since
what they depend on is not known.
"""

import io
import json
import re
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.policies.comparison import PolicyResult
from leaderboard.policies.scenarios import Scenarios
from leaderboard.policies.timeline import Timeline
from road_envs import config
from road_envs._atomic_io import atomic_write
from road_envs._code_digest import closure, digest

MODULES = ("leaderboard.policies.comparison", "road_envs.policies", "estimators")
"""Modules whose code, with all that they import, a row depends on."""


@cache
def _code() -> str:
    sources = {path for module in MODULES for path in closure(module)}
    return digest([*sources, *(path for path in config.folder().rglob("*") if path.is_file())])


class RowStore:
    """Rows in `folder` for the `scenarios` on the roads of `seeds` and the `estimators`."""

    def __init__(
        self,
        folder: Path,
        scenarios: Scenarios,
        seeds: Iterable[int],
        estimators: Mapping[str, Any],
    ):
        self.folder = folder
        self._about = [asdict(scenarios), list(seeds), {n: repr(e) for n, e in estimators.items()}]

    def load(self, name: str, policy: object) -> PolicyResult | None:
        """Return the row of a policy; None if there is none, or none that is valid."""
        try:
            content = io.BytesIO(self._path(name).read_bytes())
            with np.load(content, allow_pickle=False) as stored:
                arrays = {key: stored[key] for key in stored.files}
            about = json.loads(str(arrays.pop("about")))
            if about["key"] != self._key(name, policy):
                return None
            groups: dict[str, dict[str, np.ndarray]] = {"metrics": {}, "errors": {}, "timeline": {}}
            for key, value in arrays.items():
                group, _, field = key.partition("/")
                groups[group][field] = value
            timeline = Timeline(**groups["timeline"]) if groups["timeline"] else None
            notes = tuple(map(str, about["notes"]))
            return PolicyResult(name, groups["metrics"], groups["errors"], None, notes, timeline)
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return None  # none there, or a damaged one: it is computed again

    def save(self, result: PolicyResult, policy: object) -> None:
        """Store a row, whole or not at all; a failed one is not stored."""
        if result.failure is not None:
            return
        about = {"key": self._key(result.policy, policy), "notes": list(result.notes)}
        timeline = result.timeline._asdict() if result.timeline is not None else {}
        groups = {"metrics": result.metrics, "errors": result.errors, "timeline": timeline}
        arrays: dict[str, Any] = {
            f"{group}/{name}": x for group, values in groups.items() for name, x in values.items()
        }
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(self._path(result.policy)) as partial, partial.open("wb") as file:
            np.savez(file, about=np.array(json.dumps(about)), **arrays)

    def _path(self, name: str) -> Path:
        return self.folder / f"{re.sub(r'[^a-zA-Z0-9._-]', '_', name)}.npz"

    def _key(self, name: str, policy: object) -> str:
        network = getattr(policy, "network", None)
        learned = sha256(network.to_bytes()).hexdigest() if network is not None else ""
        parts = [*self._about, name, repr(policy), learned, _code()]
        return sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()
