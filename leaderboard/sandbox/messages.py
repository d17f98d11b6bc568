"""Messages between client and worker, as files in one folder.

    in/request.json        estimator, its settings, vehicle, training seeds
    in/training-0.parquet  a training record; its truth is in training-0.npz
    in/test-0.parquet      a test record; its truth is never written
    out/response.json      the outcome, written last
    out/seed-1.npz         estimates of one training: z0, z1, ... and z_std0, ... if there are any

The output is untrusted: files are opened without following links, limited in size and read without
pickle, and every array is checked against its expected shape.
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
"""Largest size [bytes] of a response."""

ESTIMATES_MARGIN = 1.5
"""Largest size of a file of estimates, relative to that of its arrays."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """Request for an estimate of every test record after every training."""

    __pydantic_config__ = STRICT

    reference: str
    settings: dict[str, Any]
    seeds: tuple[int, ...] = ()
    training: int = 0  # number of records
    tests: int = 0
    car: dict[str, Any] | None = None  # None requests only a description of the estimator


@dataclass(frozen=True, kw_only=True)
class TrainingReport:
    """Cost of one training, as reported by the worker."""

    __pydantic_config__ = STRICT

    seed: int
    train_seconds: float
    estimate_seconds: float
    parameters: int


@dataclass(frozen=True, kw_only=True)
class Response:
    """Response of a worker: its trainings, the description of the estimator, or a failure."""

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
    """Write a request and its drives to `folder`/in and create `folder`/out, in the client."""
    inputs = folder / "in"
    inputs.mkdir(parents=True)
    (folder / "out").mkdir()
    for k, (record, truth) in enumerate(training):
        write_record(inputs / f"training-{k}.parquet", record, {})
        np.savez(inputs / f"training-{k}.npz", s=truth.s, z=truth.z)
    for k, record in enumerate(tests):
        write_record(inputs / f"test-{k}.parquet", record, {})
    (inputs / "request.json").write_text(json.dumps(dataclasses.asdict(request)), encoding="utf-8")


def read_request(folder: Path) -> Request:
    """Read a request, in the worker."""
    text = (folder / "in" / "request.json").read_text(encoding="utf-8")
    return build(Request, json.loads(text), "request.json")


def read_drives(
    folder: Path, request: Request
) -> tuple[list[tuple[Record, Profile]], list[Record], VehicleParameters]:
    """Read training drives with their truth, test records and vehicle, in the worker."""
    inputs = folder / "in"
    training = []
    for k in range(request.training):
        with np.load(inputs / f"training-{k}.npz") as truth:
            pair = _record(inputs / f"training-{k}.parquet"), Profile(truth["s"], truth["z"])
        training.append(pair)
    tests = [_record(inputs / f"test-{k}.parquet") for k in range(request.tests)]
    return training, tests, build(VehicleParameters, request.car or {}, "car")


def _record(path: Path) -> Record:
    record, _ = read_record(path)
    return record


def write_estimates(folder: Path, seed: int, estimates: Sequence[Estimate]) -> None:
    """Write the estimates of one training, in the worker."""
    arrays: dict[str, np.ndarray] = {}
    for k, estimate in enumerate(estimates):
        arrays[f"z{k}"] = np.ascontiguousarray(estimate.z, dtype=float)
        if estimate.z_std is not None:
            arrays[f"z_std{k}"] = np.ascontiguousarray(estimate.z_std, dtype=float)
    with (folder / "out" / f"seed-{seed}.npz").open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def write_response(folder: Path, response: Response) -> None:
    """Write the response, the last step of the worker."""
    with atomic_write(folder / "out" / "response.json") as partial:
        partial.write_text(json.dumps(dataclasses.asdict(response)), encoding="utf-8")


def read_response(folder: Path) -> Response | None:
    """Read the response, in the client; None if there is none.

    Raises EntryError for an invalid one.
    """
    data = _read_regular_file(folder / "out", "response.json", MAX_RESPONSE_SIZE)
    if data is None:
        return None
    try:
        return build(Response, json.loads(data), "its response")
    except (ConfigError, ValueError, RecursionError) as error:
        raise EntryError(f"its response is invalid: {' '.join(str(error).split())}") from None


def read_training_run(
    folder: Path, training: TrainingReport, tests: Sequence[Record]
) -> TrainingRun:
    """Read the estimates of one training, in the client. Raises EntryError.

    Stations are not read but those of the scoring grid; `check_estimate` checks the values.
    """
    stations = [profile_stations(record.length) for record in tests]
    arrays_size = sum(2 * 2 * 8 * s.size for s in stations)  # heights and standard deviations
    limit = int(ESTIMATES_MARGIN * arrays_size) + 10_000 * (len(tests) + 1)
    name = f"seed-{training.seed}.npz"
    data = _read_regular_file(folder / "out", name, limit)
    if data is None:
        raise EntryError(f"its estimates of the training with seed {training.seed} are missing")
    try:
        arrays = _arrays(data, {f"{kind}{k}": (2, s.size) for k, s in enumerate(stations)
                                for kind in ("z", "z_std")})  # fmt: skip
        estimates = [
            Estimate(s, arrays[f"z{k}"], arrays.get(f"z_std{k}")) for k, s in enumerate(stations)
        ]
    except KeyError as error:
        raise EntryError(f"{name}: the array {error.args[0]} is missing") from None
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
    """Return the float arrays of an .npz by name.

    Raises ValueError for a name or a shape not in `shapes` before allocating memory of that size.
    """
    arrays = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for member in archive.namelist():
            name = member.removesuffix(".npy")
            if name not in shapes:
                raise ValueError(f"unexpected array {name!r}")
            with archive.open(member) as file:
                version = npy.read_magic(file)
                if version != (1, 0):
                    raise ValueError(f"{name}: .npy format {version}, must be (1, 0)")
                shape, by_columns, dtype = npy.read_array_header_1_0(file)
                if shape != shapes[name] or dtype != np.dtype(float) or by_columns:
                    raise ValueError(f"{name}: must be float64 {shapes[name]}, got {dtype} {shape}")
                size = 8 * int(np.prod(shape))
                content = file.read(size)
                if len(content) != size:
                    raise ValueError(f"{name}: truncated")
                arrays[name] = np.frombuffer(content).reshape(shape)
    return arrays


def _read_regular_file(folder: Path, name: str, limit: int) -> bytes | None:
    """Read a regular file of at most `limit` bytes, not following links; None if it is missing.

    Raises EntryError.
    """
    try:
        parent = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK  # a pipe must not block the client
            handle = os.open(name, flags, dir_fd=parent)
        finally:
            os.close(parent)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise EntryError(f"{name} cannot be read: {error.strerror}") from None
    with open(handle, "rb") as file:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise EntryError(f"{name} is not a regular file")
        if status.st_size > limit:
            raise EntryError(f"{name} has {status.st_size} bytes, the limit is {limit}")
        return file.read(limit)
