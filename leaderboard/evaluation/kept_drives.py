"""Kept drives of foreign plants, as records: boards need no other project's program.

`configs/plants` holds one Parquet file for each drive, which `python -m studies.plant_records`
writes, and a card. The true profile follows from the road and its seed.
"""

import hashlib
from functools import cache
from pathlib import Path

from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.drives.recording import read_record, true_profile
from road_envs.records.record import Profile, Record
from road_envs.roads import Surface


def kept_path(plant: str, car: str, road: str, speed_kmh: float, seed: int) -> Path:
    """Return the file of the drive of a plant with the numbers of a shipped `car`."""
    stem = f"{plant}_{car}_{road}_{speed_kmh:g}_{seed}".replace(" ", "_")
    return config.folder() / "plants" / f"{stem}.parquet"


def kept_drive(
    plant: str, car: str, surface: Surface, speed_kmh: float, seed: int
) -> tuple[Record, Profile]:
    """Return a kept record and the true profile of the `surface` of `seed`.

    Raises ConfigError if this drive is not kept.
    """
    path = kept_path(plant, car, surface.name, speed_kmh, seed)
    if not path.exists():
        raise ConfigError(
            f"the drive {path.name} of the plant {plant} is not kept: tasks with a plant have the "
            "shipped roads and seeds; others are driven by road-recon simulate --plant"
        )
    record, _ = read_record(path)
    return record, true_profile(surface)


@cache
def kept_digest(plant: str) -> str:
    """Return the SHA-256 of all kept drives of a plant."""
    files = sorted((config.folder() / "plants").glob(f"{plant}_*.parquet"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
