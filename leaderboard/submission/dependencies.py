"""Modules that an entry imports and boards lack: packages beside it where its authors tried it."""

import re
import sys
import zipfile
from contextlib import suppress
from importlib import metadata
from itertools import accumulate
from pathlib import Path

from leaderboard.entries.entry_files import entry_points
from leaderboard.entries.imports import LARGEST_SOURCE, imports_of, module_owners

PROJECT, EXTRAS = "road-envs", ("all", "sign")  # what boards install
_REQUIREMENT = re.compile(r"\s*([\w.-]+)\s*(?:\[([^]]*)\])?[^;]*(?:;(.*))?")
_EXTRA = re.compile(r"""extra\s*==\s*["']([\w.-]+)["']""")


def missing_packages(code: Path) -> list[str]:
    """Return a sentence for each module that `code`, a wheel or a folder with one or with installed
    packages, imports, and that is none of its own, of Python, or of what boards install. What is
    imported only if it can be (`try`, `suppress`), by a function, for types alone, or by a module
    whose source is longer than 1 MiB, does not count. Raises EntryError as `imports_of`.
    """
    wheel = code if code.is_file() else next(code.glob("*.whl"), None)
    found, modules = list[str](), [x.module for x in entry_points(wheel or code)]
    left = [name for x in modules for name in accumulate(x.split("."), "{}.{}".format)]
    if not left:  # weights of an entry of this package, or what the judge refuses
        return found
    files = code if wheel is None else zipfile.Path(wheel)
    boards, places = _installed_by_boards(), module_owners(tuple(sys.path))
    seen = set(left)
    while left:
        name = left.pop()
        path, top = _file_of(name, files), name.partition(".")[0]
        if path is None:
            packages = [_normal(x) for x in places.get(top, ())]
            if top not in sys.stdlib_module_names and packages and not boards & {*packages}:
                found.append(
                    f"it imports {top} of the package {packages[0]}, which boards lack: give a "
                    "folder that has it, too (pip install --target FOLDER), or do without it"
                )
            continue
        with path.open("rb") as file:
            text = file.read(LARGEST_SOURCE + 1)  # a wheel may hold more than the memory
        # a name of a package is a module only if there is such a file
        imports = imports_of(text, name, path.name == "__init__.py", in_any_case=True)
        parts = {x for other in imports for x in accumulate(other.split("."), "{}.{}".format)}
        left += sorted(x for x in parts - seen if "." not in x or _file_of(x, files))
        seen |= parts
    return found


def _file_of(module: str, files: Path | zipfile.Path) -> Path | zipfile.Path | None:
    """File of a module in a folder or wheel; None if it is not there."""
    path = module.replace(".", "/")
    found = (files / place for place in (f"{path}.py", f"{path}/__init__.py"))
    with suppress(OSError):  # a name that is too long for a file
        return next((file for file in found if file.is_file()), None)
    return None


def _installed_by_boards() -> set[str]:
    """Distributions that the project with `EXTRAS` requires, on any platform, and itself."""
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
