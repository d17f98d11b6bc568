"""How the numerical kernels are compiled.

A kernel is a module-level function of scalars, arrays and records of numbers; it writes into
arrays handed to it, calls other kernels directly and never receives a function as argument.
Numba's disk cache watches only the file a function stands in, so a change in a callee would go
unseen by its callers. The cache folder is therefore named after the text of this whole package, and
for kernels of another package after that of its files with kernels too: any edit starts afresh.
"""

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def _cache_folder() -> Path:
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        home.mkdir(parents=True, exist_ok=True)
        usable = os.access(home, os.W_OK)
    except OSError:
        usable = False
    return (
        (home if usable else Path(tempfile.gettempdir()))
        / "roadrecon"
        / _digest(b"".join(_text(HERE)))
    )


def _digest(sources: bytes) -> str:
    return hashlib.sha256(sources).hexdigest()[:12]


def _text(folder: Path) -> list[bytes]:
    return [f.read_bytes() for f in sorted(folder.rglob("*.py"))]


HERE = Path(__file__).parent
CACHE = _cache_folder()
"""Where compiled kernels are kept."""


@cache
def cache_of(name: str) -> Path:
    """Where the compiled kernels of a top-level package or module are kept."""
    module = sys.modules.get(name)
    folders = [Path(folder) for folder in getattr(module, "__path__", ())]
    if not folders or HERE in folders:
        return CACHE
    texts = [text for folder in folders for text in _text(folder) if __name__.encode() in text]
    return CACHE / _digest(b"".join(texts))


def kernel(function: F) -> F:
    """`numba.njit`, cached on disk and inlined into every caller (2.5 times faster than calls).

    IEEE arithmetic, except that a*b + c may be contracted and x / c become x * (1 / c).
    """
    return _compiled(function, inlined=True)


def separate(function: F) -> F:
    """As `kernel`, but called: for what is large and called seldom, so that it compiles once."""
    return _compiled(function, inlined=False)


def _compiled(function: F, inlined: bool) -> F:
    settings: Any = numba.config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(cache_of(function.__module__.partition(".")[0]))
    try:
        compiled: Any = numba.njit(
            cache=True,
            error_model="numpy",
            fastmath={"contract", "arcp"},
            forceinline=inlined,
            nogil=True,
        )(function)
    finally:
        settings.CACHE_DIR = before
    return compiled
