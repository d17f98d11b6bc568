"""Kept drives of foreign plants, as records: public boards need no other project's program.

`configs/plants` holds one Parquet file for each drive, which `python -m studies.plant_records`
writes, and a card. The true profile follows from the road and its seed. Drives of a season, whose
seeds nobody knew, are not kept: the plant drives them.
"""

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.core.extras import MissingExtraError
from road_envs.drives.recording import read_record, true_profile
from road_envs.plants.driving import simulate_on_plant
from road_envs.records.record import Profile, Record
from road_envs.roads import Surface
from road_envs.sensing.instruments import Instruments


def kept_path(plant: str, car: str, road: str, speed_kmh: float, seed: int) -> Path:
    """Return the file of the drive of a plant with the numbers of a shipped `car`."""
    stem = f"{plant}_{car}_{road}_{speed_kmh:g}_{seed}".replace(" ", "_")
    return config.folder() / "plants" / f"{stem}.parquet"


def drive_of_plant(
    plant: str, car: str, surface: Surface, speed_kmh: float, seed: int, instruments: Instruments
) -> tuple[Record, Profile]:
    """Return the record, kept or made, and the true profile of a drive over a surface.

    `seed` is that of the surface. Raises ConfigError if it is not kept nor can be made.
    """
    path = kept_path(plant, car, surface.name, speed_kmh, seed)
    if not path.exists():
        given: dict[str, Any] = {"speed_kmh": speed_kmh, "seed": seed, "instruments": instruments}
        try:
            return simulate_on_plant(plant, surface, vehicle=car, **given)
        except MissingExtraError as error:
            raise ConfigError(f"the drive {path.name} is not kept: {error}") from None
    record, _ = read_record(path)
    return record, true_profile(surface)


@cache
def kept_digest(plant: str) -> str:
    """Return the SHA-256 of all kept drives of a plant."""
    files = sorted((config.folder() / "plants").glob(f"{plant}_*.parquet"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
