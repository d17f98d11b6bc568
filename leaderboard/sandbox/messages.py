"""What crosses the border between judge and entry, as files in one folder.

    in/request.json            which estimator, its settings, the car, the training seeds
    in/training-0.parquet  a training record; its truth stands beside it as training-0.npz
    in/test-0.parquet      a test record; its truth stays with the judge
    out/response.json        what came of it, written last
    out/seed-1.npz         estimates of one training: z0, z1, ... and z_std0, ... where given

The judge believes nothing that comes out: files are opened without following links, of limited
size, without pickle, and every array is checked against the shape that it must have.
"""

import dataclasses
import io
import json
import os
import stat
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from leaderboard.evaluation.entry import EntryError, TrainingRun
from road_envs._atomic_io import atomic_write
from road_envs.config import STRICT, ConfigError, build
from road_envs.data.record import Estimate, Profile, Record, profile_stations
from road_envs.data.recording import read_record, write_record
from road_envs.vehicle.parameters import VehicleParameters

MAX_RESPONSE_SIZE = 1_000_000
"""Most bytes of an answer; estimates may have what their arrays need and half as much again."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """What the judge wants of an entry: an estimate of every test record after every training."""

    __pydantic_config__ = STRICT

    reference: str
    settings: dict[str, Any]
    seeds: tuple[int, ...] = ()
    training: int = 0  # records
    tests: int = 0
    car: dict[str, Any] | None = None  # None: only a description of the estimator is wanted


@dataclass(frozen=True, kw_only=True)
class TrainingReport:
    """The cost of one training, told by the entry's process."""

    __pydantic_config__ = STRICT

    seed: int
    train_seconds: float
    estimate_seconds: float
    parameters: int


@dataclass(frozen=True, kw_only=True)
class Response:
    """What an entry's process says: what it did, or in one sentence why not."""

    __pydantic_config__ = STRICT

    failure: str | None = None
    trainings: tuple[TrainingReport, ...] = ()
    description: dict[str, Any] | None = None


def write_request(
    folder: Path,
    request: Request,
    training: Sequence[tuple[Record, Profile]],
    tests: Sequence[Record],
) -> None:
    """The judge's side: fill `folder`/in, and make an empty `folder`/out."""
    inside = folder / "in"
    inside.mkdir(parents=True)
    (folder / "out").mkdir()
    for k, (record, truth) in enumerate(training):
        write_record(inside / f"training-{k}.parquet", record, {})
        np.savez(inside / f"training-{k}.npz", s=truth.s, z=truth.z)
    for k, record in enumerate(tests):
        write_record(inside / f"test-{k}.parquet", record, {})
    (inside / "request.json").write_text(json.dumps(dataclasses.asdict(request)), encoding="utf-8")


def read_request(folder: Path) -> Request:
    """The entry's side: what is wanted."""
    text = (folder / "in" / "request.json").read_text(encoding="utf-8")
    return build(Request, json.loads(text), "request.json")


def read_drives(
    folder: Path, request: Request
) -> tuple[list[tuple[Record, Profile]], list[Record], VehicleParameters]:
    """The entry's side: training drives with their truth, test records, and the car."""
    inside = folder / "in"
    training = []
    for k in range(request.training):
        with np.load(inside / f"training-{k}.npz") as truth:
            pair = _record(inside / f"training-{k}.parquet"), Profile(truth["s"], truth["z"])
        training.append(pair)
    tests = [_record(inside / f"test-{k}.parquet") for k in range(request.tests)]
    return training, tests, build(VehicleParameters, request.car or {}, "car")


def _record(path: Path) -> Record:
    record, _ = read_record(path)
    return record


