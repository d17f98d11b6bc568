"""Drives as records with their truth: made by the simulator, written to and read from Parquet."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from road_envs._atomic_io import atomic_write
from road_envs._extras import optional_import
from road_envs.config import ConfigError
from road_envs.data.record import Profile, Record, profile_stations
from road_envs.roads.surface import Surface
from road_envs.sensing.data_logger import DataLogger, Instruments
from road_envs.simulation.drive import DriveSimulator
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.perturbed_vehicle import PlantMismatch, perturb_vehicle
from road_envs.vehicle.suspension import decode_commands, encode_command

COLUMNS = ("t", "a_rf", "a_lr", "a_rr", "v", "s", "commands")
FORMAT = "roadrecon record 1"
CHUNK = 20_000
"""Integrator steps between which samples are taken out of the motion."""


def true_profile(surface: Surface) -> Profile:
    """The profile of both wheel paths on the grid on which estimates are judged."""
    s = profile_stations(surface.length)
    return Profile(s, surface.height(s))


def simulate_record(
    car: VehicleParameters,
    surface: Surface,
    *,
    speed_kmh: float,
    mode: str | Mapping[str, str],
    instruments: Instruments,
    seed: int | np.random.SeedSequence,
    step: float = 0.001,
    grade: str = "S0",
    plant_mismatch: PlantMismatch | None = None,
) -> tuple[Record, Profile]:
    """Drive over a surface and return what the instruments recorded, and the truth.

    `grade` is the field car's (`road_envs.vehicle.perturbed_vehicle`), S0 the `car` itself;
    `plant_mismatch` are those shipped unless others are given. `seed` draws the sensor noise and,
    apart from it, the individual that is driven. Raises ConfigError, SimulationError.
    """
    one = perturb_vehicle(car, grade, seed, plant_mismatch)
    step, enveloped_surface = min(step, one.step), one.enveloped(surface)
    drive = DriveSimulator(one.plant, one.car, enveloped_surface, speed_kmh / 3.6, mode, step)
    logger = DataLogger(instruments, one.car, step, np.random.default_rng(seed), one.faults)
    byte, parts = encode_command(mode), []
    while not drive.is_finished:  # in parts, so that a long drive never holds its whole motion
        commands = np.full(min(CHUNK, drive.steps_left), byte, dtype=np.uint8)
        parts.append(logger.sample(drive.advance(commands)))
    a = np.concatenate([*parts, logger.flush()], axis=1)
    t = np.arange(a.shape[1]) / instruments.fs
    distance, v, _ = drive.speed_profile.at(t)
    s, v = drive.start + logger.odometer(distance), logger.speed_gain * v
    stiff, high = decode_commands(np.full(t.size, byte))
    return Record(t, a, v, s, stiff, high, surface.length), true_profile(surface)


def write_record(path: Path, record: Record, provenance: Mapping[str, object]) -> None:
    """Write a record as Parquet, whole or not at all; `provenance` goes into its metadata."""
    with optional_import("a table as CSV or Parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq

    bits = np.concatenate([record.spring_stiff, record.damper_high], axis=1) << np.arange(8)
    data = (record.t, *record.a, record.v, record.s, bits.sum(axis=1).astype(np.uint8))
    about = {"format": FORMAT, "length": record.length, "provenance": dict(provenance)}
    table = pa.table(dict(zip(COLUMNS, data, strict=True)))
    table = table.replace_schema_metadata({"roadrecon": json.dumps(about)})
    with atomic_write(path) as partial:
        pq.write_table(table, partial)


def is_record(path: Path) -> bool:
    """Whether a file claims to be a record of this package, readable or not."""
    with optional_import("a table as CSV or Parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq

    if path.suffix.lower() != ".parquet":
        return False
    try:
        return b"roadrecon" in (pq.read_schema(path).metadata or {})
    except (OSError, pa.ArrowException):
        return True


def read_record(path: Path) -> tuple[Record, dict[str, object]]:
    """A record and its provenance from Parquet. Raises ConfigError that says what is wrong."""
    with optional_import("a table as CSV or Parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise ConfigError(
            f"{path}: no readable Parquet file: {str(error).splitlines()[0]}"
        ) from None
    try:
        about = json.loads((table.schema.metadata or {})[b"roadrecon"])
    except (KeyError, ValueError):
        about = None
    if not (isinstance(about, dict) and about.get("format") == FORMAT and "length" in about):
        raise ConfigError(f"{path}: not a RoadRecon record (its metadata lacks {FORMAT!r})")
    if missing := [c for c in COLUMNS if c not in table.column_names]:
        raise ConfigError(f"{path}: columns {missing} are missing; wanted: {', '.join(COLUMNS)}")
    column = {c: table[c].to_numpy() for c in COLUMNS}
    if strange := [c for c in COLUMNS if column[c].dtype.kind not in "fu"]:
        raise ConfigError(f"{path}: columns {strange} must hold numbers")
    a = np.stack([column["a_rf"], column["a_lr"], column["a_rr"]])
    stiff, high = decode_commands(column["commands"])
    record = Record(column["t"], a, column["v"], column["s"], stiff, high, about["length"])
    return record, about.get("provenance", {})
