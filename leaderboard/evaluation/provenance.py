"""Where numbers were made: versions, commit and machine, stored beside every result."""

import hashlib
import os
import platform
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path

import road_envs

PACKAGES = ("road_envs", "estimators", "leaderboard")
LIBRARIES = ("numpy", "scipy", "numba", "torch")


def package_version() -> str:
    """Return the version of road-envs."""
    return road_envs.__version__


@cache
def source_digest() -> str:
    """Digest of the sources of this project: any edit makes another one."""
    folder = Path(__file__).parents[2]
    sources = sorted(path for name in PACKAGES for path in (folder / name).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]


@cache
def describe_environment() -> dict[str, str]:
    """Python, libraries, sources, commit (in a checkout), processor and operating system."""
    libraries = {name: found for name in LIBRARIES if (found := _library(name))}
    commit = _commit(Path(__file__).parents[2])
    return {
        "python": platform.python_version(),
        **libraries,
        "code": source_digest(),
        **({"commit": commit} if commit else {}),
        "processor": f"{_processor()}, {os.cpu_count()} cores",
        "system": f"{platform.system()} {platform.machine()}",
    }


def _library(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _commit(folder: Path) -> str | None:
    """The commit of a checkout, with a + if files have changed since; None outside of one."""
    if not (folder / ".git").exists():
        return None
    try:
        commit = _git(folder, "rev-parse", "--short=12", "HEAD")
        return commit + ("+" if _git(folder, "status", "--porcelain") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(folder: Path, *words: str) -> str:
    command = ["git", "-C", str(folder), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    return done.stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
