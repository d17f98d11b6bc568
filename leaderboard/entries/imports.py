"""Imports of the code of an entry, read from its syntax: nothing of it is imported here."""

import ast
import hashlib
import re
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from importlib import metadata
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import IO, Any

from leaderboard.entries.entry import EntryError
from leaderboard.entries.entry_files import MAX_FILES, list_files, places_of, snapshot
from road_envs.core.code_digest import DIGITS, PACKAGES

LARGEST_SOURCE = 2**20  # size [bytes] of a module that is parsed: its tree may take 1500 times
_MOST_WORK = 2**33  # most bytes by braces (f-strings take quadratic time) of all that are parsed
_MAX_SOURCE = 2**24  # largest size [bytes] of all that are parsed
_DOTTED = re.compile(rb"(?:\.[\s\\]*[a-zA-Z_\x80-\xff][\w\x80-\xff]*[\s\\]*){1,100}")
_LONGEST_NAME = 250  # most letters of a dotted name that are read
_MAX_MODULES = 1000  # largest number of modules, without those inside, that it imports
_OPTIONAL = (ast.Try, ast.TryStar, ast.FunctionDef, ast.AsyncFunctionDef)
_OPTIONAL_IF = {"TYPE_CHECKING", "ImportError", "ModuleNotFoundError"}  # `suppress(ImportError)`
_RECORDED = re.compile(
    r'^"?(?:\.\./)*(?!["/]|\.\./|(?:bin|Scripts|include)/|[^/,]*\.dist-info/|[^/,]*\.pth,)'
    r"(?!_[^/,]*editable[^/,]*,|.*(?:__pycache__/|/__config__\.))"
    r'(?!.*\.(?:so(?:\.\d+)*|pyd|dll|dylib|lib|a|h|pyx)"?,sha\d+=)(.+,sha\d+=[^,]+)',
    re.M | re.I,
)
"""File of a wheel, alike on all machines: no script, finder, bytecode, nothing about compiling."""


