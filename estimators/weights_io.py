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

from estimators import pretrained_weights
from estimators.api import Estimator, Trainable
from estimators.registry import available, create
from road_envs._version import __version__
from road_envs.core.atomic_io import atomic_write
from road_envs.core.reading import parsing, read_npz

_FORMAT = "roadrecon estimator 1"
# Prefix of the weights' names in an `.npz` file; keeps them apart from the header
_WEIGHT_PREFIX = "weights."


class StorageError(ValueError):
    """A file without a usable estimator, or an estimator that cannot be stored."""


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
    if path.suffix == pretrained_weights.SUFFIX:
        pretrained_weights.write_weights(
            path, weights, {**(metadata or {}), "header": json.dumps(header)}
        )
        return
    arrays: dict[str, Any] = {_WEIGHT_PREFIX + key: value for key, value in weights.items()}
    with atomic_write(path, durable=True) as partial, partial.open("wb") as file:
        np.savez(file, header=np.array(json.dumps(header)), **arrays)


def load(path: str | Path) -> Estimator:
    """Return the estimator stored by `save`. Raises StorageError."""
    weights, metadata = _read(Path(path))
    with parsing(path, StorageError, "not a usable RoadRecon estimator"):
        header = json.loads(metadata["header"])
        if header["format"] != _FORMAT:
            raise StorageError(
                f"format {header['format']!r} is not supported, expected {_FORMAT!r}: train the "
                "estimator again, or read it with the version that has written it"
            )
        estimator = create(header["name"], **header["settings"])
        return estimator.with_weights(weights) if isinstance(estimator, Trainable) else estimator


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return weights and metadata of a file. Raises StorageError."""
    if path.suffix == pretrained_weights.SUFFIX:
        try:
            return pretrained_weights.read_weights(path)
        except pretrained_weights.WeightsError as error:
            raise StorageError(str(error)) from None
    with parsing(path, StorageError, "damaged or not an .npz file of RoadRecon"):
        arrays = {name.removeprefix(_WEIGHT_PREFIX): x for name, x in read_npz(path).items()}
    header = arrays.pop("header", None)
    return arrays, {} if header is None else {"header": str(header)}
