"""Damaged and hostile files of every format that is read, made from valid ones."""

import io
import re
import struct
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from measured import read_measured_record

from estimators import create, weights_io
from leaderboard.evaluation.tasks import load_task
from leaderboard.submission import hidden_seeds
from road_envs.core import config
from road_envs.core.config import ConfigError, find
from road_envs.drives.logger_tables.description import (
    DriveDescription,
    read_description,
    write_description,
)
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.drives.recording import read_record, simulate_record, write_record
from road_envs.policies import _PolicySettings
from road_envs.policies.network_policy import NetworkPolicy
from road_envs.roads import load_road
from road_envs.sensing.instruments import load_instruments
from road_envs.sensing.perturbed_vehicle import load_plant_mismatch
from road_envs.vehicle.parameters import load_vehicle

HUGE = "9" * 5000
SCALARS = (
    "", "~", "true", "[]", "{}", "abc", "-1", "0", "1_0", "0x", "0b", "1:30:00", ".nan", "-.inf",
    "1e308", "1e-320", "1e400", "9" * 18, "9" * 400, HUGE, "2001-99-99", "!!timestamp x",
    "!!int ''", "!!float x", "!!bool x", "!!binary '='", "!!python/object/apply:os.getcwd []",
    "*nowhere", "&a [*a]", "{1: 2}", "{[1]: 2}", "{<<: [1]}", "'\\0'", "[[[[[[]]]]]]",
)  # fmt: skip
"""Values that replace one value of a YAML or JSON text."""

BOMB = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 9)}]\n" for k in range(12)
)
MERGES = "m0: &m0 {x: 1}\n" + "".join(
    f"m{k + 1}: &m{k + 1} {{<<: [*m{k}, *m{k}], y{k}: 1}}\n" for k in range(40)
)
TEXTS = (
    b"", b"\0" * 99, b"\xff\xfea\0:\0", "a: \u00e9".encode("latin-1"), b"[" * 900, b"{a: " * 900,
    b'{"a":' * 3000, b"- " * 900, b"a: &a [*a]", b"&a {a: *a}", b"? [a]\n: 1", b"a: 1\na: 2",
    b"a: !!timestamp x", b"<<: 1", b"%YAML 9.9\n---\na: 1", b"a: 1\n---\nb: 2", b"\t- a", b"a: 'b",
    b"kind: " + b"x" * 10_000, f"a: {HUGE}".encode(), BOMB.encode(), MERGES.encode(),
)  # fmt: skip
"""Contents that no reader may stumble over."""


TIMES = np.arange(80) / 100.0
DRIVE = {
    "t": TIMES,
    **{f"a_{k}": np.sin(w * TIMES).round(5) for k, w in (("rf", 9.0), ("lr", 7.0), ("rr", 5.0))},
    "v": 5.0 + TIMES,
    "s": (5.0 * TIMES + 0.5 * TIMES**2).round(5),
    "mode": ["ride"] * TIMES.size,
}
"""Columns of the table of a valid drive."""

DESCRIPTION = DriveDescription(
    columns={"t": "Time", "a_rf": "x"}, units={"t": "ms", "a_rf": "g"}, invert=("a_rr",),
    speed_kmh=36.0, mode={"front": "ride", "rear": "ride"}, offset=3.0,
    vehicle="land_rover_defender_110", sensors="paper",
)  # fmt: skip


class Reader(NamedTuple):
    """A function that reads a file, a valid file and its name, and the documented error."""

    read: Callable[[Path], Any]
    sample: bytes
    name: str
    error: type[Exception]


def answer(reader: Reader, folder: Path, content: bytes | None) -> str | None:
    """Write `content` (None: make a folder) and return the sentence of the refusal, None if read.

    Any other outcome than a result or the documented error raises.
    """
    path = folder / reader.name
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    began = time.process_time()
    try:
        reader.read(path)
    except reader.error as error:
        said = str(error)
        assert str(path) in said and "\n" not in said and len(said) < 2000, said
        assert error.__cause__ is None and (error.__context__ is None or error.__suppress_context__)
        return said
    finally:
        assert time.process_time() - began < 5.0
        path.rmdir() if content is None else path.unlink()
    return None


def readers(folder: Path) -> dict[str, Reader]:
    """Return every reader by name, with a valid file of a few kilobytes made in `folder`."""
    record, _ = simulate_record("iso_d", speed_kmh=36.0, length=8.0)
    write_record(folder / "record.parquet", record, {"seed": 1})
    mean = create("mean").with_weights({"z": 0.01 * np.arange(80.0).reshape(2, 40)})
    for suffix in ("npz", "safetensors"):
        weights_io.save(mean, folder / f"weights.{suffix}")
    write_drive(folder / "drive.csv", DRIVE)
    write_drive(folder / "drive.parquet", DRIVE)
    write_description(folder / "drive.yaml", DESCRIPTION)
    hidden_seeds.save(hidden_seeds.commit("a secret of a season", [load_task("class")]), folder)
    found = {
        "record": (read_record, folder / "record.parquet", ConfigError),
        "drive table": (read_drive, folder / "drive.csv", ConfigError),
        "drive Parquet": (read_drive, folder / "drive.parquet", ConfigError),
        "drive description": (read_description, folder / "drive.yaml", ConfigError),
        "weights": (weights_io.load, folder / "weights.npz", weights_io.StorageError),
        "safetensors": (weights_io.load, folder / "weights.safetensors", weights_io.StorageError),
        "policy": (load_network, config.folder() / "policies/learned.npz", ConfigError),
        "hidden seeds": (
            lambda path: hidden_seeds.load(path.parent),
            folder / hidden_seeds.COMMITMENT,
            ConfigError,
        ),
        "vehicle": (load_vehicle, find("vehicles", "land_rover_defender_110"), ConfigError),
        "road": (load_road, find("roads", "growing_defects"), ConfigError),
        "composite road": (load_road, find("roads", "iso_b_potholes"), ConfigError),
        "instruments": (load_instruments, find("sensors", "paper"), ConfigError),
        "task": (load_task, find("tasks", "paper_1"), ConfigError),
        "field": (load_plant_mismatch, find("field", "assumed"), ConfigError),
        "policy settings": (load_policy_settings, find("policies", "mpc"), ConfigError),
    }
    return {
        name: Reader(read, path.read_bytes(), path.name, error)
        for name, (read, path, error) in found.items()
    }


