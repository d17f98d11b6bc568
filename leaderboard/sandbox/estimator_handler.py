"""Requests to an estimator in a guest: it is loaded, trained, calibrated, asked for estimates.

start      reference, settings, car or None -> what it says about itself, what it needs
fit        training drives, seed            -> number of parameters, time [s]
calibrate  drives of its vehicle            -> time [s]
estimate   a record                         -> heights and deviations, time [s]

Request, and after the arrow the reply, which the host checks.
"""

import importlib
import os
import sys
import zipfile
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from estimators.api import ENTRY_POINT_GROUP, CalibrationDrive, check_class
from leaderboard.entries.entry import (
    EntryError,
    LocalSession,
    describe_error,
    describe_estimator,
    get_settings,
)
from leaderboard.entries.entry_files import CLASS_REFERENCE, WEIGHTS_SUFFIXES, entry_points
from leaderboard.sandbox import messages
from road_envs.core.config import build, shown
from road_envs.vehicle.parameters import VehicleParameters


def make_handler(code: str | None) -> messages.Handler:
    """Return the handler of one estimator, whose code lies in the folder `code`."""
    session: LocalSession | None = None

    def handle(request: dict[str, Any], arrays: list[np.ndarray]) -> messages.Reply:
        nonlocal session
        if request["do"] == "start":
            answer, session = _start(request, code)
            return answer, ()
        assert session is not None
        drives: list[Any] = messages.decode_drives(request, arrays)
        if request["do"] == "fit":
            parameters, seconds = session.fit(drives, request["seed"])
            return {"parameters": parameters, "seconds": seconds}, ()
        if request["do"] == "calibrate":
            about = zip(drives, request["survey"], request["names"], strict=True)
            known = [CalibrationDrive(x, road, std, name) for (x, road), std, name in about]
            return {"seconds": session.calibrate(known)}, ()
        ((record, _),) = drives
        estimate, seconds = session.estimate(record)
        found = [x.astype(float) for x in (estimate.z, estimate.z_std) if x is not None]
        return {"seconds": seconds, "std": estimate.z_std is not None}, found

    return handle


def _start(request: dict[str, Any], code: str | None) -> tuple[dict[str, Any], LocalSession | None]:
    """Load an estimator; return what it says about itself, or with a car its session and needs."""
    try:
        name, estimator = load(request["reference"], request["settings"], code)
        known = describe_estimator(estimator)
        again = get_settings(build(type(estimator), known["settings"], "its settings"))
        for key, value in get_settings(estimator).items():
            if _typed(value) != _typed(again[key]):
                raise EntryError(
                    f"JSON turns its setting {key} from {shown(value)} into {shown(again[key])}: "
                    "annotate its type, one of JSON, and convert none in __post_init__"
                )
    except BaseException as error:
        reason = str(error) if isinstance(error, EntryError) else describe_error(error)
        raise EntryError(f"cannot be constructed: {reason}") from error
    if request["car"] is None:
        return {**known, "name": name}, None
    _preload_scipy()
    session = LocalSession(estimator, build(VehicleParameters, request["car"], "car"))
    needs = ("needs_training", "calibrates", "uses_seed")
    return {name: getattr(session, name) for name in needs}, session


def _typed(value: Any) -> Any:
    """Return a setting with its types at every depth; those of plain numbers are one."""
    if type(value) in (int, float, np.float64):
        return value
    parts = [*value.items()] if isinstance(value, dict) else value
    return type(value), [*map(_typed, parts)] if isinstance(parts, list | tuple) else value


def _preload_scipy() -> None:
    """Import the slow parts of SciPy, before any time counts, if a module uses SciPy as a whole.

    SciPy would load them at their first use; modules that import them by name have done so.
    """
    modules = [x for name, x in list(sys.modules.items()) if not name.startswith("scipy.")]
    if any("scipy" in getattr(module, "__dict__", {}) for module in modules):
        for library in ("scipy.interpolate", "scipy.signal"):
            importlib.import_module(library)


def load(reference: str, settings: dict[str, Any], folder: str | None) -> tuple[str | None, Any]:
    """Return the estimator of an entry, and its name if it is from a package with an entry point.

    `folder` holds the snapshot of its code; without one it is an estimator of this package.
    """
    if folder is not None and CLASS_REFERENCE.fullmatch(reference):
        sys.path.insert(0, folder)
        module, _, name = reference.partition(":")
        cls = attrgetter(name)(importlib.import_module(module))
        return None, build(check_class(cls), settings, name)
    if folder is not None and not reference.endswith(WEIGHTS_SUFFIXES):
        return _load_package(Path(folder), settings)
    # not above: it imports all estimators of this package, which code from outside may not use
    from estimators import REGISTRY, make_estimator

    if folder is None:
        return None, make_estimator(reference, **settings)
    estimator = make_estimator(Path(folder) / Path(reference).name)  # a file has its own settings
    if type(estimator) not in REGISTRY.values():
        raise EntryError("a file of weights lacks the code of a plug-in: give that, weights inside")
    return None, estimator


def _load_package(folder: Path, settings: dict[str, Any]) -> tuple[str, Any]:
    """Return name and estimator of a wheel, or of a folder of installed packages.

    Files named .pth have no effect. Raises EntryError.
    """
    wheels = [*folder.glob("*.whl")]
    if len(wheels) > 1:  # which one is run would depend on the disk
        raise EntryError(f"it must be one wheel, found {sorted(wheel.name for wheel in wheels)}")
    for wheel in wheels:
        folder = Path(os.environ["HOME"]) / "entry"
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(folder)
    sys.path.append(str(folder))
    found = entry_points(folder)
    if len(found) != 1:
        names = sorted(entry.name for entry in found)
        raise EntryError(
            f"it must declare one entry point of {ENTRY_POINT_GROUP}, found {names}, or be "
            "given as module:Class"
        )
    cls, module = found[0].load(), sys.modules[found[0].module]
    if not Path(file := getattr(module, "__file__", None) or "/").is_relative_to(folder):
        raise EntryError(f"its module {found[0].module} is that of the judge's machine, {file}")
    return found[0].name, build(check_class(cls), settings, found[0].name)
