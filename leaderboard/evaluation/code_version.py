"""Which source files a piece of code is made of, and a digest of them: its version.

Inside this project the files are found by following import statements, wherever they stand, so
that an edit voids the results that it may have changed and no others. Of another package every
file counts, weights included.
"""

import ast
import hashlib
import importlib.util
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

PACKAGES = ("road_envs", "estimators", "leaderboard")
ROOT = Path(__file__).parents[2]

JUDGE = "leaderboard.evaluation.evaluate"
"""Everything that decides drives and scores is imported from here on."""


@cache
def judge_code() -> str:
    """Version of what makes drives and scores."""
    return digest(closure(JUDGE))


def code_of(module: str) -> str:
    """Version of the code in a module and of what it is made of."""
    top = module.partition(".")[0]
    return digest(closure(module) if top in PACKAGES else _package(top))


@cache
def closure(module: str, root: Path = ROOT) -> tuple[Path, ...]:
    """The files of this project that a module reaches by imports, its own first."""
    found: dict[Path, None] = {}
    front = [path] if (path := _file(module, root)) else []
    while front:
        path = front.pop()
        if path not in found:
            found[path] = None
            front += _imported(path, root)
    return tuple(found)


def digest(paths: Iterable[Path], root: Path = ROOT) -> str:
    """A digest (16 hex digits) of names and contents, in any order of `paths`."""
    total = hashlib.sha256()
    for path in sorted(paths):
        name = path.relative_to(root) if path.is_relative_to(root) else path.name
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{Path(name).as_posix()} {content}\n".encode())
    return total.hexdigest()[:16]


@cache
def _imported(path: Path, root: Path) -> tuple[Path, ...]:
    """The files of this project that a file names in import statements."""
    return tuple(other for name in _imports(path, root) if (other := _file(name, root)))


def _imports(path: Path, root: Path) -> Iterator[str]:
    """Modules that a file names; of `from a import b` the module a.b, or a where b is none."""
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if _file(inner, root) else node.module


def _file(module: str, root: Path) -> Path | None:
    """The source of a module of this project."""
    if module.partition(".")[0] not in PACKAGES:
        return None
    path = root.joinpath(*module.split("."))
    choices = (path.with_suffix(".py"), path / "__init__.py")
    return next((choice for choice in choices if choice.is_file()), None)


def _package(top: str) -> list[Path]:
    """All files of another package, or the one file of a module."""
    spec = importlib.util.find_spec(top)
    folders = [Path(folder) for folder in (spec.submodule_search_locations or ())] if spec else []
    if folders:
        files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
        return [path for path in files if "__pycache__" not in path.parts]
    return [Path(spec.origin)] if spec and spec.origin and Path(spec.origin).is_file() else []
