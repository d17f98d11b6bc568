"""Atomic file writes: a reader sees the old content or the new one, never a partial file."""

import errno
import fcntl
import itertools
import os
import platform
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from road_envs.core.config import ConfigError

PARTIAL_SUFFIX = ".partial"  # suffix of a file that is still being written
TEMP_PREFIX = "roadrecon-scratch-"  # prefix of the name of a temporary folder
LOCK_FILE = ".owner"  # file in a temporary folder that its owner keeps locked while it runs
STALE_AGE = 86400.0  # time [s] after which a partial file is no longer being written

_counter = itertools.count()


@contextmanager
def atomic_write(path: str | Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which replaces `path` when the block ends.

    If the block raises, `path` is unchanged. A `durable` file is flushed to disk before, so that it
    survives a power failure. The error of a full disk names `path`: that of a copy its source.
    """
    path = Path(path)
    host = "".join(c for c in platform.node() if c.isalnum()) or "localhost"
    writer = f"{host}-{os.getpid()}-{threading.get_ident()}-{next(_counter)}"
    partial = path.with_name(f".{path.name}.{writer}{PARTIAL_SUFFIX}")
    try:
        yield partial
        if durable:
            _fsync(partial)
        os.replace(partial, path)
        if durable:
            _fsync(path.parent)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str, *, durable: bool = False) -> None:
    """Write a text file atomically, and create missing folders."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, durable=durable) as partial:
        partial.write_text(text, encoding="utf-8")


def copy_file(source: Path, target: Path) -> None:
    """Copy the content of a file atomically, and create missing folders."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(target) as partial:
        shutil.copyfile(source, partial)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside `path`, which gets that name when the block ends.

    If the block raises, the folder is removed. Raises ConfigError if `path` exists, and, where the
    file system has locks, while another process makes it.
    """
    partial = path.with_name(f".{path.name}{PARTIAL_SUFFIX}")
    lock = partial.with_suffix(f".lock{PARTIAL_SUFFIX}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with exclusive_lock(lock, 0.0) as is_alone:
        if not is_alone:
            raise ConfigError(f"{path}: another process makes it; wait, or give another folder")
        try:
            if path.exists():
                raise ConfigError(f"{path} exists; give a folder that does not")
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            yield partial
            partial.rename(path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
            lock.unlink(missing_ok=True)


def remove_stale_partials(folder: Path) -> None:
    """Remove partial files in `folder` that nobody has changed for STALE_AGE: of killed writers."""
    for partial in folder.rglob(f".*.*-*-*-*{PARTIAL_SUFFIX}"):
        with suppress(OSError):  # another process may remove it meanwhile
            if time.time() - partial.lstat().st_mtime > STALE_AGE:
                partial.unlink()


def _fsync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class TempFolder:
    """Temporary folder of one process, removed by `close` or by the `with` statement.

    That of a killed process, whose lock is free, is removed by the next `remove_stale_temp`.
    """

    def __init__(self):
        self.path = Path(tempfile.mkdtemp(prefix=TEMP_PREFIX))
        lock = os.open(self.path / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o600)
        self._lock_handle: int | None = lock
        _try_lock(lock)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock_handle is not None:
            os.close(self._lock_handle)
        self._lock_handle = None


def remove_stale_temp() -> list[Path]:
    """Remove this user's temporary folders whose owners have died, and return their paths."""
    folders = Path(tempfile.gettempdir()).glob(f"{TEMP_PREFIX}*")
    return [folder for folder in folders if folder.is_dir() and _remove_if_orphaned(folder)]


def _remove_if_orphaned(folder: Path) -> bool:
    """Remove a temporary folder if its lock is free; a folder without a lock file is kept."""
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


@contextmanager
def exclusive_lock(path: Path, longest_wait: float) -> Iterator[bool]:
    """Hold the lock of a file, which other processes wait for; yield False if one of them has it.

    After `longest_wait` [s] the block runs without it, and where no lock can be had: Lustre and
    FUSE may have none, which no other process can hold.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)  # NFS locks what can be written
    except OSError:
        yield True
        return
    try:
        end = time.monotonic() + longest_wait
        while not (is_alone := _try_lock(handle) is not False) and time.monotonic() < end:
            time.sleep(0.02)
        yield is_alone
    finally:
        os.close(handle)


def _try_lock(handle: int) -> bool | None:
    """Lock an open file; False if another process holds the lock, None if there is none."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
