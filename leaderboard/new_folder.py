"""Folders that appear whole or not at all."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from road_envs.core.atomic_io import PARTIAL_SUFFIX
from road_envs.core.config import ConfigError


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside `path`, which gets that name when the block ends.

    If the block raises, the folder is removed. Raises ConfigError if `path` exists.
    """
    if path.exists():
        raise ConfigError(f"{path} exists; give a folder that does not")
    partial = path.with_name(f".{path.name}{PARTIAL_SUFFIX}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        partial.rename(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
