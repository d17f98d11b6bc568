"""What guests have read or looked up is dropped from the memory of the machine."""

import ctypes
import mmap
import os
import time

import pytest

from leaderboard.sandbox import bubblewrap
from leaderboard.sandbox.bubblewrap import forget_reads
from road_envs.core.code_digest import ROOT


def in_page_cache(path):
    """Return whether the first page of a file is in memory; mincore(2) reads nothing itself."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY) as mapped:
        first = ctypes.c_char.from_buffer(mapped)
        is_resident = ctypes.create_string_buffer(1)
        failed = ctypes.CDLL(None, use_errno=True).mincore(
            ctypes.c_void_p(ctypes.addressof(first)), ctypes.c_size_t(1), is_resident
        )
        del first  # or the map cannot be closed
    assert not failed
    return bool(is_resident.raw[0] & 1)


def test_what_guests_have_read_is_dropped_from_memory(monkeypatch):
    folder = ROOT / "docs" / "images"  # on a disk: what lies in memory cannot be dropped
    other, *paths = [path for path in folder.iterdir() if path.is_file()]
    for path in (other, *paths):
        path.read_bytes()
    os.sync()
    with other.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    if in_page_cache(other):
        pytest.skip("the file system of the checkout keeps its files in memory")
    assert all(map(in_page_cache, paths))
    monkeypatch.setattr(bubblewrap, "_system_mounts", dict)
    forget_reads([folder.parent])
    assert [path.name for path in paths if in_page_cache(path)] == []


def time_of_look_ups(names):
    """Time [ns] that the quicker quarter of look-ups of names does not exceed."""
    times = []
    for name in names:
        begin = time.perf_counter_ns()
        os.access(name, os.F_OK)
        times.append(time.perf_counter_ns() - begin)
    return sorted(times)[len(times) // 4]


def test_names_that_guests_have_looked_up_in_vain_are_dropped_from_memory(monkeypatch):
    if not bubblewrap.is_root():
        pytest.skip("only root can drop names")
    monkeypatch.setattr(bubblewrap, "_system_mounts", dict)
    told, untold = ([f"/usr/bin/{bit}_{k}_{os.getpid()}" for k in range(500)] for bit in "01")
    for _ in range(2):
        again = time_of_look_ups(told)
    if time_of_look_ups(untold) < 1.5 * again:
        pytest.skip("the file system does not remember names that do not exist")
    forget_reads()
    assert time_of_look_ups(told) > 1.5 * again
