"""The guest: loads the libraries, then an estimator in a child process, and serves the host.

    python -P -s -m leaderboard.sandbox.worker SETUP

reads requests from standard input and writes replies to what was its standard output; whatever the
estimator prints goes to standard error. The code of the estimator is loaded only in the child,
after all privileges are dropped and the limits of the kernel are set. The host checks
every reply: see `client`.
"""

import importlib
import json
import os
import signal
import stat
import sys
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, NoReturn

from leaderboard.sandbox import processes
from leaderboard.sandbox.limits import GIB, Limits
from road_envs.core.config import Settings, build

SERVED = 64
"""Exit status of a child that has served its requests until the end."""


@dataclass(frozen=True, kw_only=True)
class Setup(Settings):
    """Message that starts a guest.

    `entry` is the folder with the code of the entry; `user` the user and group to become, None to
    stay; `serves_many` allows more than one estimator, each in a child of its own, for which
    `libraries` are imported once. The kernel cache `cache` (folder of all files, name of the folder
    of today's kernels) is copied by links.
    """

    limits: Limits
    entry: str | None = None
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
    _preload(setup.libraries, implementations=setup.serves_many)
    reply(replies, {})
    while True:
        try:
            start = read_request()
        except EOFError:
            return
        pid = os.fork()
        if pid == 0:
            _run_child(setup, replies, start)
        _, status = os.waitpid(pid, 0)
        code = os.waitstatus_to_exitcode(status)
        if code != SERVED or not setup.serves_many:
            os._exit(128 - code if code < 0 else code)


def _preload(libraries: Sequence[str], implementations: bool) -> None:
    """Import what every estimator needs, or also the `implementations` of this package.

    Of `libraries` those that are not installed are left out; the estimator says so itself.
    """
    import gc

    import leaderboard.entries.entry
    import leaderboard.sandbox.messages  # noqa: F401

    if implementations:
        import estimators.registry  # noqa: F401
    for library in libraries:
        with suppress(ImportError):
            importlib.import_module(library)
    gc.collect()
    gc.freeze()


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


def read(size: int) -> bytes:
    """Return `size` bytes of the requests. Raises EOFError at the end of input."""
    data = bytearray()
    while len(data) < size:
        part = os.read(0, min(size - len(data), 1 << 20))
        if not part:
            raise EOFError
        data += part
    return bytes(data)


def read_request() -> dict[str, Any]:
    """Return the JSON object of the next request. Raises EOFError at the end of input."""
    from leaderboard.sandbox import messages

    (size,) = messages.HEAD_SIZE.unpack(read(messages.HEAD_SIZE.size))
    return json.loads(read(size))


def reply(handle: int, head: dict[str, Any], arrays: Any = ()) -> None:
    """Write a reply; one that cannot be encoded becomes a failure."""
    from leaderboard.sandbox import messages

    try:
        message = messages.encode(head, arrays)
    except (ValueError, TypeError, OverflowError) as error:
        message = messages.encode({"failure": f"cannot be reported: {error}"[:1000]})
    unsent = memoryview(message)
    while unsent:
        unsent = unsent[os.write(handle, unsent) :]


def _run_child(setup: Setup, replies: int, start: dict[str, Any]) -> NoReturn:
    """Serve the requests to one estimator in this process, then end it."""
    status = 1
    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL)
        processes.die_with_parent()
        _set_resource_limits(setup.limits, is_nobody=setup.user is not None)
        become(setup.user)
        os.umask(0o022)
        _serve(setup, replies, start)
        sys.stdout.flush()
        sys.stderr.flush()
        status = SERVED
    except BaseException as error:
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
    finally:
        os._exit(status)


def become(user: int | None) -> None:
    """Give up this user and its groups for `user`, if that is not None."""
    if user is not None:
        os.setgroups([])
        os.setgid(user)
        os.setuid(user)


