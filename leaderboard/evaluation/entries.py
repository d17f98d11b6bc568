"""Entries from the names of estimators, with the settings and versions that identify them.

Estimators of this package are constructed here. Estimators of other packages or from files are
not loaded by the evaluation: a separate process describes them.
"""

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import estimators
from estimators import pretrained_weights
from estimators.api import Estimator, Pretrained, Trainable, declared_lag, refits_per_case
from leaderboard.evaluation.code_version import module_version
from leaderboard.evaluation.entry import BUILTIN, Entry, EntryError, get_settings, needs_training
from road_envs.config import ConfigError, build, validate_choice

CLASS_REFERENCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
"""Pattern of a reference to a class of an importable module, "module:Class"."""


class SupportsDescribe(Protocol):
    """Describes estimators that this process does not load, such as `SandboxClient`."""

    def describe(self, reference: str, settings: Mapping[str, Any]) -> dict[str, Any]: ...


def describe(reference: str, estimator: Estimator) -> dict[str, Any]:
    """Return settings, causality, lag [m] and version of an estimator, as JSON types."""
    code = module_version(type(estimator).__module__)
    if (weights := _included_weights(estimator)) is not None:
        code = f"{code}+{_arrays_digest(weights)}"
    return {
        "settings": json.loads(json.dumps(get_settings(estimator), default=str)),
        "causal": estimator.causal,
        "lag": declared_lag(estimator),
        "code": code,
    }


def make_entry(name: str, estimator: Estimator | None) -> Entry:
    """Return the entry of an estimator of this process; None is made by the evaluation."""
    if estimator is None:
        return Entry(name=name, reference=BUILTIN)
    cls: Any = type(estimator)
    registered = next((key for key, known in estimators.REGISTRY.items() if known is cls), None)
    reference = registered or f"{cls.__module__}:{cls.__qualname__}"
    return Entry(name=name, reference=reference, **describe(reference, estimator))


def resolve_entries(names: Sequence[str], describer: SupportsDescribe | None) -> list[Entry]:
    """Return entries by registered name, .npz file or "module:Class".

    Estimators of other packages need a `describer`. An estimator that cannot be constructed gives
    an entry with a failure. Raises ConfigError for an unknown name.
    """
    known = estimators.names()
    for name in names:
        if name.endswith(".npz"):
            if not Path(name).is_file():
                raise ConfigError(f"{name}: no such file; give an .npz from `train`")
        elif not CLASS_REFERENCE.fullmatch(name):
            validate_choice("estimator", name, known)
    return [_resolve_entry(name, describer) for name in names]


def registered_entry(name: str, each_case: bool) -> Entry | None:
    """Return the entry of an estimator of this package as it is now; None for any other name."""
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
    if not refits_per_case(estimators.create(entry.reference, **entry.settings)):
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
