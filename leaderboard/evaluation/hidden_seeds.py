"""Hidden test sets: bound to a hash before anyone has driven them, shown when all have entered.

    seeds       the first 6 bytes of sha256(salt, task, digest of the public task, k), k = 0, 1, ...
    commitment  scrypt(salt; all that stands in the season's file)

The commitment is published first. It fixes the seeds, the tasks and how many roads are drawn, and
says nothing about them; whoever is told the salt afterwards can draw the same seeds and compare.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.tasks import SEED_STRIDE, Task, load_task
from road_envs._atomic_io import write_text
from road_envs.config import STRICT, ConfigError, build, find, read_yaml

COMMITMENT = "commitment.json"
MIN_SALT_LENGTH = 12
"""Characters of a salt: a shorter one could be found by trying."""


@dataclass(frozen=True, kw_only=True)
class HiddenSeeds:
    """What is published beforehand: digests of the public tasks by name, and the commitment."""

    __pydantic_config__ = STRICT

    format: int = 1
    package_version: str
    tasks: dict[str, str]
    roads: dict[str, int]
    """How many seeds each task draws."""
    commitment: str = ""


def commit(salt: str, tasks: Sequence[Task]) -> HiddenSeeds:
    """The season of a secret `salt`. Raises ConfigError if it is too short to stay secret."""
    if len(salt) < MIN_SALT_LENGTH:
        raise ConfigError(f"a salt has at least {MIN_SALT_LENGTH} characters, got {len(salt)}")
    hidden = HiddenSeeds(
        package_version=package_version(),
        tasks={task.name: task.digest for task in tasks},
        roads={task.name: len(task.test.seeds) for task in tasks},
    )
    return dataclasses.replace(hidden, commitment=_commitment(salt, hidden))


def save(hidden: HiddenSeeds, folder: Path) -> Path:
    """Write what is to be published. Raises ConfigError if another season stands there."""
    path = folder / COMMITMENT
    if path.exists() and load(folder) != hidden:
        raise ConfigError(f"{path}: another season stands here; choose an empty folder")
    write_text(path, json.dumps(dataclasses.asdict(hidden), indent=1) + "\n")
    return path


def load(folder: Path) -> HiddenSeeds:
    """The season that was published. Raises ConfigError."""
    path = folder / COMMITMENT
    try:
        return build(HiddenSeeds, json.loads(path.read_text(encoding="utf-8")), str(path))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except json.JSONDecodeError as error:
        raise ConfigError(f"{path}: damaged, not valid JSON: {error}") from None


def reveal(salt: str, folder: Path) -> list[Path]:
    """Check `salt` against the season in `folder`, and write its tasks there as YAML.

    Raises ConfigError if the salt is another one, or the public tasks are no longer those.
    """
    hidden = load(folder)
    if _commitment(salt, hidden) != hidden.commitment:
        raise ConfigError(f"{folder / COMMITMENT}: this salt does not give the commitment")
    written = []
    for name, digest in hidden.tasks.items():
        task = load_task(name)
        if task.digest != digest:
            raise ConfigError(f"{name}: the public task has changed since the season was drawn")
        data: dict[str, Any] = read_yaml(find("tasks", name))
        data["name"] = f"{name}_{hidden.commitment[:8]}"
        data["title"] = f"{task.title}; season {hidden.commitment[:8]}"
        data["test"] = {**data["test"], "seeds": seeds(salt, task, hidden.roads[name])}
        data["test"].pop("number", None)
        path = folder / f"{data['name']}.yaml"
        write_text(path, yaml.safe_dump(data, sort_keys=False, allow_unicode=True))
        load_task(path)
        written.append(path)
    return written


def seeds(salt: str, task: Task, count: int) -> list[int]:
    """The `count` hidden seeds of a task, none of them a public one."""
    public = task.training.all_seeds | task.test.all_seeds
    found: list[int] = []
    k = 0
    while len(found) < count:
        text = "\0".join([salt, task.name, task.digest, str(k)])
        seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "big")
        roads = {seed + i * SEED_STRIDE for i in range(len(task.test.roads))}
        if not roads & public:
            found.append(seed)
        k += 1
    return found


def _commitment(salt: str, hidden: HiddenSeeds) -> str:
    """A slow hash, so that a guessed salt takes a while to try."""
    said = {**dataclasses.asdict(hidden), "commitment": ""}
    text = json.dumps(said, sort_keys=True)
    return hashlib.scrypt(salt.encode(), salt=text.encode(), n=2**14, r=8, p=1, dklen=32).hex()
