"""The system calls that a guest with code from outside is refused, as a seccomp filter.

bubblewrap installs the filter (`--seccomp`) in the first process of the guest, so that it holds for
all of them. What is refused would let data outlive the guest, use memory that no limit counts, or
make namespaces with their own rights; programs get on without it.
"""

import errno
import platform
import struct
from collections.abc import Iterator
from typing import NamedTuple

AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
"""Machines for which there is a filter, with their number in the kernel."""

NEW_NAMESPACES, PIDFD = 0x7E020000, 0x1000
"""Flags of `clone` that make namespaces, CLONE_NEWNS to CLONE_NEWNET, and a handle of a process."""

READ_OPTIONS = (57, 77)
"""Options of sockets that are read: its number among all of the machine, a handle of a process."""

SET_OPTIONS = (26, 50, 51, 52, 76)
"""Options that are set: filters, which are memory of the kernel, and handles of processes."""

TERMINAL = 0x5400  # requests of `ioctl` to terminals and pipes (FIONREAD, FIONBIO), to 0x54FF

SHARED_ANONYMOUS = 0x21
"""Flags of `mmap`, MAP_SHARED | MAP_ANONYMOUS: its pages stay when no process has them mapped."""


class _When(NamedTuple):
    """A call is refused if `argument & mask == value`, or if it differs where not `equal`."""

    argument: int
    value: int
    mask: int = 0xFFFFFFFF
    equal: bool = True


class Rule(NamedTuple):
    """A call by its number on x86_64 and aarch64, what it returns, and when if not always.

    The error 0 lets the call succeed without effect.
    """

    name: str
    numbers: tuple[int, int]
    error: int = errno.EPERM
    when: _When | None = None


RULES = (
    # keyrings belong to a user, not to a process
    Rule("add_key", (248, 217)),
    Rule("request_key", (249, 218)),
    Rule("keyctl", (250, 219)),
    # which pages of a read-only file are in memory: asked with RWF_NOWAIT, changed by advice
    Rule("preadv2", (327, 286), errno.EOPNOTSUPP, _When(5, 0, equal=False)),
    Rule("pwritev2", (328, 287), errno.EOPNOTSUPP, _When(5, 0, equal=False)),
    Rule("mincore", (27, 232), errno.ENOSYS),
    Rule("cachestat", (451, 451), errno.ENOSYS),
    Rule("fadvise64", (221, 223), 0),
    Rule("readahead", (187, 213), 0),
    Rule("madvise", (28, 233), 0, _When(2, 20, 0xFFFFFFFE)),  # COLD, PAGEOUT
    # numbers of the whole machine, of sockets that were asked for it and of processes
    *(Rule("getsockopt", (55, 209), errno.ENOPROTOOPT, _When(2, x)) for x in READ_OPTIONS),
    *(Rule("setsockopt", (54, 208), errno.ENOPROTOOPT, _When(2, x)) for x in SET_OPTIONS),
    Rule("pidfd_open", (434, 434), errno.ENOSYS),
    # of files: which of their parts, or the file itself, anybody has used; keys of file systems
    Rule("ioctl", (16, 29), errno.EOPNOTSUPP, _When(1, TERMINAL, 0xFFFFFF00, equal=False)),
    Rule("name_to_handle_at", (303, 264), errno.EOPNOTSUPP),
    Rule("open_by_handle_at", (304, 265)),  # of a process, by its number (Linux 6.17)
    Rule("sync", (162, 81)),  # the kernel counts how often file systems were written out
    Rule("syncfs", (306, 267)),
    Rule("setsid", (112, 157), 0),  # sessions are counted in /proc/self/autogroup
    # all but AF_UNIX: others have memory that is counted in one number, AF_VSOCK leads out
    Rule("socket", (41, 198), errno.EAFNOSUPPORT, _When(0, 1, equal=False)),
    # what another guest does with a file that both see: locks, leases and watches
    Rule("flock", (73, 32), 0),
    # GETLK, OFD_GETLK, SETLEASE, NOTIFY
    *(Rule("fcntl", (72, 25), errno.EINVAL, _When(1, x)) for x in (5, 36, 1024, 1026)),
    Rule("inotify_add_watch", (254, 27)),
    Rule("fanotify_init", (300, 262), errno.ENOSYS),
    # memory that is part of no process
    Rule("memfd_create", (319, 279), errno.ENOSYS),
    Rule("memfd_secret", (447, 447), errno.ENOSYS),
    Rule("shmget", (29, 194), errno.ENOSYS),
    Rule("semget", (64, 190), errno.ENOSYS),
    Rule("msgget", (68, 186), errno.ENOSYS),
    # pages for compiled filters split others of the kernel, which are never joined again
    Rule("seccomp", (317, 277), errno.ENOSYS),
    Rule("prctl", (157, 167), errno.EINVAL, _When(0, 22)),  # SET_SECCOMP
    Rule("mmap", (9, 222), when=_When(3, SHARED_ANONYMOUS, SHARED_ANONYMOUS)),
    # namespaces, without which nothing can be mounted; clone3 hides its flags in memory, and
    # libraries fall back to clone
    Rule("clone", (56, 220), when=_When(0, 0, NEW_NAMESPACES | PIDFD, equal=False)),
    Rule("clone3", (435, 435), errno.ENOSYS),
    Rule("unshare", (272, 97)),
    Rule("setns", (308, 268)),
    # interfaces to the kernel that no estimator needs
    Rule("io_uring_setup", (425, 425), errno.ENOSYS),
    Rule("syslog", (103, 116)),  # its log has the addresses of faults, which a guest can choose
    Rule("bpf", (321, 280)),
    Rule("perf_event_open", (298, 241)),
    Rule("userfaultfd", (323, 282)),
)
"""The refused calls; all others are allowed."""

