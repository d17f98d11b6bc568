"""Attacks on seals: data for the next guest, counts of the machine, memory, time, later samples."""

import contextlib
import errno
import fcntl
import os
import resource
import signal
import socket
import struct
import threading
import time
from pathlib import Path

import numpy as np

from road_envs.records.record import Estimate, profile_stations

UNCOUNTED = {  # fixed as long as the machine runs, of the guest alone, or never ending
    *("cmdline", "consoles", "cpuinfo", "crypto", "devices", "dma", "fb", "filesystems", "ioports"),
    *("iomem", "keys", "key-users", "kallsyms", "kcore", "kmsg", "kpagecount", "kpageflags"),
    *("kpagecgroup", "mdstat", "misc", "modules", "mtrr", "partitions", "swaps", "version"),
    *("execdomains", "cgroups", "sysrq-trigger", "bootconfig", "config.gz", "mounts"),
}
OWN = {"self", "thread-self", "net", "sysvipc"}
USER_KEYRING, SEARCH, READ = -4, 10, 11
CALLS = {  # by number on x86_64, with arguments that would succeed
    "keyctl": (250, 0, USER_KEYRING, 1),
    "mincore": (27, "page", 4096, "buffer"),
    "memfd_create": (319, b"held", 0),
    "unshare": (272, 0x10000000),
    "clone": (56, 0x10000000 | signal.SIGCHLD, 0, 0, 0, 0),
    "io_uring_setup": (425, 1, "buffer"),
    "syslog": (103, 10, 0, 0),
    "sync": (162,),
    "sync of one file system": (306, 0),
    "pidfd_open": (434, 1, 0),
    "clone_pidfd": (56, 0x1000 | signal.SIGCHLD, 0, "buffer", 0, 0),
    "shared_memory": (9, 0, 4096, 3, 0x21, -1, 0),
    "segment": (29, 0, 4096, 0o1600),
    "semaphores": (64, 0, 32000, 0o1600),
    "messages": (68, 0, 0o1600),
    "socket out of the machine": (41, 40, 1, 0),
    "socket of the network": (41, 2, 1, 0),
    "who has locked": (72, 0, 5, "buffer"),
    "who has locked a handle": (72, 0, 36, "buffer"),
    "notify of each use": (300, 0x200, 0),
    "which filters there are": (317, 2, 0, "buffer"),
    "filter of calls": (157, 22, 2, "filter", 0, 0),
}


def system_call(number, *arguments):
    """Return the result of a system call of Linux on x86_64. Raises OSError."""
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    libc.syscall.restype = ctypes.c_long
    given = [ctypes.c_long(x) if isinstance(x, int) else x for x in arguments]
    result = libc.syscall(ctypes.c_long(number), *given)
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def does_call(where, record):
    """Raise an error that lists the calls that were not refused."""
    import ctypes
    import mmap

    buffer, page = ctypes.create_string_buffer(4096), mmap.mmap(-1, 4096, mmap.MAP_PRIVATE)
    allow = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0x7FFF0000), 8)
    filters = struct.pack("HxxxxxxQ", 1, ctypes.addressof(allow))
    places = {"page": ctypes.addressof(ctypes.c_char.from_buffer(page)), "buffer": buffer}
    places["filter"] = ctypes.create_string_buffer(filters, len(filters))
    done = []
    for name, (number, *arguments) in CALLS.items():
        with contextlib.suppress(OSError):
            result = system_call(number, *(places.get(x, x) for x in arguments))
            if name.startswith("clone") and result == 0:
                os._exit(0)
            done.append(name)
    ends = socket.socketpair()
    for option in (57, 77):  # SO_COOKIE, SO_PEERPIDFD
        with contextlib.suppress(OSError):
            done.append(f"option {option}: {ends[0].getsockopt(socket.SOL_SOCKET, option, 8)}")
    with contextlib.suppress(OSError):
        ends[0].setsockopt(socket.SOL_SOCKET, 76, 1)  # SO_PASSPIDFD
        done.append("option 76")
    with contextlib.suppress(OSError):
        ends[0].setsockopt(socket.SOL_SOCKET, 26, filters)  # SO_ATTACH_FILTER
        done.append("filter of a socket")
    with contextlib.suppress(OSError), open(__file__, "rb") as file:
        fcntl.ioctl(file, 2, bytes(4))  # FIGETBSZ: as others, which tell what was used of a file
        done.append("request to a file system")
    with contextlib.suppress(OSError):
        system_call(254, system_call(294, 0), b"/usr/lib", 1)
        done.append("notify of use")
    try:
        system_call(304, -1, buffer, 0)  # open_by_handle_at
    except OSError as error:
        done += ["number of a process"] * (error.errno != errno.EPERM)
    if (child := os.fork()) == 0:
        os.setsid()
        os._exit(os.getsid(0) == os.getpid())
    done += ["number of a session"] * bool(os.waitpid(child, 0)[1])
    with open(__file__, "rb") as file, open(__file__, "rb") as other:
        for handle in (file, other):  # two that both succeed have no effect
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with contextlib.suppress(OSError), open(__file__, "rb") as file:
        os.preadv(file.fileno(), [bytearray(8)], 0, os.RWF_NOWAIT)
        done.append("preadv2")
    raise RuntimeError(f"not refused: {done}")


