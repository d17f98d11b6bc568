"""What an entry may use, and the environment that it gets."""

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
"""Set to 1: sums are taken in one order whatever the machine, and times can be compared."""

INHERITED_VARIABLES = ("PATH", "LANG", "LC_ALL", "TZ", "VIRTUAL_ENV", "LD_LIBRARY_PATH")
"""All that an entry gets of the judge's environment."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What one run of an entry, with all its trainings under one condition, may use."""

    __pydantic_config__ = STRICT

    seconds: float = 1800.0
    memory: float = 4.0  # [GiB] of all its processes together
    processes: int = 64
    file: float = 1.0  # [GiB] of any file it writes
    namespaces: bool = True  # where the platform grants them

    def __post_init__(self):
        for name in ("seconds", "memory", "processes", "file"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


def cache_home() -> Path:
    """Where compiled kernels are kept, as `road_envs._numba` finds it."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def worker_environment(folder: Path) -> dict[str, str]:
    """The environment of an entry that works in `folder`."""
    kept = {name: os.environ[name] for name in INHERITED_VARIABLES if name in os.environ}
    return {
        **kept,
        **dict.fromkeys(THREAD_VARIABLES, "1"),
        "HOME": str(folder),
        "TMPDIR": str(folder),
        "XDG_CACHE_HOME": str(cache_home()),
        "PYTHONUSERBASE": site.getuserbase(),
        "PYTHONHASHSEED": "0",
        "PYTHONPATH": os.pathsep.join(os.path.abspath(path) for path in sys.path),
        # the server forks, so a library must not start threads when it is loaded
        "JE_ARROW_MALLOC_CONF": "background_thread:false",
    }
