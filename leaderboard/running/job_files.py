"""Files that a job needs besides its text: surfaces, vehicles, instruments, code of entries.

A job names files of the machine that planned it. Packed, it names copies of them, relative to its
own file and by the digest of their content, so that it can be run where there are no other files.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from leaderboard.entries import entry_files
from leaderboard.entries.entries import is_ours
from leaderboard.entries.entry import BUILTIN, Entry, EntryError
from leaderboard.evaluation.task_files import digest_of, files_of, with_paths
from road_envs.core.config import ConfigError

_FOLDER = "files"
"""Folder of the copies, beside the file of the job."""


def pack(spec: dict[str, Any], entries: Iterable[Entry]) -> tuple[dict[str, Any], dict[str, Path]]:
    """Return the JSON object of a job that names copies, and the file of each copy.

    Raises ConfigError if a file cannot be read.
    """
    sources: dict[str, Path] = {}

    def copy(path: str) -> str:
        folder = f"{_FOLDER}/{digest_of(path)}"
        sources.update({f"{folder}/{file.name}": file for file in files_of(path)})
        return f"{folder}/{Path(path).name}"

    try:
        task = with_paths(spec["task"], copy)
        for entry in entries:
            if is_from_outside(entry):
                for source, name in entry_files.list_files(entry.reference):
                    sources[f"{_FOLDER}/{entry.code}/{name}"] = source
    except (OSError, EntryError) as error:
        raise ConfigError(f"a file of the job cannot be read: {error}") from None
    return {**spec, "task": task, "files": _FOLDER}, sources


def locate(spec: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the JSON object of a job whose paths begin in `folder`, with absolute ones."""
    task = with_paths(spec.get("task"), lambda path: str(folder.resolve() / path))
    return {**spec, "task": task, "files": spec["files"] and str(folder.resolve() / spec["files"])}


def code_folders(files: str, entries: Iterable[Entry]) -> dict[str, Path]:
    """Return the folder with the copied code of each entry from outside, by its reference."""
    if not files:
        return {}
    return {x.reference: Path(files, x.code) for x in entries if is_from_outside(x)}


def is_from_outside(entry: Entry) -> bool:
    """Return whether code of an entry is run that is none of this package."""
    return entry.failure is None and is_by_others(entry)


def is_by_others(entry: Entry) -> bool:
    """Return whether an entry is not of this package, also if it could not be described."""
    return entry.reference != BUILTIN and not is_ours(entry.reference)
