"""Files written whole or not at all: a reader finds the old content or the new, never a half."""

import fcntl
import itertools
import os
import platform
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PARTIAL_SUFFIX = ".partial"
"""Ends the name of a file that is still being written."""

TEMP_PREFIX = "roadrecon-scratch-"
"""Begins the name of a temporary folder."""

_counter = itertools.count()


@contextmanager
def atomic_write(path: str | Path, *, durable: bool = False) -> Iterator[Path]:
    """A name beside `path` to write to, which takes the place of `path` once all is written.

    If anything goes wrong, nothing is left of it and `path` stays as it was. A `durable` file has
    reached the disk before it takes its place, so that it outlives a loss of power.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{_writer_id()}-{next(_counter)}{PARTIAL_SUFFIX}")
    try:
        yield partial
        if durable:
            _fsync(partial)
        os.replace(partial, path)
        if durable:
            _fsync(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str, *, durable: bool = False) -> None:
    """Write a text file whole or not at all; folders that are missing are made."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, durable=durable) as partial:
        partial.write_text(text, encoding="utf-8")


def remove_stale_partials(folder: Path) -> None:
    """Remove what writers of this machine left behind in `folder` when they were killed."""
    mine, _, _ = _writer_id().partition("-")
    for partial in folder.rglob(f".*{PARTIAL_SUFFIX}"):
        host, _, rest = partial.name.removesuffix(PARTIAL_SUFFIX).rpartition(".")[2].partition("-")
        pid = rest.partition("-")[0]
        if host == mine and pid.isdigit() and not _is_alive(int(pid)):
            partial.unlink(missing_ok=True)


def _writer_id() -> str:
    """Machine, process and thread, none of which two writers share at one time."""
    host = "".join(c for c in platform.node() if c.isalnum()) or "localhost"
    return f"{host}-{os.getpid()}-{threading.get_ident()}"


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _fsync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


LOCK_FILE = ".owner"
"""Lies in a temporary folder; who made the folder holds a lock on it for as long as it lives."""


class TempFolder:
    """A temporary folder of one process, removed by `close` or a `with` statement.

    If the process is killed, the next `remove_stale_temp` removes it: the lock that it held is then
    free, whoever may have its number meanwhile.
    """

    def __init__(self):
        self.path = Path(tempfile.mkdtemp(prefix=TEMP_PREFIX))
        self._lock_handle: int | None = os.open(
            self.path / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o600
        )
        _try_lock(self._lock_handle)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the folder with all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock_handle is not None:
            os.close(self._lock_handle)
        self._lock_handle = None


def remove_stale_temp() -> list[Path]:
    """Remove the temporary folders of this user whose owners are dead; returns which."""
    return [
        folder
        for folder in Path(tempfile.gettempdir()).glob(f"{TEMP_PREFIX}*")
        if folder.is_dir() and _remove_if_orphaned(folder)
    ]


def _remove_if_orphaned(folder: Path) -> bool:
    """Remove a temporary folder if nobody holds its lock. One without a lock is left alone."""
    try:
        owner = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        if os.fstat(owner).st_uid != os.getuid() or not _try_lock(owner):
            return False
        shutil.rmtree(folder, ignore_errors=True)
        return True
    finally:
        os.close(owner)


def _try_lock(handle: int) -> bool:
    """Take the lock of an open file; False if another process has it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
