"""Rules of a results repository: its tasks and how entries are run on them.

tasks: [new_road, seasons/autumn/new_road_0a1b2c3d.yaml]
roads: 6        test drives per condition on random roads; all if it is missing
seeds: 3        training seeds
"""

import dataclasses
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from leaderboard.entries.entry import Entry
from leaderboard.evaluation.tasks import Task, load_task
from leaderboard.metrics.bootstrap import MIN_ROADS
from leaderboard.report.notes import PUBLIC_ROADS, SEALED_ROADS
from leaderboard.running.board import RunRequest
from leaderboard.sandbox.limits import Limits
from leaderboard.submission.hidden_seeds import COMMITMENT, check_revealed
from road_envs.core.config import ConfigError, Count, Settings, build, read_yaml

RULES = "rules.yaml"
_BETWEEN_PATHS = re.compile(r"""[\s,'"[\]]+""", re.ASCII)
_PATH = re.compile(r"[\w./-]+")


@dataclass(frozen=True, kw_only=True)
class Rules(Settings):
    """Names of shipped tasks or paths of YAML files, test drives per condition, training seeds."""

    tasks: Annotated[tuple[str, ...], Field(min_length=1)] = ("new_road",)
    roads: Annotated[int, Field(ge=MIN_ROADS)] | None = None  # with fewer, nothing is ranked
    seeds: Annotated[Count, Field(le=100)] = 3


def load_rules(path: Path | None) -> tuple[Rules, list[Task]]:
    """Read rules and their tasks; paths are relative to the file. Without a file, those are the
    default ones. Raises ConfigError, also for a season of other roads than were committed to, and
    for one behind a link or whose path the text does not spell out.
    """
    if path is None:
        return Rules(), [load_task(name) for name in Rules.tasks]
    rules = build(Rules, read_yaml(path), str(path))
    sealed, public = list[Task](), list[Task]()
    root = path.parent.resolve()
    # as bytes: a carriage return ends a line for YAML alone, not for the script
    words = _BETWEEN_PATHS.split(re.sub("#.*", "", path.read_bytes().decode()))
    for name in rules.tasks:
        file = path.parent / name
        if not os.path.isfile(file):  # a name may be too long for a path
            public.append(load_task(name))
            continue
        # git knows its age by this path alone
        if file.resolve().as_posix() != f"{root.as_posix()}/{name}":
            raise ConfigError(f"{path}: {name}: a path here has neither links nor . and ..")
        # ci/verify.sh finds the seasons by these words
        if name not in words or not _PATH.fullmatch(name):
            raise ConfigError(f"{path}: {name}: a path is one word of letters, digits and . _ - /")
        note, task = check_revealed(file, path.parent), load_task(file)
        is_sealed = (file.parent / COMMITMENT).is_file()
        seal = f"{SEALED_ROADS} {note}" if is_sealed else PUBLIC_ROADS
        note = f"{task.note} {seal}".strip()
        (sealed if is_sealed else public).append(dataclasses.replace(task, note=note))
    return rules, [*sealed, *public]  # a site begins with the first


def make_run_request(
    rules: Rules, tasks: Sequence[Task], entries: Sequence[Entry], limits: Limits
) -> RunRequest:
    """Request to run `entries` on the tasks by these rules, with probes."""
    seeds = tuple(range(1, rules.seeds + 1))
    return RunRequest(tasks, entries, seeds, rules.roads, limits=limits, probes=True)