def write_estimates(folder: Path, seed: int, estimates: Sequence[Estimate]) -> None:
    """The entry's side: all that one training estimated."""
    arrays: dict[str, np.ndarray] = {}
    for k, estimate in enumerate(estimates):
        arrays[f"z{k}"] = np.ascontiguousarray(estimate.z, dtype=float)
        if estimate.z_std is not None:
            arrays[f"z_std{k}"] = np.ascontiguousarray(estimate.z_std, dtype=float)
    with (folder / "out" / f"seed-{seed}.npz").open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def write_response(folder: Path, response: Response) -> None:
    """The entry's side: the last thing that it does."""
    with atomic_write(folder / "out" / "response.json") as partial:
        partial.write_text(json.dumps(dataclasses.asdict(response)), encoding="utf-8")


def read_response(folder: Path) -> Response | None:
    """The judge's side: what the entry's process said; None if it said nothing.

    Raises EntryError for what is no answer.
    """
    data = _read_regular_file(folder / "out", "response.json", MAX_RESPONSE_SIZE)
    if data is None:
        return None
    try:
        return build(Response, json.loads(data), "its answer")
    except (ConfigError, ValueError, RecursionError) as error:
        raise EntryError(f"its answer cannot be read: {' '.join(str(error).split())}") from None


def read_training_run(
    folder: Path, training: TrainingReport, tests: Sequence[Record]
) -> TrainingRun:
    """The judge's side: the estimates of one training. Raises EntryError.

    Stations are the judge's own; whether heights are finite is for `check_estimate` to say.
    """
    stations = [profile_stations(record.length) for record in tests]
    most = int(1.5 * sum(2 * 2 * 8 * s.size for s in stations)) + 10_000 * (len(tests) + 1)
    name = f"seed-{training.seed}.npz"
    data = _read_regular_file(folder / "out", name, most)
    if data is None:
        raise EntryError(f"there are no estimates of the training with seed {training.seed}")
    try:
        arrays = _arrays(data, {f"{kind}{k}": (2, s.size) for k, s in enumerate(stations)
                                for kind in ("z", "z_std")})  # fmt: skip
        estimates = [
            Estimate(s, arrays[f"z{k}"], arrays.get(f"z_std{k}")) for k, s in enumerate(stations)
        ]
    except KeyError as error:
        raise EntryError(f"{name}: no estimate {error.args[0]}") from None
    except (ValueError, EOFError, OSError, zipfile.BadZipFile, zlib.error) as error:
        raise EntryError(f"{name}: {error}") from None
    return TrainingRun(
        estimates,
        training.train_seconds,
        training.estimate_seconds,
        training.parameters,
        training.seed,
    )


def _arrays(data: bytes, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Arrays of floats in an .npz, by name. Raises ValueError for a name or a shape not in `shapes`
    before anything of that size is made.
    """
    arrays = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for member in archive.namelist():
            name = member.removesuffix(".npy")
            if name not in shapes:
                raise ValueError(f"nobody asked for {name!r}")
            with archive.open(member) as file:
                version = npy.read_magic(file)
                if version != (1, 0):
                    raise ValueError(f"{name} is of version {version}")
                shape, by_columns, dtype = npy.read_array_header_1_0(file)
                if shape != shapes[name] or dtype != np.dtype(float) or by_columns:
                    raise ValueError(
                        f"{name}: {shapes[name]} floats are wanted, got {dtype} {shape}"
                    )
                size = 8 * int(np.prod(shape))
                content = file.read(size)
                if len(content) != size:
                    raise ValueError(f"{name} is cut short")
                arrays[name] = np.frombuffer(content).reshape(shape)
    return arrays


def _read_regular_file(folder: Path, name: str, most: int) -> bytes | None:
    """A regular file that is no link, of at most so many bytes. Raises EntryError."""
    try:
        place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
            handle = os.open(name, flags, dir_fd=place)
        finally:
            os.close(place)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise EntryError(f"{name} cannot be read: {error.strerror}") from None
    with open(handle, "rb") as file:
        about = os.fstat(handle)
        if not stat.S_ISREG(about.st_mode):
            raise EntryError(f"{name} is no file")
        if about.st_size > most:
            raise EntryError(f"{name} has {about.st_size} bytes, more than the {most} it may have")
        return file.read(most)
