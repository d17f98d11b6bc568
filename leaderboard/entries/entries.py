"""Entries from the names of estimators, with the settings and versions that identify them.

Estimators of this package are constructed here. An entry from outside (a wheel, a folder, a file, a
class of another package) is not loaded by the evaluation: a guest describes it, and of that only
settings, causality and lag are used.
"""

import hashlib
import itertools
import os
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

import estimators
from estimators import pretrained_weights
from estimators.api import Estimator, Pretrained, Trainable
from leaderboard.entries import entry_files
from leaderboard.entries.entry import (
    BUILTIN,
    NAME,
    Entry,
    EntryError,
    describe_estimator,
    needs_training,
)
from leaderboard.entries.imports import imported_versions
from road_envs.core.artifacts import code_version
from road_envs.core.code_digest import PACKAGES
from road_envs.core.config import ConfigError, validate_choice

_MADE_FROM_TRUTH = ("truth_plus_noise", "memory")
_OTHER_NAMES = (*_MADE_FROM_TRUTH, BUILTIN, "bound", "attainable", "truth", "index")
_ALIKE = str.maketrans("-i10", "_llo")


def fold(name: str) -> str:
    """Return a name without what readers overlook: its case, - for _, I or 1 for l, 0 for O."""
    return name.lower().translate(_ALIKE)


RESERVED = frozenset(map(fold, (*estimators.REGISTRY, *_OTHER_NAMES)))
"""Folded names of rows and pages, which an entry from outside cannot have."""

_Describe = Callable[[str], dict[str, Any]]
"""Description of an estimator that this process does not load: `SandboxClient.describe`."""


def is_ours(reference: str) -> bool:
    """Return whether a reference names an estimator of this package."""
    return reference in estimators.REGISTRY or (
        entry_files.CLASS_REFERENCE.fullmatch(reference) is not None
        and reference.partition(":")[0].partition(".")[0] in PACKAGES
    )


def is_by_others(entry: Entry) -> bool:
    """Return whether an entry is not of this package, also if it could not be described."""
    return entry.reference != BUILTIN and not is_ours(entry.reference)


def is_from_outside(entry: Entry) -> bool:
    """Return whether code of an entry is run that is none of this package."""
    return entry.failure is None and is_by_others(entry)


def find_reference(name: str) -> str:
    """Return the reference of what a user has named: a path, "module:Class" or an installed name.

    Raises ConfigError for a file that does not exist and for an unknown name.
    """
    path = Path(name)
    suffixes = (*entry_files.WEIGHTS_SUFFIXES, ".whl")
    if path.suffix in suffixes or os.sep in name:
        if not (path.is_file() or path.is_dir()):  # pipes and devices have no end
            choices = "a wheel, a folder of an installed package, or a file from `train`"
            raise ConfigError(f"{name}: no such file; give {choices}")
        is_stored = path.suffix in suffixes and path.resolve().suffix not in suffixes  # by digest
        return str(path.absolute() if is_stored else path.resolve())
    if entry_files.CLASS_REFERENCE.fullmatch(name):
        return name
    validate_choice("estimator", name, estimators.names())
    if name in estimators.REGISTRY:
        return name
    plugins = metadata.entry_points(group=estimators.ENTRY_POINT_GROUP)
    return next(entry.value for entry in plugins if entry.name == name)


def make_entry(name: str, estimator: Estimator | None) -> Entry:
    """Return the entry of an estimator of this process; None is made by the evaluation."""
    if estimator is None:
        return Entry(name=name, reference=BUILTIN)
    cls: Any = type(estimator)
    registered = next((key for key, known in estimators.REGISTRY.items() if known is cls), None)
    reference = registered or f"{cls.__module__}:{cls.__qualname__}"
    if is_ours(reference):
        code, weights = code_version(cls.__module__), _included_weights(estimator)
        code = code if weights is None else f"{code}+{_arrays_digest(weights)}"
    else:
        code = entry_files.snapshot(reference, None)
    known = describe_estimator(estimator)
    imports = () if is_ours(reference) else imported_versions(reference)
    return Entry(name=name, reference=reference, code=code, imports=imports, **known)


