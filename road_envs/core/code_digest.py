"""Digests of source code that change when the code does, and not with its comments or docstrings.

A file counts by its syntax tree without docstrings, which is the same in every version of Python;
which files belong together is found by following import statements. Both are remembered by the
content of the file.
"""

import ast
import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from road_envs.core.atomic_io import write_text

ROOT = Path(__file__).parents[2]  # folder that holds the packages of this project

PACKAGES = ("road_envs", "estimators", "leaderboard")
DIGESTED = (*PACKAGES, "studies")  # imports of these are followed; studies are in a checkout alone
DIGITS = 16  # hex digits of a digest
LARGEST_MEMORY = 1000  # most files that are remembered from one process to the next


class _Source(NamedTuple):
    """One Python file: digest of its code, and what it imports of this project.

    `imports` holds "a" for `import a` and "a:b" for `from a import b`: a.b, or a if b is no module.
    """

    digest: str
    imports: tuple[str, ...]


def cache_home() -> Path:
    """Folder for what can be computed again: XDG_CACHE_HOME, ~/.cache or the temporary folder."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    with suppress(OSError):
        home.mkdir(parents=True, exist_ok=True)
        if os.access(home, os.W_OK):
            return home / "road-recon"
    return Path(tempfile.gettempdir()) / "road-recon"


@cache
def closure(*modules: str, root: Path = ROOT) -> tuple[Path, ...]:
    """Return the files of this project that `modules` reach by imports, their own among them."""
    found: dict[Path, None] = {}
    front = list(modules)
    while front:
        module, _, inner = front.pop().partition(":")
        path = (inner and _find_source(f"{module}.{inner}", root)) or _find_source(module, root)
        if path and path not in found:
            found[path] = None
            front += _source(path).imports
    _save_memory()
    return tuple(found)


def importers(folder: Path, module: str) -> list[Path]:
    """Return the files below `folder` that import something from `module`."""
    spelt = module.rpartition(".")[2].encode()  # most files need no parsing
    paths = [path for path in sorted(folder.rglob("*.py")) if spelt in path.read_bytes()]
    imported = ({name.partition(":")[0] for name in _source(path).imports} for path in paths)
    return [path for path, names in zip(paths, imported, strict=True) if module in names]


def digest(paths: Iterable[Path], root: Path = ROOT) -> str:
    """Return a digest of names and contents of files, in any order of `paths`.

    Python files count by their code, others by every byte.
    """
    total = hashlib.sha256()
    for path in sorted(set(paths)):
        name = path.relative_to(root) if path.is_relative_to(root) else Path(path.name)
        is_code = path.suffix == ".py"
        content = _source(path).digest if is_code else _sha256(path.read_bytes())
        total.update(f"{name.as_posix()} {content}\n".encode())
    _save_memory()
    return total.hexdigest()[:DIGITS]


@cache
def _find_source(module: str, root: Path = ROOT) -> Path | None:
    """The file of a module of this project; None for any other module."""
    if module.partition(".")[0] not in DIGESTED:
        return None
    path = root.joinpath(*module.split("."))
    choices = (path.with_suffix(".py"), path / "__init__.py")
    return next((choice for choice in choices if choice.is_file()), None)


def _is_text(statement: ast.AST) -> bool:
    """Return True for a bare string: a docstring of a module, class, function or name."""
    value = getattr(statement, "value", None)
    return isinstance(statement, ast.Expr) and isinstance(getattr(value, "value", None), str)


def _source(path: Path) -> _Source:
    """Digest and imports of a file, parsed only if its content was never met before."""
    text, known = path.read_bytes(), _memory()
    if (key := _sha256(text)) not in known:
        try:
            known[key] = _parse(text)
        except SyntaxError:  # in somebody else's package; it counts by every byte
            known[key] = _Source(key[:DIGITS], ())
        _parsed.append(key)
    return known[key]


def _parse(text: bytes) -> _Source:
    """Digest and imports of this project's packages, wherever the statements stand."""
    tree, names = ast.parse(text), dict[str, None]()
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [s for s in body if not _is_text(s)] or [ast.Pass()]  # type: ignore[attr-defined]
        if isinstance(node, ast.JoinedStr):  # Python 3.12 ends some with an empty text
            node.values = [x for x in node.values if getattr(x, "value", None) != ""]
        if isinstance(node, ast.Import):
            names.update(dict.fromkeys(alias.name for alias in node.names))
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.update(dict.fromkeys(f"{node.module}:{alias.name}" for alias in node.names))
    own = (name for name in names if name.partition(":")[0].partition(".")[0] in DIGESTED)
    return _Source(_sha256(_dump(tree).encode())[:DIGITS], tuple(own))


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _dump(tree: ast.AST) -> str:
    """Text of a syntax tree, alike in all versions of Python, unlike that of `ast.dump`.

    New versions add fields, which are None or empty in old code; `kind` is the u of u"text".
    """
    lines, front = list[str](), list[Any]([tree])
    while front:  # no recursion: its limit is another one in each version
        match front.pop():
            case ast.AST() as node:
                fields = {k: x for k, x in ast.iter_fields(node) if x not in (None, [])}
                fields.pop("kind", None)
                lines.append(" ".join([type(node).__name__, *fields]))
                front += fields.values()
            case list() as nodes:
                lines.append(f"{len(nodes)} of")
                front += nodes
            case value:
                lines.append(ascii(value))
    return "\n".join(lines)


_parsed: list[str] = []  # contents that this process has parsed and not saved


def _memory_file() -> Path:
    """File of this digest: of another one, or of what another Python can parse, it is no memory."""
    own = _sha256(Path(__file__).read_bytes())[:8]
    return cache_home() / f"sources-{own}-{sys.version_info[0]}{sys.version_info[1]}.json"


@cache
def _memory() -> dict[str, _Source]:
    try:
        stored = json.loads(_memory_file().read_text(encoding="utf-8"))
        return {key: _Source(value[0], tuple(value[1])) for key, value in stored.items()}
    except (OSError, ValueError, TypeError, AttributeError, IndexError, KeyError):
        return {}  # none there, or a damaged one: it is made again


def _save_memory() -> None:
    """Write what was parsed, whole or not at all; where that fails it is parsed again next time."""
    if _parsed:
        _parsed.clear()
        entries = dict(list(_memory().items())[-LARGEST_MEMORY:])
        with suppress(OSError):
            write_text(_memory_file(), json.dumps(entries))
