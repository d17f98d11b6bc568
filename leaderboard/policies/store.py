"""Finished rows of a comparison, one file each, so that an interrupted run continues.

A row is valid while the scenarios, the seeds, the estimators, the policy with its settings, the
code and the configurations are the same. Rows of policies of other packages are not kept, since
what they depend on is not known.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.policies.comparison import PolicyResult
from leaderboard.policies.scenarios import Scenarios
from leaderboard.policies.timeline import Timeline
from road_envs.core import config
from road_envs.core.artifacts import Kind
from road_envs.core.code_digest import digest

ROW = Kind("policy row", 1, ("leaderboard.policies.comparison", "road_envs.policies", "estimators"))


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
        configs = digest(path for path in config.folder().rglob("*") if path.is_file())
        learners = {name: repr(estimator) for name, estimator in estimators.items()}
        self._inputs = [asdict(scenarios), list(seeds), learners, configs]

    def load(self, name: str, policy: object) -> PolicyResult | None:
        """Return the row of a policy; None if there is none, or none that is valid."""

        def make(data: dict[str, Any]) -> PolicyResult:
            metrics, errors = (  # null is NaN
                {key: np.array(x, dtype=float) for key, x in data[group].items()}
                for group in ("metrics", "errors")
            )
            timeline = {key: np.array(x) for key, x in data["timeline"].items()}
            shown = Timeline(**timeline) if timeline else None
            return PolicyResult(name, metrics, errors, None, tuple(data["notes"]), shown)

        return ROW.find(self._path(name), self._identity(name, policy), make)

    def save(self, result: PolicyResult, policy: object) -> None:
        """Store a row, whole or not at all; a failed one is not stored."""
        if result.failure is not None:
            return
        timeline = result.timeline._asdict() if result.timeline is not None else {}
        groups = {"metrics": result.metrics, "errors": result.errors, "timeline": timeline}
        content = {
            "notes": list(result.notes),
            **{group: {n: x.tolist() for n, x in each.items()} for group, each in groups.items()},
        }
        ROW.write(self._path(result.policy), content, self._identity(result.policy, policy))

    def _path(self, name: str) -> Path:
        return self.folder / f"{re.sub(r'[^a-zA-Z0-9._-]', '_', name)}.json"

    def _identity(self, name: str, policy: object) -> str:
        network = getattr(policy, "network", None)
        learned = sha256(network.to_bytes()).hexdigest() if network is not None else ""
        return ROW.identity(*self._inputs, name, repr(policy), learned)
