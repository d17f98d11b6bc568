"""Simulation of records with their true profiles, and records as Parquet files."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from road_envs.core.atomic_io import atomic_write, write_text
from road_envs.core.config import ConfigError
from road_envs.core.extras import import_pyarrow
from road_envs.core.reading import parsing, read_parquet
from road_envs.records.accelerometers import column, from_plain, to_plain
from road_envs.records.record import SENSORS, LowPass, Profile, Record, profile_stations
from road_envs.roads import Road, realise_road
from road_envs.roads.surface import Surface
from road_envs.sensing.data_logger import DataLogger
from road_envs.sensing.instruments import Instruments, load_instruments
from road_envs.sensing.perturbed_vehicle import PlantMismatch, perturb_vehicle
from road_envs.simulation.drive import DriveSimulator
from road_envs.simulation.speed import MAX_SPEED_KMH
from road_envs.vehicle.parameters import DEFAULT_STEP, VehicleParameters, load_vehicle
from road_envs.vehicle.struts import Modes
from road_envs.vehicle.suspension import MODES, decode_commands, encode_command

FORMAT = "roadrecon record 1"
CHUNK = 20_000  # integrator steps that are simulated before their motion is sampled and discarded


def true_profile(surface: Surface) -> Profile:
    """Return the profile of both wheel paths at the stations at which estimates are scored."""
    s = profile_stations(surface.length)
    return Profile(s, surface.height(s))


def simulate_record(
    road: str | Path | Mapping[str, Any] | Road | Surface,
    *,
    speed_kmh: float,
    mode: str | Mapping[str, str] | None = None,
    seed: int | np.random.SeedSequence = 1,
    vehicle: str | Path | VehicleParameters = "land_rover_defender_110",
    instruments: str | Path | Instruments = "paper",
    grade: str = "S0",
    length: float | None = None,
    step: float = DEFAULT_STEP,
    plant_mismatch: PlantMismatch | None = None,
    individual: int | np.random.SeedSequence | None = None,
    position_noise: bool = False,
) -> tuple[Record, Profile]:
    """Drive a vehicle over a road; return what its instruments record, and the true profile.

    `road` is a shipped name, a file, a description or a realised Surface; `length` [m] changes
    that of a road that has no fixed one. `mode` is one of the car's ("ride", "handling", ..., or
    "passive"), or one of these for "front" and "rear"; by default it is the first. `grade` "S1" to
    "S4" drives a vehicle that departs from its description (`road_envs.sensing.perturbed_vehicle`),
    by the shipped `plant_mismatch` unless another is given. `seed` draws the road, the sensor noise
    and the individual vehicle, unless `individual` is the seed of that, for several drives of one.
    `step` [s] is the integrator's. `position_noise`: the position fixes of "S3" and "S4" wander as
    those of a receiver. Raises ConfigError, SimulationError.
    """
    if not 0.0 < speed_kmh <= MAX_SPEED_KMH:
        raise ConfigError(
            f"the speed must be above 0 and at most {MAX_SPEED_KMH:g} km/h, got {speed_kmh:g} km/h"
        )
    if isinstance(seed, int) and seed < 0:
        raise ConfigError(f"the seed must not be negative, got {seed}")
    surface = road if isinstance(road, Surface) else realise_road(road, seed, length)
    car = vehicle if isinstance(vehicle, VehicleParameters) else load_vehicle(vehicle)
    if not isinstance(instruments, Instruments):
        instruments = load_instruments(instruments)
    k = len(instruments.accelerometers)
    drawn_by = seed if individual is None else individual
    one = perturb_vehicle(car, grade, drawn_by, plant_mismatch, k, position_noise)
    step = min(step, one.step)
    drive = DriveSimulator(one.plant, one.car, surface, speed_kmh / 3.6, mode, step)
    logger = DataLogger(instruments, one.car, step, np.random.default_rng(seed), one.faults)
    byte, parts = encode_command(mode, car), []
    while drive.steps_left:  # in chunks, which bounds the memory of a long drive
        commands = np.full(min(CHUNK, drive.steps_left), byte, dtype=np.uint8)
        parts.append(logger.sample(drive.advance(commands)))
    a = np.concatenate([*parts, logger.flush()], axis=1)
    t = np.arange(a.shape[1]) / instruments.fs
    distance, v, _ = drive.speed_profile.at(t)
    s, v = drive.start + logger.odometer(distance), logger.speed_gain * v
    stiff, high = decode_commands(np.full(t.size, byte))
    record = Record(t, a, v, s, stiff, high, surface.length, instruments.layout)
    return record, true_profile(surface)


def write_record(
    path: Path, record: Record, provenance: Mapping[str, object], modes: Modes = MODES
) -> None:
    """Write a record atomically as Parquet, with `provenance` in the metadata, or as CSV.

    A CSV file is a table as other data loggers write it (`road_envs.drives.measured_record`), with
    the names of the car's `modes`; the road before and behind the drive is not in it.
    """
    if path.suffix.lower() == ".csv":
        _write_csv(path, record, provenance, modes)
        return
    pa, pq = import_pyarrow()
    data = (record.t, *record.a, record.v, record.s, record.commands)
    about = {"format": FORMAT, "length": record.length, "provenance": dict(provenance)}
    if record.sensors is not None:
        about["sensors"] = to_plain(record.sensors)
    if record.low_pass is not None:
        about["low_pass"] = list(record.low_pass)
    table = pa.table(dict(zip(_columns(record.channels), data, strict=True)))
    table = table.replace_schema_metadata({"roadrecon": json.dumps(about)})
    with atomic_write(path) as partial:
        pq.write_table(table, partial)


def _columns(channels: Iterable[str]) -> tuple[str, ...]:
    """Return the columns of a record as Parquet."""
    return ("t", *map(column, channels), "v", "s", "commands")


def _write_csv(path: Path, record: Record, provenance: Mapping[str, object], modes: Modes) -> None:
    names = {setting: name for name, setting in modes.items()}
    states = np.stack([record.spring_stiff, record.damper_high], axis=2)
    by_axle = [[names[bool(k), bool(c)] for k, c in states[:, wheel]] for wheel in (0, 2)]
    accelerations = [f"{column(name)} [m/s2]" for name in record.channels]
    header = ("t [s]", *accelerations, "v [m/s]", "s [m]", "mode_front", "mode_rear")
    lines = [f"# simulated: {json.dumps(dict(provenance))}", ",".join(header)]
    for t, a, v, s, front, rear in zip(
        record.t, record.a.T, record.v, record.s, *by_axle, strict=True
    ):
        cells = ["" if np.isnan(x) else f"{x:.4f}" for x in a]
        lines.append(",".join([f"{t:.6g}", *cells, f"{v:.4f}", f"{s:.4f}", front, rear]))
    write_text(path, "\n".join(lines) + "\n")


def is_record(path: Path) -> bool:
    """Return whether a file is a record of this package, or a Parquet file that is damaged."""
    pa, pq = import_pyarrow()
    if path.suffix.lower() != ".parquet":
        return False
    try:
        return b"roadrecon" in (pq.read_schema(path).metadata or {})
    except (OSError, pa.ArrowException):
        return True


def read_record(path: Path) -> tuple[Record, dict[str, object]]:
    """Read a record and its provenance from Parquet. Raises ConfigError if invalid."""
    with parsing(path, ConfigError, "damaged, or no Parquet file"):
        table = read_parquet(path)
    with parsing(path, ConfigError, "not a RoadRecon record"):
        about = json.loads((table.schema.metadata or {})[b"roadrecon"])
        if about["format"] != FORMAT or not 0.0 < about["length"] < np.inf:
            raise ConfigError(f"not a RoadRecon record (its metadata lacks {FORMAT!r})")
    sensors = from_plain(about.get("sensors"), str(path))
    columns = _columns(SENSORS if sensors is None else sensors)
    if missing := [c for c in columns if c not in table.column_names]:
        raise ConfigError(f"{path}: columns {missing} are missing; needed: {', '.join(columns)}")
    values = [table[c].to_numpy() for c in columns]
    if invalid := [c for c, x in zip(columns, values, strict=True) if x.dtype.kind not in "fu"]:
        raise ConfigError(f"{path}: columns {invalid} must hold numbers")
    t, *a, v, s, commands = values
    stiff, high = decode_commands(commands)
    low_pass = LowPass(*about["low_pass"]) if "low_pass" in about else None
    record = Record(t, np.stack(a), v, s, stiff, high, about["length"], sensors, low_pass)
    provenance = about.get("provenance")
    return record, provenance if isinstance(provenance, dict) else {}
