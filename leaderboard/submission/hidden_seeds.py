"""Hidden test sets by commitment: a hash is published first, the seeds after all submissions.

    key         scrypt(salt; commitment, task, digest of the public task)
    seeds       the first 62 bits of sha256(key, k), k = 0, 1, ...
    commitment  scrypt(salt; all other fields of the published file)

A record tells its seed to who tries them all, as its first sample is noise alone, so there are too
many; and its seed tells a salt that can be guessed, so each guess takes a slow hash. The commitment
fixes seeds, tasks and number of roads without disclosing the seeds. Once the salt is published,
anyone can draw the same seeds and compare.
"""

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import yaml

from leaderboard.evaluation.drive_set import SEED_STRIDE
from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.tasks import Task, load_task
from leaderboard.evaluation.test_data import check_plants
from leaderboard.shared_surfaces import share_a_surface
from road_envs.core.atomic_io import atomic_write, write_text
from road_envs.core.config import ConfigError, Settings, build, find, read_yaml
from road_envs.core.reading import parsing, regular

COMMITMENT, SALT = "commitment.json", "salt.txt"
_AS_GIVEN = ("utf-8", "surrogateescape")  # a salt may be any bytes
# characters and bytes of a salt: a shorter one could be found by brute force, and scrypt takes a
# longer one for its digest, which would be a second salt with other seeds
_SALT_LENGTHS = range(12, 65)

SEEDS_ALONE = (
    "Only the seeds are known to be those of before the entries: roads, cars and speeds are of a "
    "task that this package does not have."
)

KNOWN_ROADS = (
    "No seed varies the surfaces of its roads: an entry can draw them instead of estimating them, "
    "and its rank then says nothing."
)


@dataclass(frozen=True, kw_only=True)
class _HiddenSeeds(Settings):
    """The published part of a hidden test set: digests of the public tasks, and the commitment."""

    format: Literal[2] = 2
    package_version: str
    tasks: dict[str, str]
    roads: dict[str, int]  # number of seeds by task
    commitment: str = ""


def commit(salt: str, tasks: Sequence[Task]) -> _HiddenSeeds:
    """Return the hidden test set of a secret `salt`, after a trial of revealing it. Raises
    ConfigError for a short salt and for a task that could not be revealed, or driven here.
    """
    hidden = _HiddenSeeds(
        package_version=package_version(),
        tasks={task.name: task.digest for task in tasks},
        roads={task.name: len(task.test.seeds) for task in tasks},
    )
    hidden = dataclasses.replace(hidden, commitment=_commitment(salt, hidden))
    for name in hidden.tasks:
        trial = build(Task, _hidden_task(salt, hidden, name), f"{name}: it cannot have a season")
        check_plants(trial)  # whose hidden drives are not kept
    return hidden


def save(hidden: _HiddenSeeds, folder: Path) -> Path:
    """Write the file to publish. Raises ConfigError if the folder holds another hidden test set."""
    path = folder / COMMITMENT
    if path.exists() and load(folder) != hidden:
        raise ConfigError(f"{path} is of another hidden test set; choose an empty folder")
    write_text(path, json.dumps(dataclasses.asdict(hidden), indent=1) + "\n")
    return path


def load(folder: Path) -> _HiddenSeeds:
    """Return the published hidden test set of a folder. Raises ConfigError."""
    path = folder / COMMITMENT
    with parsing(path, ConfigError, "damaged, not valid JSON"):
        data = json.loads(regular(path).read_text(encoding="utf-8"))
    return build(_HiddenSeeds, data, str(path))


def reveal(salt: str, folder: Path) -> list[Path]:
    """Verify `salt` against the commitment in `folder`; write the tasks there as YAML, and itself.
    Raises ConfigError if the salt does not match or the public tasks have changed.
    """
    hidden = load(folder)
    if _commitment(salt, hidden) != hidden.commitment:
        raise ConfigError(f"{folder / COMMITMENT}: the salt does not match the commitment")
    tasks = [_hidden_task(salt, hidden, name) for name in hidden.tasks]
    written = [folder / f"{data['name']}.yaml" for data in tasks]
    for path, data in zip(written, tasks, strict=True):
        write_text(path, yaml.safe_dump(data, sort_keys=False, allow_unicode=True))
        load_task(path)
    with atomic_write(folder / SALT) as partial:
        partial.write_bytes(salt.encode(*_AS_GIVEN))
    return written


