"""Weights in safetensors files (no pickle), including those shipped with the package.

    estimators/weights/<name>.safetensors

The metadata of a file holds, as text: format, package version, command, seed and digest of the
configuration that produced it.
"""

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np

from road_envs.core.atomic_io import atomic_write
from road_envs.core.extras import optional_import
from road_envs.core.reading import parsing

FOLDER = Path(__file__).parent / "weights"
SUFFIX = ".safetensors"
_METADATA_KEY = "about"  # key of the single metadata entry; its value is JSON


class StorageError(ValueError):
    """A file without usable weights or estimator, or an estimator that cannot be stored."""


def write_weights(
    path: str | Path, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]
) -> None:
    """Write `arrays` and their `metadata` to `path` atomically."""
    with optional_import("a file of weights"):
        from safetensors.numpy import save

    solid = {name: np.array(array, order="C") for name, array in arrays.items()}
    # one entry only: safetensors writes several in an order that varies between files
    about = {_METADATA_KEY: json.dumps(dict(metadata), sort_keys=True)}
    with atomic_write(path, durable=True) as partial:
        partial.write_bytes(save(solid, metadata=about))


def read_weights(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the arrays and metadata that `write_weights` stored. Raises StorageError."""
    with optional_import("a file of weights"):
        from safetensors import safe_open

    with parsing(path, StorageError, "damaged or not a safetensors file"):
        Path(path).open("rb").close()  # its own error of a missing file has no reason
        with safe_open(path, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}
            metadata = json.loads((file.metadata() or {}).get(_METADATA_KEY, "{}"))
        if not isinstance(metadata, dict):
            raise StorageError(f"its metadata {_METADATA_KEY!r} are not a mapping")
        return arrays, metadata


@cache
def load_pretrained(name: str) -> dict[str, np.ndarray] | None:
    """Return the read-only weights shipped for the estimator `name`, or None."""
    path = FOLDER / f"{name}{SUFFIX}"
    if not path.is_file():
        return None
    arrays, _ = read_weights(path)
    for array in arrays.values():
        array.flags.writeable = False
    return arrays