def resolve_entries(names: Sequence[str], describer: _Describe | None) -> list[Entry]:
    """Return entries by registered name, "module:Class", or path of a wheel, folder or .npz.

    Entries from outside this package need a `describer`. One that cannot be constructed, or whose
    name is not allowed or taken, gives an entry with a failure, so that every entry has its row.
    Raises ConfigError for an unknown name, and for a class of this package.
    """
    references = [find_reference(name) for name in names]
    for reference in references:
        if is_ours(reference) and reference not in estimators.REGISTRY:
            known = ", ".join(estimators.REGISTRY)
            raise ConfigError(f"{reference} is a class of this package: name it, one of {known}")
    entries: dict[int, Entry] = {}
    failures: dict[int, str] = {}
    for k, (name, reference) in enumerate(zip(names, references, strict=True)):
        if name in estimators.REGISTRY or describer is None:
            entries[k] = make_entry(name, estimators.create(name))
            continue
        taken = {fold(entry.name) for entry in entries.values()}
        try:
            entries[k] = _outside_entry(name, reference, taken, describer)
        except EntryError as error:
            failures[k] = str(error)
    for k, failure in failures.items():  # last: none takes the name of an entry that works
        name = _free_name(_name_of(names[k]), {fold(entry.name) for entry in entries.values()})
        entries[k] = Entry(name=name, reference=references[k], failure=failure)
    return [entries[k] for k in range(len(names))]


def registered_entry(name: str, each_case: bool) -> Entry | None:
    """Return the entry of an estimator of this package, or of a baseline that the evaluation makes,
    as it is now; None for any other name.
    """
    if name in _MADE_FROM_TRUTH:
        return make_entry(name, None)
    if name not in estimators.REGISTRY:
        return None
    entry = make_entry(name, estimators.create(name))
    return entry_refit_per_case(entry) if each_case else entry


def entry_refit_per_case(entry: Entry) -> Entry:
    """Return the entry for tasks whose protocol trains on each case separately.

    An estimator that can be fitted to a case in seconds is used without its pretrained weights.
    """
    if entry.failure is not None or entry.reference not in estimators.REGISTRY:
        return entry
    own = estimators.create(entry.reference, **entry.settings)
    if not (isinstance(own, Pretrained) and own.refit_per_case):
        return entry
    settings = {**entry.settings, "shipped": False}
    return make_entry(entry.name, estimators.create(entry.reference, **settings))


def _outside_entry(given: str, reference: str, taken: set[str], describer: _Describe) -> Entry:
    """Return the entry that a guest describes. Raises EntryError, also if it is not named so."""
    known = describer(reference)
    name = known.pop("name", None) or _name_of(given)
    if not NAME.fullmatch(name):
        reason = "a name has up to 40 letters, digits, _ and -, and begins with a letter"
    elif fold(name) in RESERVED:
        reason = f"the name {name} is reserved, or looks like one that is"
    elif fold(name) in taken:
        reason = f"another entry has the name {name}, or one that looks like it"
    else:
        return Entry(name=name, reference=reference, **known)
    raise EntryError(f"its entry cannot be named so: {reason}")


def _name_of(given: str) -> str:
    """Return the name of an entry that has been given as a path, "module:Class" or name."""
    path = Path(given)
    if entry_files.CLASS_REFERENCE.fullmatch(given):
        return given.rpartition(":")[2].rpartition(".")[2]
    return path.name.partition("-")[0] if path.suffix == ".whl" else path.stem


def _free_name(name: str, taken: set[str]) -> str:
    """Return an allowed name like `name` that is neither reserved nor taken."""
    name = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:30]
    name = name if NAME.fullmatch(name) else f"entry_{name}"
    choices = itertools.chain([name], (f"{name}_{k}" for k in itertools.count(2)))
    return next(x for x in choices if fold(x) not in taken | RESERVED)


def _included_weights(estimator: Any) -> Mapping[str, np.ndarray] | None:
    """Return the weights that an estimator already has; None if it has none or will be trained."""
    if not isinstance(estimator, Trainable):
        return None
    if isinstance(estimator, Pretrained) and estimator.name in estimators.REGISTRY:
        if estimator.fitted_state is None and estimator == estimators.create(estimator.name):
            # read from the file of the package: no network has to be built for it
            return pretrained_weights.load_pretrained(estimator.name)
    return None if needs_training(estimator) else estimator.weights()


def _arrays_digest(arrays: Mapping[str, np.ndarray]) -> str:
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype} {array.shape}".encode())
        total.update(array.tobytes())
    return total.hexdigest()[:16]
