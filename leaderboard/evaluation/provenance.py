"""Provenance of a result: versions, commit and machine, stored with every result."""

import hashlib
import os
import platform
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path

import road_envs
from road_envs.core.code_digest import PACKAGES, ROOT

LIBRARIES = ("numpy", "scipy", "numba", "torch")


def package_version() -> str:
    """Return the version of road-envs."""
    return road_envs.__version__


@cache
def source_digest() -> str:
    """Return a digest of all source files of this project; any edit changes it."""
    sources = sorted(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]


@cache
def describe_environment() -> dict[str, str]:
    """Return Python, libraries, source digest, commit (in a checkout), processor and system."""
    libraries = {name: release for name in LIBRARIES if (release := _library(name))}
    commit = _commit(ROOT)
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
    """Return the commit of a checkout, with "+" if files have changed; None outside a checkout."""
    if not (folder / ".git").exists():
        return None
    try:
        commit = _git(folder, "rev-parse", "--short=12", "HEAD")
        return commit + ("+" if _git(folder, "status", "--porcelain") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    process = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    return process.stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