LOAD, AND, RETURN = 0x20, 0x54, 0x06
JUMP_EQUAL, JUMP_GREATER_EQUAL = 0x15, 0x35
ALLOW, ERROR, KILL = 0x7FFF0000, 0x00050000, 0x80000000
NUMBER, ARCHITECTURE, ARGUMENTS = 0, 4, 16  # offsets in the kernel's `struct seccomp_data`
X32_BIT = 0x40000000  # set in the numbers of the calls of a second table of x86_64


def program(machine: str | None = None) -> bytes | None:
    """Return the filter as an array of `struct sock_filter`; None for a machine without one."""
    machine = machine or platform.machine()
    if machine not in AUDIT_ARCH:
        return None
    column = list(AUDIT_ARCH).index(machine)
    words = [
        (LOAD, 0, 0, ARCHITECTURE),
        (JUMP_EQUAL, 1, 0, AUDIT_ARCH[machine]),
        (RETURN, 0, 0, KILL),  # the numbers of another architecture mean other calls
        (LOAD, 0, 0, NUMBER),
        (JUMP_GREATER_EQUAL, 0, 1, X32_BIT),
        (RETURN, 0, 0, ERROR | errno.ENOSYS),
    ]
    for rule in RULES:
        words += _refuse(rule, rule.numbers[column])
    words.append((RETURN, 0, 0, ALLOW))
    return b"".join(struct.pack("=HBBI", *word) for word in words)


def _refuse(rule: Rule, number: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield the instructions of a rule: operation, jumps if true and if false, constant.

    They begin and end with the number of the call loaded, and jump over themselves for others.
    """
    if rule.when is None:
        yield JUMP_EQUAL, 0, 1, number
        yield RETURN, 0, 0, ERROR | rule.error
        return
    yield JUMP_EQUAL, 0, 5, number
    yield LOAD, 0, 0, ARGUMENTS + 8 * rule.when.argument  # the lower half, little endian
    yield AND, 0, 0, rule.when.mask
    yield JUMP_EQUAL, *((0, 1) if rule.when.equal else (1, 0)), rule.when.value
    yield RETURN, 0, 0, ERROR | rule.error
    yield LOAD, 0, 0, NUMBER
