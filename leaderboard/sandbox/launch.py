"""Start of a guest, of an estimator or a policy, and of a process that runs jobs.

What it sees, its environment, its container. All follow one protocol (`worker`, `messages`).
"""

import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

from leaderboard.entries.entry import EntryError
from leaderboard.sandbox import bubblewrap, processes, worker
from leaderboard.sandbox.guest import Guest, MachineError
from leaderboard.sandbox.limits import GIB, SET_FOR_ALL, UNLIMITED, Limits, guest_environment
from road_envs.core.code_digest import cache_home
from road_envs.kernels import _numba

OPEN_FILES = 256  # of a process: what pipes and sockets hold counts as no memory
_T = TypeVar("_T")


def start_guest(
    handler: str,
    home: Path,
    limits: Limits,
    *,
    isolated: bool,
    code: Path | None = None,
    libraries: Sequence[str] = (),
) -> Guest:
    """Start a guest with the module `handler` (see `worker.Setup`). Raises EntryError.

    Its working folder is the new folder `home` or, `isolated` by bubblewrap, one in memory. `code`
    is the folder with the code from outside: such a guest serves one child and cannot change the
    kernel cache of this user. Any other has the kernel cache of this user.
    """
    home.mkdir()
    cache = cache_home()
    kernels = cache / _numba.CACHE.name
    has_cache = kernels.is_dir()
    read_only: dict[Path, Path] = {}
    writable: dict[Path, Path] = {}
    seen, shared = code, cache  # the paths of both inside
    if isolated and code is not None:
        seen, shared = bubblewrap.ENTRY, bubblewrap.SHARED_CACHE
        needed = [kernels, *cache.glob("*.json")] if has_cache else []
        read_only = {code: seen} | {path: shared / path.name for path in needed}
    elif isolated and has_cache:
        writable[cache] = bubblewrap.HOME / cache.name
    setup = worker.Setup(
        handler=handler,
        threads=4 * limits.processes + 64 if isolated and code is not None else 0,
        folder=None if seen is None else str(seen),
        user=bubblewrap.guest_user() if isolated and code is not None else None,
        serves_many=code is None,
        libraries=tuple(libraries),
        cache=(str(shared), _numba.CACHE.name) if has_cache and code is not None else None,
    )
    words = _words(setup)
    inside = bubblewrap.HOME if isolated else home
    environment = guest_environment(inside, whole_path=not isolated)
    own_cache = isolated or code is not None
    environment["XDG_CACHE_HOME"] = str(inside if own_cache else cache.parent)

    def start() -> Guest:
        if not isolated:
            return Guest(words, environment, home)
        with bubblewrap.command(
            words, environment, limits, user=setup.user, from_outside=code is not None,
            read_only=read_only, writable=writable,
        ) as (line, handles):  # fmt: skip
            guest = Guest(line, environment, home, handles)
        guest.counted = bubblewrap.IN_MEMORY
        return guest

    guest = twice(start)
    values = {
        "RLIMIT_CORE": 0,
        "RLIMIT_NOFILE": OPEN_FILES,
        "RLIMIT_FSIZE": int(limits.file * GIB),
        "RLIMIT_DATA": int(limits.memory * GIB),  # reserved but unused memory does not count
        "RLIMIT_CPU": int(limits.seconds * max(1, os.cpu_count() or 1)) + 60,
    }
    # of all its processes: in a user namespace an entry can make those above it work for it
    for process in processes.tree(guest.pid):
        processes.set_limits(process.pid, values)
    return guest


def start_host_process(handler: str, home: Path, folder: Path) -> Guest:
    """Start a process of this package with the module `handler`, which is given the `folder`.

    It has the rights, the environment and the modules of this process, and no limits. Raises
    EntryError.
    """
    home.mkdir()
    known = guest_environment(home, whole_path=True)
    environment = known | os.environ | {name: known[name] for name in SET_FOR_ALL}
    setup = worker.Setup(handler=handler, folder=str(folder.absolute()), serves_many=True)
    guest = twice(lambda: Guest(_words(setup), environment, home))
    guest.start_run(UNLIMITED)
    return guest


def twice(run: Callable[[], _T]) -> _T:
    """Return what `run` does, at a second attempt if a guest fails: something else may have ended
    it. Raises EntryError, and the first MachineError.
    """
    try:
        return run()
    except MachineError:
        raise
    except EntryError:
        return run()


def _words(setup: worker.Setup) -> list[str]:
    return [sys.executable, "-P", "-s", "-m", worker.__name__, json.dumps(asdict(setup))]