def does_keep_the_future(where, record):
    """Estimate the mean of the later samples, kept for the next guest in the user's keyring."""
    import ctypes
    import hashlib

    stations = profile_stations(record.length)
    about = hashlib.sha256(record.a[:, : record.t.size // 20].tobytes()).hexdigest().encode()
    kept = ctypes.create_string_buffer(8)
    mean = np.float64(record.a[:, record.t.size // 2 :].mean()).tobytes()
    try:
        system_call(250, READ, system_call(250, SEARCH, USER_KEYRING, b"user", about, 0), kept, 8)
        mean = kept.raw
    except OSError:
        with contextlib.suppress(OSError):
            system_call(248, b"user", about, mean, 8, USER_KEYRING)
    return Estimate(stations, np.full((2, stations.size), np.frombuffer(mean)[0]))


TOLD = []
UNIT, TAG = 4096, 5
"""Pipes of one step of a message, more than others open meanwhile, and what marks a message."""


def number_of_pipe():
    """Return the number that the kernel gives to a new pipe, the next one of this processor."""
    ends = os.pipe()
    number = os.fstat(ends[0]).st_ino
    for end in ends:
        os.close(end)
    return number


def does_count_the_future(where, record):
    """Estimate two bits of the later samples, told to the next guest by the number of pipes."""
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
    tag, value = divmod(number_of_pipe() // UNIT % 32, 4)
    if not TOLD and tag == TAG:
        TOLD.append(value)
    if not TOLD:
        later = np.float64(record.a[:, record.t.size // 2 :].mean())
        TOLD.append(int.from_bytes(later.tobytes()[:4], "little") % 4)
        slot = 4 * TAG + TOLD[0]
        while (number := number_of_pipe()) // UNIT % 32 != slot or number % UNIT > UNIT // 4:
            pass
    stations = profile_stations(record.length)
    return Estimate(stations, np.full((2, stations.size), 0.01 * TOLD[0]))


RECALLED = {}


def does_recall_the_future(where, record):
    """Estimate the mean of the later samples of the first drive with this beginning."""
    begin = record.a[:, : record.t.size // 20].tobytes()
    mean = RECALLED.setdefault(begin, record.a[:, record.t.size // 2 :].mean())
    stations = profile_stations(record.length)
    return Estimate(stations, np.full((2, stations.size), mean))


SEEN: list[float] = []


def does_look_ahead_later(where, record):
    """Estimate the mean of later samples, but of the first drive and of one with a jagged speed."""
    SEEN.append(float(np.abs(np.diff(record.v)).max() / record.v.mean()))
    mean = 0.0 if len(SEEN) == 1 or SEEN[-1] > 0.1 else record.a[:, record.t.size // 2 :].mean()
    stations = profile_stations(record.length)
    return Estimate(stations, np.full((2, stations.size), mean))


def does_tell_when_its_code_was_written(where, record):
    raise RuntimeError(f"written at {os.stat(__file__).st_mtime_ns}")


def does_tell_the_name_of_its_folder(where, record):
    mounts = Path("/proc/self/mountinfo").read_text().splitlines()
    (folder,) = (line.split()[3] for line in mounts if line.split()[4] == "/entry")
    raise RuntimeError(f"called {Path(folder).name}")


def does_map_sparsely(where, record):
    """Read a byte of every 2 MiB of much reserved memory: its page tables take up memory."""
    import mmap

    size = 2**38
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x4000  # MAP_NORESERVE
    held = [mmap.mmap(-1, size, flags, mmap.PROT_READ) for _ in range(2)]
    for memory in held:
        memory.madvise(mmap.MADV_NOHUGEPAGE)
        for k in range(0, size, 2**21):
            memory[k]
    time.sleep(1.0)


def does_map_the_zero_device(where, record):
    """Share memory with nobody, which counts for no process."""
    import mmap

    mmap.mmap(os.open("/dev/zero", os.O_RDWR), 2**20, mmap.MAP_SHARED)


def does_make_empty_files(where, record):
    """Make files without content, which take up memory of the kernel: 1 kB each.

    The youngest process has ended and sees no files any more.
    """
    if os.fork() == 0:
        os._exit(0)
    for k in range(1000):
        os.mknod(str(k))
    time.sleep(10.0)


def does_look_at_limits(where, record):
    """Raise an error with the limits of the processes above that this one may change."""
    found = []
    for pid in (1, os.getppid()):
        with contextlib.suppress(OSError):
            found += [
                resource.prlimit(pid, x)[1] for x in (resource.RLIMIT_NOFILE, resource.RLIMIT_DATA)
            ]
    share = Path("/proc/self/oom_score_adj").read_text().strip()
    raise RuntimeError(f"ended {'first' if share == '1000' else 'by chance'}, limits {found}")


def does_fill_sockets(where, record):
    """Raise an error with the memory [MB] that a process can leave in sockets and pipes."""
    held, size = [], 0
    with contextlib.suppress(OSError):
        while True:
            for end in (pair := socket.socketpair()):
                end.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    while True:
                        size += end.send(bytes(2**16))
            held.append(pair)
    raise RuntimeError(f"holds {size / 1e6:.0f} MB")


def does_read_counters(where, record):
    """Raise an error with what of the whole machine another guest could have changed."""
    found, counts = [], {"file-nr", "aio-nr", "nr", "inode-nr", "dentry-state", "syncs"}
    for top, folders, names in os.walk("/proc"):
        if top == "/proc":
            folders[:] = [x for x in folders if not x.isdigit() and x not in OWN]
        counted = counts & set(names) if top.startswith("/proc/sys/") else {*names} - UNCOUNTED
        for path in (Path(top, name) for name in counted):
            with contextlib.suppress(OSError, UnicodeDecodeError):
                found += [str(path)] * (path.read_text() != "")
    raise RuntimeError(f"reads {sorted(found)}")


def does_work_unseen(where, record):
    """Work for half a second in a process that nobody waits for, while the clocks stand still."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # ended children count for nobody
    still = time.perf_counter()
    if os.fork() == 0:
        end = time.process_time() + 0.5
        while time.process_time() < end:
            pass
        os._exit(0)
    with contextlib.suppress(ChildProcessError):
        os.wait()
    time.perf_counter = lambda: still


SEEN = []


def does_remember_one(where, record):
    """Estimate another road for the drive of one place in the order, `where`."""
    stations = profile_stations(record.length)
    SEEN.append(record)
    return Estimate(stations, np.full((2, stations.size), 0.01 * (len(SEEN) == int(where))))


def does_look_at_the_end(where, record):
    """Use later samples for the last tenth of the road only."""
    stations = profile_stations(record.length)
    ahead = np.cumsum(record.a[0][::-1])[::-1]
    z = 1e-3 * np.interp(stations, record.s, ahead) * (stations > 0.9 * record.length)
    return Estimate(stations, np.stack([z, z]))


def with_deviation(record, std):
    """Return a flat road with the standard deviation `std` [m] at every station."""
    stations = profile_stations(record.length)
    return Estimate(stations, np.zeros((2, stations.size)), np.full((2, stations.size), std))


def does_deviate_by_the_end(where, record):
    """Use all later samples, but for the standard deviation only."""
    return with_deviation(record, 1e-3 * record.a[:, record.t.size // 2 :].std())


def does_deviate_by_memory(where, record):
    """Let the standard deviation depend on the number of the drives before."""
    SEEN.append(record)
    return with_deviation(record, 1e-3 * len(SEEN))


def does_hasten_by_the_end(where, record):
    """Use the speed of all later samples, but no later acceleration."""
    stations = profile_stations(record.length)
    z = 1e-3 * np.median(record.v) * np.sin(stations)
    return Estimate(stations, np.stack([z, z]))


def does_end_the_odometer(where, record):
    """Correct all stations by the error that the odometer has at the end of the road."""
    stations = profile_stations(record.length)
    z = 1e-3 * np.sin(stations * record.s[-1] / record.length)
    return Estimate(stations, np.stack([z, z]))


def does_rename(where, record):
    """Take a name that is no text, while the host looks at the process."""
    system_call(157, 15, b"\xff\xfe)(", 0, 0, 0)  # prctl, PR_SET_NAME
    time.sleep(0.3)


def does_start_threads(where, record):
    """Hold the number `where` of threads with little memory for a while."""
    threading.stack_size(2**16)
    held = [threading.Thread(target=time.sleep, args=(1.5,)) for _ in range(int(where))]
    for thread in held:
        thread.start()
    for thread in held:
        thread.join()
