"""Who is judged: an entry by name, with what it takes to make it anywhere and to know it again.

An estimator of this package is made here. One of another package, or from a file, is not loaded by
the judge: it describes itself in a process of its own.
"""

import hashlib
import importlib
import json
import re
from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import estimators
from estimators import pretrained_weights as shelf
from estimators import weights_io
from estimators.api import Estimator, Trainable, check_class
from leaderboard.evaluation.code_version import module_version
from leaderboard.evaluation.entry import BUILTIN, Entry, EntryError, get_settings, needs_training
from road_envs.config import ConfigError, build, validate_choice

CLASS_REFERENCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
"""How a class of an importable module is named."""


class SupportsDescribe(Protocol):
    """Describes estimators that this process does not load, such as `SandboxClient`."""

    def describe(self, reference: str, settings: Mapping[str, Any]) -> dict[str, Any]: ...


def make_estimator(reference: str, settings: Mapping[str, Any]) -> Estimator:
    """The estimator that a reference names. Raises ConfigError and whatever its code raises."""
    if reference.endswith(".npz"):
        return weights_io.load(reference)
    if ":" not in reference:
        return estimators.create(reference, **settings)
    module, _, name = reference.partition(":")
    cls: Any = attrgetter(name)(importlib.import_module(module))
    return build(check_class(cls), settings, name)


def describe(reference: str, estimator: Estimator) -> dict[str, Any]:
    """Settings, causality, lag and version of an estimator, as JSON types."""
    code = module_version(type(estimator).__module__)
    if (weights := _included_weights(estimator)) is not None:
        code = f"{code}+{_arrays_digest(weights)}"
    return {
        "settings": json.loads(json.dumps(get_settings(estimator), default=str)),
        "causal": getattr(estimator, "causal", None),
        "lag": float(getattr(estimator, "lag", None) or 0.0),
        "code": code,
    }


def make_entry(name: str, estimator: Estimator | None) -> Entry:
    """The entry of an estimator that stands in this process; None is the judge's noisy truth."""
    if estimator is None:
        return Entry(name=name, reference=BUILTIN)
    cls: Any = type(estimator)
    registered = next((key for key, known in estimators.REGISTRY.items() if known is cls), None)
    reference = registered or f"{cls.__module__}:{cls.__qualname__}"
    return Entry(name=name, reference=reference, **describe(reference, estimator))


def resolve_entries(names: Sequence[str], describer: SupportsDescribe | None) -> list[Entry]:
    """Entries by registered name, .npz file or "module:Class"; those not of this package need a
    `describer`. One that cannot be made is an entry with a failure. Raises ConfigError for an
    unknown name.
    """
    known = estimators.names()
    for name in names:
        if name.endswith(".npz"):
            if not Path(name).is_file():
                raise ConfigError(f"{name}: there is no such file")
        elif not CLASS_REFERENCE.fullmatch(name):
            validate_choice("estimator", name, known)
    return [_resolve_entry(name, describer) for name in names]


def registered_entry(name: str, each_case: bool) -> Entry | None:
    """The entry of an estimator of this package as it would be judged now; None for any other."""
    if name not in estimators.REGISTRY:
        return None
    entry = make_entry(name, estimators.create(name))
    return entry_refit_per_case(entry) if each_case else entry


def entry_refit_per_case(entry: Entry) -> Entry:
    """The entry as it is judged where the protocol wants a training of its own for each case: it
    leaves the weights at home that it comes with, if it can be fitted to a case in seconds.
    """
    cls = estimators.REGISTRY.get(entry.reference)
    if entry.failure is not None or not getattr(cls, "refit_per_case", False):
        return entry
    settings = {**entry.settings, "shipped": False}
    return make_entry(entry.name, estimators.create(entry.reference, **settings))


def _resolve_entry(name: str, describer: SupportsDescribe | None) -> Entry:
    if name in estimators.REGISTRY or describer is None:
        return make_entry(name, estimators.create(name))
    is_file = name.endswith(".npz")
    known: dict[str, Any] = {
        "name": Path(name).stem if is_file else name.rpartition(":")[2],
        "reference": str(Path(name).resolve()) if is_file else name,
    }
    try:
        return build(Entry, {**known, **describer.describe(known["reference"], {})}, name)
    except (EntryError, ConfigError) as error:
        return Entry(**known, failure=str(error))


def _included_weights(estimator: Any) -> Mapping[str, np.ndarray] | None:
    """What an estimator brings that it has learnt. If these are the weights that come with this
    package, they are read as they stand in their file: a network need not be built for it.
    """
    if not isinstance(estimator, Trainable):
        return None
    name = getattr(estimator, "name", "")
    if name in estimators.REGISTRY and getattr(estimator, "fitted_state", estimator) is None:
        if estimator == estimators.create(name):
            return shelf.load_pretrained(name)
    return None if needs_training(estimator) else estimator.weights()


def _arrays_digest(arrays: Mapping[str, np.ndarray]) -> str:
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype} {array.shape}".encode())
        total.update(array.tobytes())
    return total.hexdigest()[:16]
