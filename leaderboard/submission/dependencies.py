"""Modules that an entry imports and boards lack: packages beside it where its authors tried it."""

import ast
import re
import sys
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from configparser import ConfigParser, Error
from importlib import metadata
from pathlib import Path

from estimators import ENTRY_POINT_GROUP

PROJECT, EXTRAS = "road-envs", ("all", "sign")
"""What boards install."""

_REQUIREMENT = re.compile(r"\s*([\w.-]+)\s*(?:\[([^]]*)\])?[^;]*(?:;(.*))?")
_EXTRA = re.compile(r"""extra\s*==\s*["']([\w.-]+)["']""")


def missing_packages(code: Path) -> dict[str, str]:
    """Return the packages of modules that the code of an entry imports, by module, where they are
    none of its own, of Python, or of what boards install.

    `code` is a wheel, or a folder with one or with installed packages. What is imported only if it
    can be (`try`), or for types alone, does not count.
    """
    files = _sources(code)
    found, left = dict[str, str](), _entry_modules(files)
    boards, places = _installed_by_boards(), metadata.packages_distributions()
    seen = set(left)
    while left:
        name = left.pop()
        path = next((p for p in _places(name) if p in files), None)
        top = name.partition(".")[0]
        if path is None:
            packages = [_normal(x) for x in places.get(top, ())]
            if top not in sys.stdlib_module_names and packages and not boards & {*packages}:
                found[top] = packages[0]
            continue
        for other in _imports(files[path], name, path.endswith("__init__.py")):
            parents = other.split(".")
            new = {".".join(parents[: k + 1]) for k in range(len(parents))} - seen
            # a name of a package is a module only if there is such a file
            new = {x for x in new if "." not in x or any(p in files for p in _places(x))}
            seen |= new
            left += sorted(new)
    return found


def _places(name: str) -> tuple[str, str]:
    """Files that a module can be."""
    path = name.replace(".", "/")
    return f"{path}.py", f"{path}/__init__.py"


def _sources(code: Path) -> dict[str, str]:
    """Texts of the Python files and of the entry points in a wheel or folder, by their paths."""
    wanted = re.compile(r".*\.py|[^/]*\.dist-info/entry_points\.txt")
    if wheel := code if code.is_file() else next(code.glob("*.whl"), None):
        try:
            with zipfile.ZipFile(wheel) as archive:
                names = [name for name in archive.namelist() if wanted.fullmatch(name)]
                return {name: archive.read(name).decode("utf-8", "replace") for name in names}
        except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError):
            return {}  # damaged: said where it is run; or the weights of an entry of this package
    paths = {x.relative_to(code).as_posix(): x for x in code.rglob("*") if x.is_file()}
    return {
        name: path.read_text("utf-8", "replace")
        for name, path in paths.items()
        if wanted.fullmatch(name)
    }


def _entry_modules(files: Mapping[str, str]) -> list[str]:
    """Modules, and their packages, that the entry points of estimators name."""
    found = []
    for path, text in files.items():
        if path.endswith("entry_points.txt"):
            parser = ConfigParser(delimiters="=", interpolation=None)
            try:
                parser.read_string(text)
            except Error:  # said where it is run
                continue
            section = parser[ENTRY_POINT_GROUP] if ENTRY_POINT_GROUP in parser else {}
            for value in section.values():
                parts = value.partition(":")[0].strip().split(".")
                found += [".".join(parts[: k + 1]) for k in range(len(parts))]
    return found


def _imports(text: str, module: str, is_package: bool) -> Iterator[str]:
    """Yield what a module imports in any case, with a name each of what it takes from a package."""
    try:
        left: list[ast.AST] = [ast.parse(text)]
    except (SyntaxError, ValueError):  # it fails where it is run
        return
    while left:
        node = left.pop()
        if isinstance(node, ast.Try) or (
            isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        ):
            continue
        left += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = module.split(".")[: None if is_package else -1]
            base = package[: len(package) - node.level + 1] if node.level else []
            name = ".".join([*base, *([node.module] if node.module else [])])
            yield name
            yield from (f"{name}.{alias.name}" for alias in node.names)


def _installed_by_boards() -> set[str]:
    """Distributions that the project with `EXTRAS` requires, and itself; markers of platforms and
    versions are not asked.
    """
    found = {PROJECT}
    left: list[tuple[str, tuple[str, ...]]] = [(PROJECT, EXTRAS)]
    while left:
        name, extras = left.pop()
        try:
            lines = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        for line in lines:
            if (match := _REQUIREMENT.match(line)) is None:
                continue
            package, wanted, marker = match.groups()
            asked = _EXTRA.findall(marker or "")
            if (not asked or {*asked} & {*extras}) and _normal(package) not in found:
                found.add(_normal(package))
                left.append((package, tuple(re.split(r"[\s,]+", wanted or ""))))
    return found


def _normal(name: str) -> str:
    """Name of a distribution as PyPI compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()
