"""`classify`: roughness and ISO class of the road of a record, straight from its accelerations."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from estimators import spectral_class
from leaderboard.commands import console, print_json
from leaderboard.commands.drives import Json, Sensors, Vehicle
from road_envs.dataset import read_record
from road_envs.vehicle import load_vehicle


def classify(
    record: Annotated[Path, typer.Argument(help="A record from `simulate` (.parquet).")],
    vehicle: Vehicle = "land_rover_defender_110",
    sensors: Sensors = "paper",
    json: Json = False,
) -> None:
    """Tell the ISO 8608 class of the road of a record, with its probability, octave by octave."""
    seen, _ = read_record(record)
    found = spectral_class.classify(seen, load_vehicle(vehicle), sensors)
    if json:
        facts = found._asdict()
        facts |= {key: facts[key].tolist() for key in ("octaves", "levels", "level_stds")}
        print_json({"class": found.letter, **facts})
        return
    share = 100.0 * found.probability[found.letter]
    console.print(
        f"class {found.letter} ({share:.0f} %), Gd(n0) = {1e6 * found.G_d0:.0f}e-6 m³ "
        f"± {4.34 * found.log_std:.1f} dB"
    )
    table = Table("octave [cycles/m]", "Gd(n0) [1e-6 m³]", "± [dB]", "class")
    columns = (found.octaves, found.levels, found.level_stds, found.octave_classes)
    for centre, level, std, letter in zip(*columns, strict=True):
        table.add_row(f"{centre:g}", f"{1e6 * level:.0f}", f"{4.34 * std:.1f}", letter)
    console.print(table)
