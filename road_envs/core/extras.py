"""Optional dependencies: which extra of the distribution brings them, and a clear error without."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

EXTRAS = {
    "learn": ("torch", "stable_baselines3", "safetensors"),
    "board": ("typer", "rich", "jinja2", "matplotlib", "pyarrow", "pandas"),
    "render": ("PIL",),
    "dask": ("distributed",),
    "mdf": ("asammdf",),
    "ros": ("mcap", "lz4", "zstandard"),
    "minari": ("minari",),
    "plants": ("mujoco", "vehiclemodels"),
    "sign": ("cryptography",),
}
"""Top-level modules of other packages, by the extra that brings them."""


class MissingExtraError(ImportError):
    """An optional package is not installed; the message says what to install."""


@contextmanager
def optional_import(purpose: str) -> Iterator[None]:
    """Turn a failed import inside the block into a MissingExtraError: `purpose` needs the extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtraError(missing_extra(error, purpose)) from error


def import_pandas() -> Any:
    """Return `pandas`, for a table in a file. Raises MissingExtraError."""
    with optional_import("a table as CSV or Parquet"):
        import pandas as pd

    return pd


def import_pyarrow() -> tuple[Any, Any]:
    """Return `pyarrow` and `pyarrow.parquet`. Raises MissingExtraError."""
    with optional_import("a table as CSV or Parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq

    return pa, pq


def missing_extra(error: ModuleNotFoundError, purpose: str) -> str:
    """Return one sentence on what is missing for `purpose` and how to install it."""
    module = (error.name or "").partition(".")[0]
    extra = next((name for name, modules in EXTRAS.items() if module in modules), None)
    if extra is None:
        return f"{purpose} needs the package {module!r}, which is not installed"
    needs = f"{purpose} needs the extra {extra!r} (no module named {module!r})"
    return f"{needs}: pip install 'road-envs[{extra}]'"