def _serve(setup: Setup, replies: int, start: dict[str, Any]) -> None:
    from leaderboard.entries.entry import EntryError, LocalSession, describe_error
    from leaderboard.sandbox import messages
    from road_envs.vehicle.parameters import VehicleParameters

    try:
        name, estimator = load(start["reference"], start["settings"], setup.entry)
        head = describe(estimator)
    except BaseException as error:
        reason = str(error) if isinstance(error, EntryError) else describe_error(error)
        reply(replies, {"failure": f"cannot be constructed: {reason}"[:10_000]})
        return
    if start["car"] is None:
        reply(replies, {**head, "name": name})
        read_request()
        return
    _preload_scipy()
    session = LocalSession(estimator, build(VehicleParameters, start["car"], "car"))
    known = ("needs_training", "calibrates", "uses_seed")
    reply(replies, {name: getattr(session, name) for name in known})
    while (request := read_request())["do"] != "end":
        arrays = messages.decode_arrays(request, read)
        answer: dict[str, Any]
        z: list[Any] = []
        try:
            if request["do"] == "fit":
                training = messages.make_training(request, arrays)
                parameters, seconds = session.fit(
                    list(zip(*training, strict=True)), request["seed"]
                )
                answer = {"parameters": parameters, "seconds": seconds}
            elif request["do"] == "calibrate":
                answer = {"seconds": session.calibrate(messages.make_calibration(request, arrays))}
            else:
                estimate, seconds = session.estimate(
                    messages.make_record(arrays, request["length"], request)
                )
                z = [x.astype(float) for x in (estimate.z, estimate.z_std) if x is not None]
                answer = {"seconds": seconds, "std": estimate.z_std is not None}
        except (Exception, SystemExit) as error:
            answer, z = {"failure": describe_error(error)[:10_000]}, []
        reply(replies, answer, z)


def _preload_scipy() -> None:
    """Import the slow parts of SciPy, before any time counts, if a module uses SciPy as a whole.

    SciPy would load them at their first use; modules that import them by name have done so.
    """
    modules = [
        module for name, module in list(sys.modules.items()) if not name.startswith("scipy.")
    ]
    if any("scipy" in getattr(module, "__dict__", {}) for module in modules):
        for library in ("scipy.interpolate", "scipy.signal"):
            importlib.import_module(library)


def load(reference: str, settings: dict[str, Any], folder: str | None) -> tuple[str | None, Any]:
    """Return the estimator of an entry, and its name if it is from a package with an entry point.

    `folder` holds the snapshot of its code; without one it is an estimator of this package.
    """
    if folder is not None and is_class(reference):
        from estimators.api import check_class

        sys.path.insert(0, folder)
        module, _, name = reference.partition(":")
        cls = attrgetter(name)(importlib.import_module(module))
        return None, build(check_class(cls), settings, name)
    if folder is not None and not reference.endswith((".npz", ".safetensors")):
        return load_package(Path(folder), settings)
    from estimators import make_estimator

    if folder is None:
        return None, make_estimator(reference, **settings)
    return None, make_estimator(Path(folder) / Path(reference).name)  # a file has its own settings


def is_class(reference: str) -> bool:
    """Return whether a reference is "module:Class"."""
    return ":" in reference and "/" not in reference


def load_package(folder: Path, settings: dict[str, Any]) -> tuple[str, Any]:
    """Return name and estimator of a wheel, or of a folder of installed packages.

    Files named .pth have no effect. Raises EntryError.
    """
    from importlib import metadata

    from estimators.api import ENTRY_POINT_GROUP, check_class
    from leaderboard.entries.entry import EntryError

    for wheel in folder.glob("*.whl"):
        folder = Path(os.environ["HOME"]) / "entry"
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(folder)
    sys.path.append(str(folder))
    found = [
        entry
        for distribution in metadata.distributions(path=[str(folder)])
        for entry in distribution.entry_points
        if entry.group == ENTRY_POINT_GROUP
    ]
    if len(found) != 1:
        names = sorted(entry.name for entry in found)
        raise EntryError(f"it must declare one entry point of {ENTRY_POINT_GROUP}, found {names}")
    return found[0].name, build(check_class(found[0].load()), settings, found[0].name)


def describe(estimator: Any) -> dict[str, Any]:
    """Return what an estimator says about itself, as JSON types."""
    from estimators.api import declared_lag
    from leaderboard.entries.entry import get_settings

    return {
        "settings": json.loads(json.dumps(get_settings(estimator), default=str)),
        "causal": estimator.causal,
        "lag": declared_lag(estimator),
    }


def _set_resource_limits(limits: Limits, *, is_nobody: bool) -> None:
    """Set the limits that the kernel enforces. Reserved but unused memory does not count."""
    import resource

    mapped = processes.data_size() or GIB  # when it was forked
    values = {
        "RLIMIT_CORE": 0,
        "RLIMIT_FSIZE": int(limits.file * GIB),
        "RLIMIT_DATA": int(limits.memory * GIB) + mapped,
        "RLIMIT_CPU": int(limits.seconds * max(1, os.cpu_count() or 1)) + 60,
    }
    if is_nobody:  # of any other user it would count all processes
        values["RLIMIT_NPROC"] = 4 * limits.processes + 64
    for name, value in values.items():
        kind = getattr(resource, name)
        _, hard = resource.getrlimit(kind)
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(kind, (value, value))


if __name__ == "__main__":
    main()