def imports_of(
    text: bytes, module: str, is_package: bool, in_any_case: bool = False
) -> Iterator[str]:
    """Yield what a module imports, with what it takes from a package, 250 letters at most; nothing
    of one of more than 1 MiB, or with so many braces that f-strings of them take seconds to parse.

    With `in_any_case`, not what only `try`, `suppress`, a function or a test for types imports.
    Raises EntryError for a name of over 100 parts: Python's parser keeps each beginning of it.
    """
    if len(text) > LARGEST_SOURCE or len(text) * text.count(b"{") > _MOST_WORK:
        return
    if any(x.group().count(b".") == 100 for x in _DOTTED.finditer(text)):
        raise EntryError(f"{module[:100]} has a name of over 100 parts, which takes GiB to parse")
    try:  # as UTF-8, whatever coding it names: "punycode" takes time by the square of the size
        left: list[ast.AST] = [ast.parse(text.decode("utf-8-sig", "replace"))]
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # it fails where it is run
        return
    while left:
        node = left.pop()
        if in_any_case and _is_optional(node):
            continue
        left += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            yield from (alias.name[:_LONGEST_NAME] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = module if is_package else module.rpartition(".")[0]
            with suppress(ImportError):  # from above all packages: it fails where it is run
                name = resolve_name("." * node.level + (node.module or ""), package)[:_LONGEST_NAME]
                yield from (f"{name}.{alias.name}"[:_LONGEST_NAME] for alias in node.names)


def _is_optional(node: ast.AST) -> bool:
    heads = [node.test] if isinstance(node, ast.If) else []
    heads += [item.context_expr for item in node.items] if isinstance(node, ast.With) else []
    names = {getattr(x, "id", getattr(x, "attr", "")) for head in heads for x in ast.walk(head)}
    return isinstance(node, _OPTIONAL) or not names.isdisjoint(_OPTIONAL_IF)


def imported_versions(reference: str) -> tuple[str, ...]:
    """Return name and version of whatever the code of an entry imports that is none of Python, of
    this project or of its own: of a module that is installed, those of its distribution, with a
    digest of what its wheel has listed but what is compiled, which may be built again under the
    same version.

    Of a module that is installed editable or belongs to none, the digest of its files, and what
    these import counts too; "none" if there is no such module. What is imported by a name that is
    made at run time, or by a module of more than 1 MiB, is not seen. Raises EntryError.
    """
    front, seen, found = _imported(reference), set[str](), set[str]()
    while left := front - seen - sys.stdlib_module_names - {*PACKAGES}:
        if len(seen) + len(left) > _MAX_MODULES:
            raise EntryError(f"its code imports more than {_MAX_MODULES} modules")
        top = min(left)
        seen.add(top)
        owners = [metadata.distribution(x) for x in module_owners(tuple(sys.path)).get(top, ())]
        found |= {f"{x.metadata['Name']} {x.version}{_digest_of(x)}" for x in owners}
        sites = {Path(str(x.locate_file(""))).resolve() for x in owners if x.read_text("RECORD")}
        places = list[Path]()
        with suppress(ValueError):  # `__main__`, and what a program has put among the modules
            places = places_of(find_spec(top))
        found |= set() if owners or places else {f"{top} none"}
        for place in (x for x in places if x.parent.resolve() not in sites):
            try:
                found.add(f"{top} {snapshot(str(place), None)}")
                front |= _imported(str(place), f"{top}/" if place.is_dir() else "")
            except EntryError as error:
                if not owners:  # nothing would tell that it has changed
                    raise EntryError(f"of {top} beside it, which it imports, {error}") from None
    return tuple(sorted(found))


def _digest_of(distribution: metadata.Distribution) -> str:
    """Return " " and a digest of the files of its wheel, by its RECORD; "" of no wheel."""
    files = sorted(_RECORDED.findall(distribution.read_text("RECORD") or ""))
    return f" {hashlib.sha256(repr(files).encode()).hexdigest()[:DIGITS]}" if files else ""


@cache
def module_owners(path: tuple[str, ...]) -> dict[str, list[str]]:
    """Names of the distributions of each module that `sys.path` has."""
    return {x: sorted(set(names)) for x, names in metadata.packages_distributions().items()}


def _imported(reference: str, prefix: str = "") -> set[str]:
    """Return the modules, without those inside, that code imports and that are not its own.

    `prefix` of its files' names: "package/" if it is the folder of a package. Raises EntryError.
    """
    own, found, size, work = set[str](), set[str](), 0, 0
    try:
        for count, (name, n_bytes, start) in enumerate(_files(reference)):
            if count == MAX_FILES:
                raise EntryError(f"its code has more than {MAX_FILES} files, with those in wheels")
            name = prefix + name
            own.add(name.partition("/")[0].partition(".")[0])
            if not name.endswith(".py") or n_bytes > LARGEST_SOURCE:
                continue
            if (size := size + n_bytes) > _MAX_SOURCE:
                raise EntryError(f"its Python files have more than {_MAX_SOURCE >> 20} MiB")
            with start() as file:
                text = file.read(LARGEST_SOURCE)  # a wheel may hold more than it states
            work += len(text) * text.count(b"{")
            if work > _MOST_WORK:
                raise EntryError("its Python files have too many braces to be parsed in seconds")
            module = name.removesuffix(".py").replace("/", ".")
            found |= {x.partition(".")[0] for x in imports_of(text, module, False)}
    except EntryError:
        raise
    except Exception as error:  # whatever a damaged wheel raises
        raise EntryError(f"its imports cannot be read: {error}"[:300]) from None
    return found - own


def _files(reference: str) -> Iterator[tuple[str, int, Callable[[], IO[Any]]]]:
    """Yield name, size [bytes] and opener of the files of an entry, in place of a wheel of its."""
    for path, name in list_files(reference):
        if path.suffix != ".whl":
            yield name, path.stat().st_size, partial(path.open, "rb")
            continue
        with zipfile.ZipFile(path) as wheel:
            for one in wheel.infolist():
                if one.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise EntryError(f"{one.filename} is compressed by another method than deflate")
                yield one.filename, one.file_size, partial(wheel.open, one)
