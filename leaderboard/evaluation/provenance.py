"""Provenance of a result: versions, commit and machine, stored with every result."""

import os
import platform
import subprocess
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path

import road_envs
from road_envs.core import config
from road_envs.core.code_digest import PACKAGES, ROOT, digest


def package_version() -> str:
    """Return the version of road-envs."""
    return road_envs.__version__


LIBRARIES = ("numpy", "scipy", "numba", "torch")
"""Distributions whose versions stand in the environment of every result."""


@cache
def describe_environment() -> dict[str, str]:
    """Return what may decide the digits of a result: versions, commit (in a checkout), machine.

    `blas` is the kernel that BLAS has chosen for the processor, `threads` how many share a product.
    """
    libraries = {}
    for name in LIBRARIES:
        with suppress(metadata.PackageNotFoundError):
            libraries[name] = metadata.version(name)
    commit = _commit(ROOT)
    return {
        "python": platform.python_version(),
        **libraries,
        "code": package_code(),
        **({"commit": commit} if commit else {}),
        "processor": f"{_processor()}, {os.cpu_count()} cores",
        **_blas(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def read_package_code() -> str:
    """Return a digest of the code, weights and configurations of this project, as they are now: an
    entry by others can build on any of them.
    """
    own = [path for name in PACKAGES for path in (ROOT / name).rglob("*.*")]
    code = digest(path for path in own if path.suffix in (".py", ".safetensors"))
    configs = config.folder()
    shows = configs / "boards"  # they change no result
    return code + digest((x for x in configs.rglob("*.*") if x.parent != shows), configs.parent)


package_code = cache(read_package_code)
"""That digest as it was when this process asked first."""


def _blas() -> dict[str, str]:
    """Return the kernels and the number of threads of the BLAS libraries of NumPy and SciPy."""
    import scipy.linalg  # noqa: F401  loads the BLAS of SciPy

    try:
        from threadpoolctl import threadpool_info
    except ImportError:  # no extra is installed
        return {}
    pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    kernels = dict.fromkeys(
        f"{pool['internal_api']} {pool.get('architecture', '')}".strip() for pool in pools
    )
    threads = max((pool["num_threads"] for pool in pools), default=1)
    return {"blas": ", ".join(kernels) or "unknown", "threads": str(threads)}


def _commit(folder: Path) -> str | None:
    """Return the commit of a checkout, with "+" if files have changed; None outside a checkout."""
    if not (folder / ".git").exists():
        return None
    words = ["describe", "--always", "--exclude=*", "--abbrev=12", "--dirty=+"]
    command = ["git", "-C", str(folder), *words]
    try:
        process = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return process.stdout.strip()


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
