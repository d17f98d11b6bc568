"""Storage of an estimator (name, settings and weights) in one file without pickle.

In an `.npz` file the array `header` holds JSON with format, package version, estimator name and
settings; the weights are the arrays `weights.<name>`. In a `.safetensors` file the header is an
entry of the metadata.
"""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from estimators.api import Estimator, Trainable
from estimators.pretrained_weights import SUFFIX, StorageError, read_weights, write_weights
from estimators.registry import available, create
from road_envs._version import __version__
from road_envs.core.atomic_io import atomic_write
from road_envs.core.reading import parsing, read_npz

_FORMAT = "roadrecon estimator 1"
_WEIGHT_PREFIX = "weights."  # of their names in an `.npz` file, apart from the header


def save(estimator: Estimator, path: str | Path, metadata: Mapping[str, str] | None = None) -> None:
    """Write an estimator to `path` atomically; `metadata` is stored in a `.safetensors` file only.
    Raises StorageError if its class is not registered, NotFittedError if it has no weights.
    """
    path, kind = Path(path), cast(Any, type(estimator))
    name = next((name for name, cls in available().items() if cls is kind), None)
    if name is None:
        raise StorageError(
            f"{kind.__name__} is not a registered estimator and cannot be stored: name it in "
            "estimators/registry.py, or by an entry point of its package"
        )
    header = {
        "format": _FORMAT,
        "version": __version__,
        "name": name,
        "settings": {f.name: getattr(estimator, f.name) for f in fields(kind) if f.init},
    }
    weights = estimator.weights() if isinstance(estimator, Trainable) else {}
    if path.suffix == SUFFIX:
        write_weights(path, weights, {**(metadata or {}), "header": json.dumps(header)})
        return
    arrays: dict[str, Any] = {_WEIGHT_PREFIX + key: value for key, value in weights.items()}
    with atomic_write(path, durable=True) as partial, partial.open("wb") as file:
        np.savez(file, header=np.array(json.dumps(header)), **arrays)


def load(path: str | Path) -> Estimator:
    """Return the estimator stored by `save`. Raises StorageError."""
    path = Path(path)
    if path.suffix == SUFFIX:
        weights, metadata = read_weights(path)
    else:
        with parsing(path, StorageError, "damaged or not an .npz file of RoadRecon"):
            arrays = read_npz(path)
        metadata = {"header": str(arrays.pop("header"))} if "header" in arrays else {}
        weights = {name.removeprefix(_WEIGHT_PREFIX): x for name, x in arrays.items()}
    with parsing(path, StorageError, "not a usable RoadRecon estimator"):
        header = json.loads(metadata["header"])
        if header["format"] != _FORMAT:
            raise StorageError(
                f"format {header['format']!r} is not supported, expected {_FORMAT!r}: train the "
                "estimator again, or read it with the version that has written it"
            )
        estimator = create(header["name"], **header["settings"])
        return estimator.with_weights(weights) if isinstance(estimator, Trainable) else estimator
