"""The guest: loads the libraries, then serves the requests of the host in a child process.

    python -P -s -m leaderboard.sandbox.worker SETUP

Requests come on standard input, replies go to what was standard output; whatever foreign code
prints goes to standard error. Of all guests (estimators, switching policies), and of the processes
that run jobs, only the handler of requests differs: `estimator_handler`, `policies.policy_handler`,
`running.jobs`. It loads foreign code in the child, after all privileges are dropped.
"""

import gc
import importlib
import json
import os
import signal
import stat
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

# what compiles kernels is imported after `_link_cache`
from leaderboard.sandbox import processes
from road_envs.core.config import Settings, build

SERVED = 64  # exit status of a child that has served its requests until the end
LONGEST_FAILURE = 10_000  # largest number of characters of a failure; the host shows fewer


@dataclass(frozen=True, kw_only=True)
class Setup(Settings):
    """Message that starts a guest.

    `handler` is the module whose `make_handler(folder)` makes the `messages.Handler`; `folder` has
    the code from outside, or the results of jobs; `user` is the user and group to become, None to
    stay, and `threads` the largest number of processes and threads, 0 for any; `serves_many` allows
    further children after the first, for which `libraries` are imported once; `cache` (folder of
    all files, name of that of today's kernels) is copied by links.
    """

    handler: str
    threads: int = 0
    folder: str | None = None
    user: int | None = None
    serves_many: bool = False
    libraries: tuple[str, ...] = ()
    cache: tuple[str, str] | None = None


def main() -> None:
    """Serve requests until the end of input."""
    processes.die_with_parent()
    processes.become_subreaper()
    replies = os.dup(1)
    os.dup2(2, 1)
    setup = build(Setup, json.loads(sys.argv[1]), "the setup of a guest")
    os.umask(0)  # the child may be another user
    if setup.cache is not None:
        _link_cache(Path(setup.cache[0]), setup.cache[1])
    importlib.import_module(setup.handler)
    for library in setup.libraries:
        with suppress(ImportError):  # what is not installed is left out
            importlib.import_module(library)
    gc.collect()
    gc.freeze()
    _reply(replies, {})
    while True:
        try:
            first = _read_request()
        except EOFError:
            return
        pid = os.fork()
        if pid == 0:
            _run_child(setup, replies, first)
        _, status = os.waitpid(pid, 0)
        code = os.waitstatus_to_exitcode(status)
        if code != SERVED or not setup.serves_many:
            os._exit(128 - code if code < 0 else code)


def _link_cache(source: Path, name: str) -> None:
    """Make a kernel cache in the working folder that begins with links to the files of another."""
    target = Path(os.environ["XDG_CACHE_HOME"]) / "road-recon"
    files = [path for path in source.glob("*") if path.is_file()]
    for path in [*files, *(source / name).rglob("*")]:
        link = target / path.relative_to(source)
        if path.is_dir():
            link.mkdir(parents=True, exist_ok=True)
        elif path.stat().st_mode & stat.S_IROTH:
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path)


def _read(size: int) -> bytes:
    """Return `size` bytes of the requests. Raises EOFError at the end of input."""
    data = bytearray()
    while len(data) < size:
        part = os.read(0, min(size - len(data), 1 << 20))
        if not part:
            raise EOFError
        data += part
    return bytes(data)


def _read_request() -> dict[str, Any]:
    """Return the JSON object of the next request. Raises EOFError at the end of input."""
    from leaderboard.sandbox import messages

    (size,) = messages.HEAD_SIZE.unpack(_read(messages.HEAD_SIZE.size))
    return json.loads(_read(size))


def _reply(handle: int, head: dict[str, Any], arrays: Sequence[Any] = ()) -> None:
    """Write a reply; one that cannot be encoded becomes a failure."""
    from leaderboard.sandbox import messages

    try:
        message = messages.encode(head, arrays, messages.MAX_HEAD)
    except (ValueError, TypeError, OverflowError) as error:
        message = messages.encode({"failure": f"cannot be reported: {error}"[:1000]})
    unsent = memoryview(message)
    while unsent:
        unsent = unsent[os.write(handle, unsent) :]


def _run_child(setup: Setup, replies: int, request: dict[str, Any]) -> NoReturn:
    """Serve the first `request` and those that follow in this process, then end it."""
    status = 1
    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL)
        processes.die_with_parent()
        if setup.threads:  # not before: outside, those of all processes of the user would count
            processes.set_limits(os.getpid(), {"RLIMIT_NPROC": setup.threads})
        if setup.user is not None:  # give up this one and its groups
            os.setgroups([])
            os.setgid(setup.user)
            os.setuid(setup.user)
        os.umask(0o022)
        handle = importlib.import_module(setup.handler).make_handler(setup.folder)
        while request["do"] != "end":
            _serve(handle, replies, request)
            request = _read_request()
        sys.stdout.flush()
        sys.stderr.flush()
        status = SERVED
    except BaseException as error:
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
    finally:
        os._exit(status)


def _serve(handle: Any, replies: int, request: dict[str, Any]) -> None:
    """Reply to a request, with a failure if the handler raises an error."""
    from leaderboard.entries.entry import EntryError, describe_error
    from leaderboard.sandbox import messages

    arrays = messages.decode_arrays(request, _read)
    try:
        answer, found = handle(request, arrays)
    except (Exception, SystemExit) as error:
        reason = str(error) if isinstance(error, EntryError) else describe_error(error)
        answer, found = {"failure": reason[:LONGEST_FAILURE]}, ()
    _reply(replies, answer, found)


if __name__ == "__main__":
    main()
