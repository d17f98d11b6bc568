"""Drives as records with their truth: made by the simulator, written to and read from Parquet."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from road_envs._atomic_io import whole
from road_envs.config import ConfigError
from road_envs.data.record import Profile, Record, grid
from road_envs.roads.surface import Surface
from road_envs.sensing.data_logger import Instruments, Logger
from road_envs.simulation.drive import Drive
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.perturbed_vehicle import Deviations, field_car
from road_envs.vehicle.suspension import command, strut_states

COLUMNS = ("t", "a_rf", "a_lr", "a_rr", "v", "s", "commands")
FORMAT = "roadrecon record 1"
CHUNK = 20_000
"""Integrator steps between which samples are taken out of the motion."""


def truth(surface: Surface) -> Profile:
    """The profile of both wheel paths on the grid on which estimates are judged."""
    s = grid(surface.length)
    return Profile(s, surface.height(s))


def record_drive(
    car: VehicleParameters,
    surface: Surface,
    *,
    speed_kmh: float,
    mode: str | Mapping[str, str],
    instruments: Instruments,
    seed: int | np.random.SeedSequence,
    step: float = 0.001,
    grade: str = "S0",
    deviations: Deviations | None = None,
) -> tuple[Record, Profile]:
    """Drive over a surface and return what the instruments recorded, and the truth.

    `grade` is the field car's (`road_envs.vehicle.perturbed_vehicle`), S0 the `car` itself; `deviations` are those
    shipped unless others are given. `seed` draws the sensor noise and, apart from it, the
    individual that is driven. Raises ConfigError, SimulationError.
    """
    one = field_car(car, grade, seed, deviations)
    step, felt = min(step, one.step), one.felt(surface)
    drive = Drive(one.plant, one.car, felt, speed_kmh / 3.6, mode, step)
    logger = Logger(instruments, one.car, step, np.random.default_rng(seed), one.faults)
    byte, parts = command(mode), []
    while not drive.over:  # in parts, so that a long drive never holds its whole motion
        commands = np.full(min(CHUNK, drive.steps_left), byte, dtype=np.uint8)
        parts.append(logger.sense(drive.advance(commands)))
    a = np.concatenate([*parts, logger.rest()], axis=1)
    t = np.arange(a.shape[1]) / instruments.fs
    distance, v, _ = drive.profile.at(t)
    s, v = drive.start + logger.odometer(distance), logger.speed_gain * v
    stiff, high = strut_states(np.full(t.size, byte))
    return Record(t, a, v, s, stiff, high, surface.length), truth(surface)


def write_record(path: Path, record: Record, provenance: Mapping[str, object]) -> None:
    """Write a record as Parquet, whole or not at all; `provenance` goes into its metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    bits = np.concatenate([record.stiff, record.high], axis=1) << np.arange(8)
    data = (record.t, *record.a, record.v, record.s, bits.sum(axis=1).astype(np.uint8))
    about = {"format": FORMAT, "length": record.length, "provenance": dict(provenance)}
    table = pa.table(dict(zip(COLUMNS, data, strict=True)))
    table = table.replace_schema_metadata({"roadrecon": json.dumps(about)})
    with whole(path) as partial:
        pq.write_table(table, partial)


def is_record(path: Path) -> bool:
    """Whether a file claims to be a record of this package, readable or not."""
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
    stiff, high = strut_states(column["commands"])
    record = Record(column["t"], a, column["v"], column["s"], stiff, high, about["length"])
    return record, about.get("provenance", {})
