"""Atomic writes, and removal of the files of killed processes."""

import errno
import os
import platform
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from road_envs.core import atomic_io
from road_envs.core.atomic_io import (
    TempFolder,
    atomic_write,
    copy_file,
    new_folder,
    remove_stale_partials,
    remove_stale_temp,
    write_text,
)
from road_envs.core.config import ConfigError


def test_a_file_is_replaced_only_when_it_is_complete(tmp_path):
    path = tmp_path / "name.txt"
    write_text(path, "old")
    with atomic_write(path) as partial:
        partial.write_text("half")
        assert path.read_text() == "old"
        partial.write_text("whole")
    assert path.read_text() == "whole" and os.listdir(tmp_path) == ["name.txt"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("durable", [False, True])
def test_a_failed_write_leaves_only_the_old_file(tmp_path, error, durable):
    path = tmp_path / "name.txt"
    write_text(path, "old")
    with pytest.raises(type(error)), atomic_write(path, durable=durable) as partial:
        partial.write_text("half")
        raise error
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["name.txt"]


def test_a_full_disk_is_that_of_the_file_that_is_written(tmp_path, monkeypatch):
    source, target = tmp_path / "source", tmp_path / "target"
    source.write_text("text")

    def full(source, _):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), source)

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*target'$"):
        copy_file(source, target)
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*target'$"),
        atomic_write(target),
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(FileNotFoundError, match=r"'.*absent'$"), atomic_write(target):
        (tmp_path / "absent").read_text()


def test_a_durable_file_is_flushed_before_the_replacement(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(atomic_io.os, "fsync", lambda handle: (done.append("disk"), fsync(handle)))
    monkeypatch.setattr(atomic_io.os, "replace", lambda *a: (done.append("place"), replace(*a)))
    write_text(tmp_path / "a" / "name.txt", "text", durable=True)
    assert done == ["disk", "place", "disk"]  # the file, then its folder
    assert (tmp_path / "a" / "name.txt").read_text() == "text"


def test_concurrent_writers_of_one_file_do_not_mix(tmp_path):
    path, together = tmp_path / "name.txt", threading.Barrier(4)

    def write(letter):
        with atomic_write(path) as partial:
            together.wait(10)
            partial.write_text(letter * 100_000)
            together.wait(10)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    text = path.read_text()
    assert text == text[0] * 100_000 and os.listdir(tmp_path) == ["name.txt"]


def test_partial_files_are_removed_a_day_after_their_last_change_whoever_writes_them(tmp_path):
    """A host name and a process id do not tell writers in containers with a shared folder apart."""
    host = "".join(c for c in platform.node() if c.isalnum())
    old, new = ".a.txt.elsewhere-999999-1-0.partial", f".b.txt.{host}-999999-1-0.partial"
    (tmp_path / "deep").mkdir()
    for place in (old, new, ".kept.partial"):
        (tmp_path / "deep" / place).write_text("half")
    (tmp_path / ".c.txt.folder-1-1-0.partial").mkdir()
    day_ago = time.time() - atomic_io.STALE_AGE
    os.utime(tmp_path / "deep" / old, (day_ago - 60.0,) * 2)
    os.utime(tmp_path / "deep" / new, (day_ago + 60.0,) * 2)
    for place in ("deep/.kept.partial", ".c.txt.folder-1-1-0.partial"):
        os.utime(tmp_path / place, (0.0, 0.0))  # none that `atomic_write` makes
    with atomic_write(tmp_path / "deep" / "mine.txt") as partial:
        partial.write_text("being written")
        remove_stale_partials(tmp_path)
    assert sorted(os.listdir(tmp_path / "deep")) == sorted([new, ".kept.partial", "mine.txt"])
    assert (tmp_path / ".c.txt.folder-1-1-0.partial").is_dir()


KILLED = """
import os, sys
from pathlib import Path
from road_envs.core.atomic_io import new_folder
with new_folder(Path(sys.argv[1])) as folder:
    (folder / "half").touch()
    os.kill(os.getpid(), 9)
"""


def test_two_do_not_make_one_folder_at_once_and_a_killed_one_blocks_none(tmp_path):
    path = tmp_path / "deep" / "found"
    assert subprocess.run([sys.executable, "-c", KILLED, str(path)]).returncode == -9
    with new_folder(path) as folder:
        (folder / "a").touch()
        with pytest.raises(ConfigError, match="found: another process makes it"), new_folder(path):
            pass
        assert os.listdir(folder) == ["a"]
    assert os.listdir(path) == ["a"] and list(path.parent.iterdir()) == [path]


def test_without_locks_a_folder_is_made_and_none_is_removed(tmp_path, monkeypatch):
    """As on some mounts of Lustre and of FUSE, where the call is not supported."""

    def flock(handle, operation):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(atomic_io.tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(atomic_io.fcntl, "flock", flock)
    with new_folder(tmp_path / "found") as folder:
        (folder / "a").touch()
    assert [x.name for x in (tmp_path / "found").iterdir()] == ["a"]
    with TempFolder() as mine:
        assert remove_stale_temp() == [] and mine.exists()


HOLDS = """
import sys, time
from road_envs.core.atomic_io import TempFolder
with TempFolder() as folder:
    (folder / "large").mkdir()
    (folder / "large" / "file").write_text("text")
    print(folder, flush=True)
    time.sleep(1000.0)
"""


def holder(tmp_path):
    """Start a process with a temporary folder; return both."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDS],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    with process.stdout as stdout:
        return process, Path(stdout.readline().strip())


def test_temporary_folders_of_dead_owners_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic_io.tempfile, "tempdir", str(tmp_path))
    (tmp_path / "road-recon-my-road").mkdir()  # such as a user's package
    (tmp_path / f"{atomic_io.TEMP_PREFIX}of-somebody").mkdir()  # without a lock file
    others = sorted(tmp_path.iterdir())
    living, his = holder(tmp_path)
    dead, left = holder(tmp_path)
    try:
        dead.kill()
        dead.wait()
        with TempFolder() as mine:
            assert mine.parent == tmp_path and (left / "large" / "file").exists()
            assert remove_stale_temp() == [left]
            assert sorted(tmp_path.iterdir()) == sorted([*others, mine, his])
            assert (his / "large" / "file").exists()
        assert not mine.exists()
    finally:
        living.kill()
        living.wait()
    assert remove_stale_temp() == [his] and sorted(tmp_path.iterdir()) == others


def test_a_new_folder_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "found"
    with pytest.raises(RuntimeError), new_folder(path) as folder:
        copy_file(Path(__file__), folder / "deep" / "copy.py")
        assert (folder / "deep" / "copy.py").read_bytes() == Path(__file__).read_bytes()
        assert not path.exists()
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with new_folder(path) as folder:
        (folder / "a").touch()
    assert [x.name for x in path.iterdir()] == ["a"] and list(tmp_path.iterdir()) == [path]
    with pytest.raises(ConfigError, match="exists; give a folder that does not"), new_folder(path):
        pass
