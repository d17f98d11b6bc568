"""Kept drives of foreign plants, as records: public boards need no other project's program.

`configs/plants` holds one Parquet file for each drive, which `python -m studies.plant_records`
writes, and a card. The true profile follows from the road and its seed. Drives of a season, whose
seeds nobody knew, are not kept: the plant drives them, as it does other roads of the same name and
vehicles that have changed since.
"""

import hashlib
import json
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from leaderboard.evaluation.task_files import settings_digest
from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.core.extras import MissingExtraError
from road_envs.drives.recording import read_record, true_profile
from road_envs.plants.driving import simulate_on_plant
from road_envs.records.record import Profile, Record
from road_envs.roads import Surface, realise_road
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle.parameters import load_vehicle

SAME_HEIGHT = 1e-5  # most [m] that heights of one road differ by, as machines round differently


def kept_path(plant: str, car: str, road: str, speed_kmh: float, seed: int) -> Path:
    """Return the file of the drive of a plant with the numbers of a shipped `car`."""
    stem = f"{plant}_{car}_{road}_{speed_kmh:g}_{seed}".replace(" ", "_")
    return config.folder() / "plants" / f"{stem}.parquet"


def facts(surface: Surface, car: str, instruments: Instruments) -> dict[str, Any]:
    """Return what the file of a kept drive says of its road, some heights [m], car and instruments.

    The car by the digest of what is driven, so without its tolerances. Raises ConfigError.
    """
    heights = surface.height(np.linspace(0.0, surface.length, 8)).round(6).tolist()
    driven = settings_digest(replace(load_vehicle(car), tolerances={}, tolerances_of=""))
    about = {"length": surface.length, "heights": heights, "instruments": asdict(instruments)}
    return cast(dict[str, Any], json.loads(json.dumps({**about, "vehicle_digest": driven})))


def kept_record(path: Path, surface: Surface, wanted: dict[str, Any]) -> Record | None:
    """Return the record of a kept drive over a surface; None if there is none of the `wanted`
    facts or its road is another one, of equal heights at some stations.
    """
    if not path.exists():
        return None
    record, about = read_record(path)
    rest, kept = dict(wanted), cast(dict[str, Any], about)
    apart = np.abs(np.subtract(kept.pop("heights", np.inf), rest.pop("heights"))).max()
    if not (apart < SAME_HEIGHT and rest.items() <= kept.items()):
        return None
    kind, road_class = kept["road"].split()  # "iso8608 B": drives over other kinds are not kept
    road = {"kind": kind, "road_class": road_class, "length": kept["length"]}
    driven = realise_road(road, kept["seed"])
    s = np.union1d(driven.s, surface.s)
    return record if np.abs(driven.height(s) - surface.height(s)).max() < SAME_HEIGHT else None


def drive_of_plant(
    plant: str, car: str, surface: Surface, speed_kmh: float, seed: int, instruments: Instruments
) -> tuple[Record, Profile]:
    """Return the record, kept or made, and the true profile of a drive over a surface.

    `seed` is that of the surface. Raises ConfigError if it is not kept nor can be made.
    """
    path = kept_path(plant, car, surface.name, speed_kmh, seed)
    if (record := kept_record(path, surface, facts(surface, car, instruments))) is not None:
        return record, true_profile(surface)
    given: dict[str, Any] = {"speed_kmh": speed_kmh, "seed": seed, "instruments": instruments}
    try:
        return simulate_on_plant(plant, surface, vehicle=car, **given)
    except MissingExtraError as error:
        raise ConfigError(f"the drive {path.name} is not kept: {error}") from None


@cache
def kept_digest(plant: str) -> str:
    """Return the SHA-256 of all kept drives of a plant."""
    files = sorted((config.folder() / "plants").glob(f"{plant}_*.parquet"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
