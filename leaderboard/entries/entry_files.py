"""Code of entries from outside this package: found, copied and hashed, never imported.

An entry is run from a snapshot, and its version is the digest of that snapshot, so what was hashed
is what runs. Only regular files count, and links below its folder are refused.
"""

import hashlib
import importlib.util
import os
import re
from collections.abc import Iterator
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

from estimators.api import ENTRY_POINT_GROUP
from leaderboard.entries.entry import EntryError
from road_envs.core.code_digest import DIGITS

WEIGHTS_SUFFIXES = (".npz", ".safetensors")
MAX_FILES, _MAX_SIZE, _MAX_DEPTH = 20_000, 2**31, 32
"""Limits of a snapshot: number of files, their size [bytes] together, depth of folders."""

CLASS_REFERENCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
"""Pattern of a reference to a class of an importable module, "module:Class"."""


CLASS_FOLDER = "ROADRECON_CLASS_FOLDER"
"""Variable of the environment: a further folder where modules of such references are found. Those
who run an entry import nothing from there.
"""


def snapshot(reference: str, folder: Path | None, copied: Path | None = None) -> str:
    """Copy the code of an entry into the new `folder`, if any, and return its digest.

    The code is read from where it was `copied`, if it was. Raises EntryError.
    """
    total = hashlib.sha256()
    if CLASS_REFERENCE.fullmatch(reference):  # the files may have other classes
        total.update(f"{reference}\n".encode())
    count = size = 0
    try:
        for source, name in list_files(str(copied or reference)):
            if not name.isprintable():  # a line break would give two snapshots one digest
                raise EntryError(f"the name of a file must be printable, got {name!r}"[:300])
            count, size = count + 1, size + source.stat().st_size
            if count > MAX_FILES or size > _MAX_SIZE:
                raise EntryError(
                    f"its code has more than {MAX_FILES} files or {_MAX_SIZE >> 30} GiB"
                )
            content = source.read_bytes()
            if folder is not None:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(content)
            total.update(f"{name} {hashlib.sha256(content).hexdigest()}\n".encode())
        if folder is not None:  # a guest has another user, whatever the umask
            for path in [folder, *folder.rglob("*")]:
                path.chmod(0o755 if path.is_dir() else 0o644)
    except (OSError, ValueError) as error:
        raise EntryError(f"its code cannot be read: {error}"[:300]) from None
    return total.hexdigest()[:DIGITS]


def list_files(reference: str) -> Iterator[tuple[Path, str]]:
    """Yield the files of an entry with their names in the snapshot, in order. Raises EntryError."""
    if not CLASS_REFERENCE.fullmatch(reference):
        path = Path(reference)
        yield from _walk(path, "") if path.is_dir() else [(path, path.name)]
        return
    top = reference.partition(":")[0].partition(".")[0]
    folder = os.environ.get(CLASS_FOLDER)
    here = PathFinder.find_spec(top, [folder]) if folder else None
    # a folder without __init__.py comes last; none of the module runs
    spec = here if here and here.origin else importlib.util.find_spec(top) or here
    if not (places := places_of(spec)):
        raise EntryError(f"cannot be constructed: there is no module {top!r}")
    seen = set[str]()
    for place in places:  # of a file in two portions of a package, the first is imported
        for path, name in _walk(place, f"{top}/") if place.is_dir() else [(place, place.name)]:
            if name not in seen:
                seen.add(name)
                yield path, name


def places_of(spec: ModuleSpec | None) -> list[Path]:
    """Return the file or folder of a module, or the folders of all portions of a package."""
    places = (spec.submodule_search_locations or [spec.origin or ""]) if spec else []
    return [Path(place) for place in places if os.path.exists(place)]


def entry_points(code: Path) -> list[metadata.EntryPoint]:
    """Return the entry points of estimators in a wheel or a folder of installed packages."""
    found = metadata.distributions(path=[str(code)])
    return [x for one in found for x in one.entry_points.select(group=ENTRY_POINT_GROUP)]


def _walk(root: Path, prefix: str) -> Iterator[tuple[Path, str]]:
    """Yield the regular files below a folder, without bytecode. Raises EntryError for a link."""
    left = [(root, prefix, 0)]
    while left:
        folder, prefix, depth = left.pop()
        if depth > _MAX_DEPTH:
            raise EntryError(f"its folders are nested more than {_MAX_DEPTH} deep")
        for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
            if entry.is_symlink():  # left out, its file would be missing where the entry runs
                where = repr(prefix + entry.name)[:200]
                raise EntryError(f"its code has a link, put there what it leads to: {where}")
            if entry.is_dir(follow_symlinks=False) and entry.name != "__pycache__":
                left.append((Path(entry.path), f"{prefix}{entry.name}/", depth + 1))
            elif entry.is_file(follow_symlinks=False):
                yield Path(entry.path), prefix + entry.name