def read_drive(path: Path) -> MeasuredRecord:
    """Read the table of a drive, and assert that what was read could be a drive."""
    measured = read_measured_record(path, 2.5)
    record, n = measured.record, measured.record.t.size
    assert 32 <= n < 10_000 and record.a.shape == (3, n) and record.spring_stiff.shape == (n, 4)
    assert (np.diff(record.t) > 0.0).all() and (np.diff(record.s) >= 0.0).all()
    assert np.isfinite([*record.s, *record.v, record.length, measured.chainage, measured.fs]).all()
    assert (np.isnan(record.a) | (np.abs(record.a) < 1e12)).all()
    return measured


def write_drive(path: Path, columns: Mapping[str, Any]) -> None:
    """Write a table of a drive as CSV or Parquet."""
    if path.suffix == ".parquet":
        pq.write_table(pa.table(dict(columns)), path)
        return
    rows = (",".join(map(str, row)) for row in zip(*columns.values(), strict=True))
    path.write_text("\n".join([",".join(columns), *rows]), encoding="utf-8")


def load_network(path: Path) -> NetworkPolicy:
    return NetworkPolicy(file=str(path))


def load_policy_settings(path: Path) -> _PolicySettings:
    return config.load(_PolicySettings, "policies", path)


def npz(**arrays: Any) -> bytes:
    """Return the bytes of an .npz file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def archive(*members: tuple[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return the bytes of a ZIP archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as file:
        for name, content in members:
            file.writestr(name, content)
    return buffer.getvalue()


def npy(header: str, data: bytes = b"", version: bytes = b"\1\0") -> bytes:
    """Return an .npy file with this text as its header."""
    text = header.encode("latin-1") + b"\n"
    size = struct.pack("<H" if version == b"\1\0" else "<I", len(text))
    return b"\x93NUMPY" + version + size + text + data


def hostile_archives(sample: bytes) -> Iterator[bytes]:
    """Yield ZIP archives of arrays that lie about their sizes, are bombs, or hold no arrays."""
    with zipfile.ZipFile(io.BytesIO(sample)) as file:
        members = [(name, file.read(name)) for name in file.namelist()]
    first, rest = members[0][0], members[1:]
    shape = "{'descr': '<f8', 'fortran_order': False, 'shape': %s, }"
    headers = [
        shape % text
        for text in ("(10000000000000,)", "(-1, -8)", "(2.5,)", "(0, 9999999999999999999999)", "(")
    ]
    headers += ["{'descr': '|O', 'fortran_order': False, 'shape': (), }", "(" * 5000, "{" * 90]
    headers += ["{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }", "'\\", "1_0"]
    headers += ["{'descr': '<U0', 'fortran_order': False, 'shape': (99999999999,), }"]
    for header in headers:
        for version in (b"\1\0", b"\2\0", b"\3\0", b"\11\0"):
            yield archive((first, npy(header, bytes(8), version)), *rest)
    yield archive((first, npy(shape % "(2500000,)", bytes(20_000_000))), *rest)
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        yield archive(*members, method=method)
    yield archive(*rest)
    encrypted = bytearray(archive(*members))
    central = encrypted.index(b"PK\1\2")
    encrypted[6] |= 1
    encrypted[central + 8] |= 1
    yield bytes(encrypted)
    longer = bytearray(archive(*members))
    longer[central + 24 : central + 28] = struct.pack("<I", 50)
    yield bytes(longer)


def corrupted(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a copy with one to five bytes flipped, removed, inserted or repeated, or cut short."""
    content = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at = int(rng.integers(len(content) + 1))
        match rng.integers(5):
            case 0 if at < len(content):
                content[at] = rng.integers(256)
            case 1:
                del content[at : at + int(rng.integers(1, 9))]
            case 2:
                content[at:at] = rng.bytes(int(rng.integers(1, 9)))
            case 3:
                content[at:at] = content[at : at + int(rng.integers(1, 200))]
            case 4 if rng.random() < 0.2:
                del content[at:]
    return bytes(content)


def with_other_value(text: str, rng: np.random.Generator) -> str:
    """Return a YAML or JSON text in which one value is another one."""
    spans = [
        m.span(1) for m in re.finditer(r'(?<=[:\[,{] )?("[^"]*"|[-+\w.]+)(?=[\s,\]}]|$)', text)
    ]
    start, end = spans[rng.integers(len(spans))]
    return text[:start] + SCALARS[rng.integers(len(SCALARS))] + text[end:]
