"""Resource limits and environment variables of a guest."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from road_envs.core.code_digest import ROOT
from road_envs.core.config import Count, Positive, Settings

GIB = 2**30

THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMBA_NUM_THREADS",
)  # fmt: skip
"""Set to 1 in processes of jobs and in guests: sums have one order and times can be compared."""

KERNEL_VARIABLES = (
    "OPENBLAS_CORETYPE", "MKL_CBWR", "MKL_ENABLE_INSTRUCTIONS", "BLIS_ARCH_TYPE",
    "NPY_DISABLE_CPU_FEATURES", "NPY_ENABLE_CPU_FEATURES", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES",
    "ATEN_CPU_CAPABILITY", "DNNL_MAX_CPU_ISA", "ONEDNN_MAX_CPU_ISA", "OMP_DYNAMIC", "OMP_SCHEDULE",
)  # fmt: skip
"""Variables that choose the kernels of BLAS, NumPy, Numba and torch and the schedule of OpenMP: a
guest has those of its judge, so that both compute with the same ones.
"""

SET_FOR_ALL = (*THREAD_VARIABLES, "PYTHONPATH", "JE_ARROW_MALLOC_CONF")
"""Environment variables of a guest that the processes of jobs have, too."""

INHERITED_VARIABLES = ("PATH", "TZ", "VIRTUAL_ENV", "LD_LIBRARY_PATH", *KERNEL_VARIABLES)
"""Environment variables that a guest inherits."""

Isolation = Literal["auto", "bubblewrap", "process"]


@dataclass(frozen=True, kw_only=True)
class Limits(Settings):
    """Resource limits of one run of an entry, which has all its trainings under one condition.

    `isolation` is "bubblewrap"; or "process", which gives every entry the rights of the user; or
    "auto": bubblewrap where it is available, else processes for the estimators of this package,
    and no others.
    """

    seconds: Positive = 1800.0
    memory: Annotated[Positive, "GiB", "of all its processes together"] = 4.0
    processes: Count = 64
    file: Annotated[
        Positive, "GiB", "of each file that it writes, and of all its files under bubblewrap"
    ] = 1.0
    isolation: Isolation = "auto"


UNLIMITED = Limits(seconds=1e9, memory=1e6, processes=10**6, file=1e6)  # of this package


def guest_environment(home: Path, *, whole_path: bool) -> dict[str, str]:
    """Return the environment of a guest whose working folder is `home`.

    With `whole_path` it can import what this process can.
    """
    inherited = {name: os.environ[name] for name in INHERITED_VARIABLES if name in os.environ}
    path = [os.path.abspath(entry) for entry in sys.path] if whole_path else [str(ROOT)]
    return {
        **inherited,
        **dict.fromkeys(THREAD_VARIABLES, "1"),
        "HOME": str(home),
        "TMPDIR": str(home),
        "USER": "guest",
        "LANG": "C.UTF-8",
        "PYTHONHASHSEED": "0",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONNOUSERSITE": "1",
        "PYTHONPATH": os.pathsep.join(path),
        # the worker forks, so no library may start threads when it is imported
        "JE_ARROW_MALLOC_CONF": "background_thread:false",
    }
