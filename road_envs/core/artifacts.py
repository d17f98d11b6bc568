"""Artifacts: whatever is kept because it took time to make, and is made again when it is stale.

An artifact is a JSON file of five header lines and its content:

    {
     "sha256": "...",        checksum of everything below
     "kind": "card",         what it is, and the version of its format
     "format": 1,
     "made_by": ["...", ...] digest of the code that makes it, and the modules where it begins
     "identity": "...",      digest of kind, format, that code and plain inputs
     ...                     the content, a line for each key
    }

Whoever makes one computes its identity first; an artifact of the same identity, whole and
undamaged, is taken instead.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from road_envs.core.atomic_io import write_text
from road_envs.core.code_digest import ROOT, closure, digest
from road_envs.core.config import ConfigError
from road_envs.core.reading import parsing, regular

T = TypeVar("T")

CHECKSUM_PREFIX = '{\n "sha256": "'
CHECKSUM_SUFFIX = '",\n'
HEADER = ("sha256", "kind", "format", "made_by", "identity")

KEEPERS = {
    ROOT / "road_envs" / "core" / "atomic_io.py",
    ROOT / "road_envs" / "core" / "code_digest.py",
    ROOT / "leaderboard" / "entries" / "entry_files.py",
    ROOT / "leaderboard" / "entries" / "imports.py",
}
"""Files that write, lock and recognise what is kept, and decide nothing that is in it."""


class NewerFormatError(ConfigError):
    """A file in a newer format: this version can neither read nor overwrite it."""


@cache
def code_version(*modules: str) -> str:
    """Digest of the code of `modules` and of all of this project that they import, less KEEPERS."""
    return digest(set(closure(*modules)) - KEEPERS) if modules else ""


@dataclass(frozen=True)
class Kind:
    """A kind of artifact: its name, the version of its format, the modules that make it.

    `modules` need not be imported: only their files are read.
    """

    name: str
    format: int
    modules: tuple[str, ...] = ()

    def identity(self, *inputs: Any, files: Iterable[Path] = ()) -> str:
        """Digest of this kind, its code, `files` by content, and `inputs` as JSON or by `str`."""
        parts = [self.name, self.format, code_version(*self.modules), digest(files), *inputs]
        text = json.dumps(parts, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:32]

    def to_text(self, content: Mapping[str, Any], identity: str = "") -> str:
        """Text of an artifact; numbers that are not finite become null.

        Raises ValueError if the content has a key of the header.
        """
        if taken := [key for key in HEADER if key in content]:
            raise ValueError(f"{taken[0]} is a key of the header of an artifact")
        code = [code_version(*self.modules), *self.modules]
        data = {"kind": self.name, "format": self.format, "made_by": code, "identity": identity}
        rest = _dump_by_lines(nan_to_none({**data, **content}))[2:] + "\n"
        blank = f"{CHECKSUM_PREFIX}{'0' * 64}{CHECKSUM_SUFFIX}{rest}"
        return blank.replace("0" * 64, _text_checksum(blank), 1)

    def write(self, path: Path, content: Mapping[str, Any], identity: str = "") -> None:
        """Write an artifact, whole or not at all, flushed to disk before it becomes visible."""
        write_text(path, self.to_text(content, identity), durable=True)

    def read(self, path: Path) -> tuple[dict[str, Any], str]:
        """Content of an artifact, with its `identity`, and its checksum.

        Raises NewerFormatError for a newer format, ConfigError for any other fault.
        """
        what = f"{'an' if self.name[0] in 'aeiou' else 'a'} {self.name}"
        with parsing(path, ConfigError, "damaged, not valid JSON"):
            text = regular(path).read_text(encoding="utf-8")
            data = json.loads(text)
        if not isinstance(data, dict) or not isinstance(data.get("format"), int):
            raise ConfigError(f"{path}: not {what} (it has no format)")
        if data.get("kind", self.name) != self.name:
            raise ConfigError(f"{path}: not {what}, its kind is {data['kind']!r}")
        written = f"{path}: written in format {data['format']}"
        reads = f"this version reads {self.format}"
        if data["format"] > self.format:
            what_now = "use the newer version, or another folder"
            raise NewerFormatError(f"{written} by a newer version, {reads}; {what_now}")
        if data["format"] < self.format:
            raise ConfigError(f"{written}, {reads}; make it again")
        checksum = data.pop("sha256", None)
        if not text.startswith(f"{CHECKSUM_PREFIX}{checksum}{CHECKSUM_SUFFIX}"):
            raise ConfigError(f"{path}: not {what} (it does not begin with its checksum)")
        if _text_checksum(text) != checksum:
            raise ConfigError(
                f"{path}: modified since it was written, by hand or by a disk fault; make it again"
            )
        content = {key: x for key, x in data.items() if key not in HEADER or key == "identity"}
        return content, str(checksum)

    def find(self, path: Path, identity: str, make: Callable[[dict[str, Any]], T]) -> T | None:
        """Build `make(content)` of the artifact at `path`, if it has this identity.

        None if it is missing, damaged, of another identity, or `make` cannot read its content.
        """
        try:
            data, _ = self.read(path)
            return make(data) if data.pop("identity") == identity else None
        except (ConfigError, LookupError, TypeError, ValueError, AttributeError):
            return None

    def find_or_make(
        self,
        folder: Path,
        identity: str,
        compute: Callable[[], Mapping[str, Any]],
        make: Callable[[dict[str, Any]], T],
    ) -> T:
        """Build `make(content)` of `<folder>/<kind>/<identity>.json`, computed if it is not there.

        For caches: a folder that cannot be written is no reason to fail.
        """
        path = folder / self.name.replace(" ", "_") / f"{identity}.json"
        if (found := self.find(path, identity, make)) is not None:
            return found
        content = nan_to_none(compute())
        with suppress(OSError):
            self.write(path, content, identity)
        return make(dict(content))


def _text_checksum(text: str) -> str:
    """Checksum of the text of an artifact, without the one written in it."""
    start = len(CHECKSUM_PREFIX) + 64 + len(CHECKSUM_SUFFIX)
    return hashlib.sha256(text[start:].encode()).hexdigest()


def nan_to_none(value: Any) -> Any:
    """Replace every number that is not finite by None, through dicts, lists and tuples."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: nan_to_none(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [nan_to_none(item) for item in value]
    return value


def clean(folder: Path, delete: bool = True) -> list[Path]:
    """Delete the undamaged artifacts below `folder` that other code has made, if `delete` is true.

    Returns their paths. Files that are no artifacts, or say nothing of their code, stay.
    """
    found = []
    for path in sorted(folder.rglob("*.json")):
        try:
            text = regular(path).read_text(encoding="utf-8")
        except (OSError, ValueError):
            continue
        if text.startswith(f"{CHECKSUM_PREFIX}{_text_checksum(text)}"):
            digest_then, *modules = json.loads(text).get("made_by") or [""]
            if modules and digest_then != code_version(*modules):
                found.append(path)
    for path in found if delete else ():
        path.unlink(missing_ok=True)
    return found


def _dump_by_lines(value: Any, depth: int = 2) -> str:
    """JSON with one line for each key down to `depth`; deeper levels are not split."""
    if depth and isinstance(value, dict) and value:
        indent = " " * (3 - depth)
        parts = [(json.dumps(k), _dump_by_lines(v, depth - 1)) for k, v in value.items()]
        lines = [f"{indent}{key}: {part}" for key, part in parts]
        return "{\n" + ",\n".join(lines) + "\n" + indent[1:] + "}"
    return json.dumps(value, allow_nan=False)
