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
from leaderboard.evaluation.code_version import code_of
from leaderboard.evaluation.entry import JUDGES_OWN, Entry, EntryError, learns, settings_of
from road_envs.config import ConfigError, build, one_of

CLASS = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
"""How a class of an importable module is named."""


class Describes(Protocol):
    """Something that has an estimator describe itself, such as `isolation.host.Host`."""

    def describe(self, reference: str, settings: Mapping[str, Any]) -> dict[str, Any]: ...


def make(reference: str, settings: Mapping[str, Any]) -> Estimator:
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
    code = code_of(type(estimator).__module__)
    if (weights := _weights_of(estimator)) is not None:
        code = f"{code}+{_digest_of(weights)}"
    return {
        "settings": json.loads(json.dumps(settings_of(estimator), default=str)),
        "causal": getattr(estimator, "causal", None),
        "lag": float(getattr(estimator, "lag", None) or 0.0),
        "code": code,
    }


def entry_of(name: str, estimator: Estimator | None) -> Entry:
    """The entry of an estimator that stands in this process; None is the judge's noisy truth."""
    if estimator is None:
        return Entry(name=name, reference=JUDGES_OWN)
    cls: Any = type(estimator)
    registered = next((key for key, known in estimators.REGISTRY.items() if known is cls), None)
    reference = registered or f"{cls.__module__}:{cls.__qualname__}"
    return Entry(name=name, reference=reference, **describe(reference, estimator))


def named(names: Sequence[str], host: Describes | None) -> list[Entry]:
    """Entries by registered name, .npz file or "module:Class"; those not of this package need a
    `host`. One that cannot be made is an entry with a failure. Raises ConfigError for an unknown
    name.
    """
    known = estimators.names()
    for name in names:
        if name.endswith(".npz"):
            if not Path(name).is_file():
                raise ConfigError(f"{name}: there is no such file")
        elif not CLASS.fullmatch(name):
            one_of("estimator", name, known)
    return [_named(name, host) for name in names]


def registered(name: str, each_case: bool) -> Entry | None:
    """The entry of an estimator of this package as it would be judged now; None for any other."""
    if name not in estimators.REGISTRY:
        return None
    entry = entry_of(name, estimators.create(name))
    return fitted_to_each_case(entry) if each_case else entry


def fitted_to_each_case(entry: Entry) -> Entry:
    """The entry as it is judged where the protocol wants a training of its own for each case: it
    leaves the weights at home that it comes with, if it can be fitted to a case in seconds.
    """
    cls = estimators.REGISTRY.get(entry.reference)
    if entry.failure is not None or not getattr(cls, "fits_a_case", False):
        return entry
    settings = {**entry.settings, "shipped": False}
    return entry_of(entry.name, estimators.create(entry.reference, **settings))


def _named(name: str, host: Describes | None) -> Entry:
    if name in estimators.REGISTRY or host is None:
        return entry_of(name, estimators.create(name))
    is_file = name.endswith(".npz")
    known: dict[str, Any] = {
        "name": Path(name).stem if is_file else name.rpartition(":")[2],
        "reference": str(Path(name).resolve()) if is_file else name,
    }
    try:
        return build(Entry, {**known, **host.describe(known["reference"], {})}, name)
    except (EntryError, ConfigError) as error:
        return Entry(**known, failure=str(error))


def _weights_of(estimator: Any) -> Mapping[str, np.ndarray] | None:
    """What an estimator brings that it has learnt. If these are the weights that come with this
    package, they are read as they stand in their file: a network need not be built for it.
    """
    if not isinstance(estimator, Trainable):
        return None
    name = getattr(estimator, "name", "")
    if name in estimators.REGISTRY and getattr(estimator, "learnt", estimator) is None:
        if estimator == estimators.create(name):
            return shelf.shipped(name)
    return None if learns(estimator) else estimator.weights()


def _digest_of(arrays: Mapping[str, np.ndarray]) -> str:
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype} {array.shape}".encode())
        total.update(array.tobytes())
    return total.hexdigest()[:16]