def check_revealed(path: Path, root: Path) -> str:
    """Return a note on the task `path` if only its seeds are fixed by the commitment beside it, as
    by its word the public task was another one in its package, or if they vary no surface. Raises
    ConfigError if it is not the commitment of its roads, or if the one that its name has stands in
    a folder above, up to `root`.
    """
    folder = path.parent
    for above in (x for x in folder.parents if x.is_relative_to(root)):
        other = above / COMMITMENT
        if other.is_file() and path.stem.endswith(f"_{load(above).commitment[:8]}"):
            raise ConfigError(f"{path}: a season stands beside its commitment, {other}")
    if not (folder / COMMITMENT).is_file():
        return ""
    hidden = load(folder)
    with parsing(folder / SALT, ConfigError, "damaged"):
        salt = regular(folder / SALT).read_bytes().decode(*_AS_GIVEN)
    if _commitment(salt, hidden) != hidden.commitment:
        raise ConfigError(f"{folder / SALT}: the salt does not match the commitment")
    name = {f"{x}_{hidden.commitment[:8]}": x for x in hidden.tasks}.get(path.stem)
    public = None if name is None else load_task(name)
    if public is None or not _is_drawn(path, salt, hidden, public):
        raise ConfigError(f"{path}: it is no task of the commitment in {folder / COMMITMENT}")
    roads = public.test.roads
    is_known, is_other = share_a_surface(roads, roads), public.digest != hidden.tasks[public.name]
    return " ".join(filter(None, (SEEDS_ALONE * is_other, KNOWN_ROADS * is_known)))


def _is_drawn(path: Path, salt: str, hidden: _HiddenSeeds, public: Task) -> bool:
    """Whether the file `path` is the `public` task on the roads of the salt."""
    name, found = public.name, load_task(path)
    if hidden.package_version == package_version():
        return bool(read_yaml(path) == _hidden_task(salt, hidden, name))
    if public.digest != hidden.tasks[name]:
        seeds = list(found.test.seeds)
        drawn = _seeds(salt, hidden, public, hidden.tasks[name], len(seeds))
        return seeds == drawn and len(seeds) == hidden.roads.get(name)
    # another package may describe it in other words
    today = build(Task, _hidden_task(salt, hidden, name), name)
    ranks = attrgetter("digest", "board", "test.families", "claimed_level_error")
    return bool(ranks(found) == ranks(today))


def _hidden_task(salt: str, hidden: _HiddenSeeds, name: str) -> dict[str, Any]:
    """Return the YAML object of a task with its hidden seeds, on all of whose roads it is driven; a
    design, which assigns the public drives to conditions, is repeated over the hidden ones. Raises
    ConfigError if the public task has changed.
    """
    task = load_task(name)
    if task.digest != hidden.tasks[name]:
        raise ConfigError(f"{name}: the public task has changed since the commitment was made")
    data: dict[str, Any] = read_yaml(find("tasks", name))
    count = min(hidden.roads.get(name, 0), len(task.test.seeds))  # a published file may say any
    test = {**data["test"], "seeds": _seeds(salt, hidden, task, task.digest, count)}
    test.pop("number", None)
    if task.test.design:
        block = len(task.test.roads_and_seeds)
        repeats = len(task.test.seeds) * len(task.test.roads) // block
        test["number"] = block * repeats
        test["design"] = [
            [block * k + index for k in range(repeats) for index in indices]
            for indices in task.test.design
        ]
    season = hidden.commitment[:8]
    named = {"name": f"{task.name}_{season}", "title": f"{task.title}; season {season}"}
    return {**data, **named, "test": test}


def _seeds(salt: str, hidden: _HiddenSeeds, task: Task, digest: str, count: int) -> list[int]:
    """Return `count` hidden seeds of a task that had this digest; none is public today."""
    public = task.training.all_seeds | task.test.all_seeds
    text = "\0".join([hidden.commitment, task.name, digest])
    key = _slow_hash(salt.encode(*_AS_GIVEN), text.encode())
    words = (hashlib.sha256(key + str(k).encode()).digest() for k in itertools.count())
    seeds = (int.from_bytes(word[:8], "big") >> 2 for word in words)
    of_roads = [i * SEED_STRIDE for i in range(len(task.test.roads))]
    drawn = (seed for seed in seeds if public.isdisjoint(seed + offset for offset in of_roads))
    return list(itertools.islice(drawn, count))


def _commitment(salt: str, hidden: _HiddenSeeds) -> str:
    """Return the commitment to a salt, by a slow hash so that guessing the salt is expensive."""
    word = salt.encode(*_AS_GIVEN)
    if not {len(salt), len(word)} <= {*_SALT_LENGTHS} or 0 in word:  # it ignores zeros at the end
        raise ConfigError(
            f"the salt must have at least {_SALT_LENGTHS[0]} characters and at most "
            f"{_SALT_LENGTHS[-1]} bytes, none of them 0; got {len(salt)} characters"
        )
    fields = {**dataclasses.asdict(hidden), "commitment": ""}
    return _slow_hash(word, json.dumps(fields, sort_keys=True).encode()).hex()


def _slow_hash(word: bytes, salt: bytes) -> bytes:
    return hashlib.scrypt(word, salt=salt, n=2**14, r=8, p=1, dklen=32)
