"""Resource limits and environment variables of an entry's process."""

import os
import site
import sys
from dataclasses import dataclass
from pathlib import Path

from road_envs.config import STRICT

GIB = 2**30

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""Set to 1, so that sums have the same order on every machine and times can be compared."""

INHERITED_VARIABLES = ("PATH", "LANG", "LC_ALL", "TZ", "VIRTUAL_ENV", "LD_LIBRARY_PATH")
"""Environment variables that an entry inherits."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Resource limits of one run of an entry, which has all its trainings under one condition."""

    __pydantic_config__ = STRICT

    seconds: float = 1800.0
    memory: float = 4.0  # [GiB] of all its processes together
    processes: int = 64
    file: float = 1.0  # [GiB] of each file that it writes
    namespaces: bool = True  # use them where the platform grants them

    def __post_init__(self):
        for name in ("seconds", "memory", "processes", "file"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


def cache_home() -> Path:
    """Return the parent folder of the kernel cache, as in `road_envs._numba`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def worker_environment(folder: Path) -> dict[str, str]:
    """Return the environment of an entry with the working directory `folder`."""
    inherited = {name: os.environ[name] for name in INHERITED_VARIABLES if name in os.environ}
    return {
        **inherited,
        **dict.fromkeys(THREAD_VARIABLES, "1"),
        "HOME": str(folder),
        "TMPDIR": str(folder),
        "XDG_CACHE_HOME": str(cache_home()),
        "PYTHONUSERBASE": site.getuserbase(),
        "PYTHONHASHSEED": "0",
        "PYTHONPATH": os.pathsep.join(os.path.abspath(path) for path in sys.path),
        # the server forks, so no library may start threads when it is imported
        "JE_ARROW_MALLOC_CONF": "background_thread:false",
    }
