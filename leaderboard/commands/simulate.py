"""Command `simulate`: a drive over a road and what its instruments record."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np

from leaderboard.commands import PICTURES, check_output_path, parse_mode
from leaderboard.commands.options import Length, Mode, Road, Seed, Sensors, Speed, Vehicle, option
from leaderboard.commands.output import Output
from leaderboard.report import plots
from road_envs.core.config import ConfigError
from road_envs.drives.reading import DEFAULT_VEHICLE
from road_envs.drives.recording import simulate_record, write_record
from road_envs.plants.driving import simulate_on_plant
from road_envs.records.roughness import iri
from road_envs.roads import realise_road, write_csv
from road_envs.sensing.data_logger import load_instruments
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import encode_command

_Grade = Annotated[
    str, option("Grade of the perturbed vehicle: S0 (as described) to S4; the seed draws it.")
]
_Plant = Annotated[
    str,
    option(
        "Vehicle model: own, or that of another project, mujoco or commonroad, which needs "
        "the extra plants and a vehicle with passive struts."
    ),
]


def simulate(
    *,
    road: Road = "belgian",
    speed_kmh: Speed = 14.5,
    mode: Mode = None,
    length: Length = None,
    seed: Seed = 1,
    vehicle: Vehicle = DEFAULT_VEHICLE,
    sensors: Sensors = "paper",
    grade: _Grade = "S0",
    position_noise: Annotated[
        bool, option("Position fixes that wander by metres (grades S3, S4).", "--position-noise")
    ] = False,
    plant: _Plant = "own",
    out: Annotated[Path | None, option("Write the record (.parquet, .csv).")] = None,
    truth: Annotated[Path | None, option("Write the true profile (.csv).")] = None,
    plot: Annotated[Path | None, option("Draw profile and record (.png).")] = None,
) -> Output:
    """Simulate a drive over a road and record the signals of the instruments."""
    check_output_path(out, ".parquet", ".csv")
    check_output_path(truth, ".csv")
    check_output_path(plot, *PICTURES)
    surface, car = realise_road(road, seed, length), load_vehicle(vehicle)
    struts = parse_mode(mode) if mode else next(iter(car.modes))
    encode_command(struts, car)  # refuses a mode that the vehicle does not have
    common: dict[str, Any] = {"vehicle": car, "speed_kmh": speed_kmh, "seed": seed}
    common["instruments"] = load_instruments(sensors)
    if plant == "own":
        common |= {"grade": grade, "position_noise": position_noise}
        record, profile = simulate_record(surface, mode=struts, **common)
    elif grade != "S0" or position_noise:
        raise ConfigError(
            f"the plant {plant} has no grades: leave out --grade and --position-noise"
        )
    else:
        record, profile = simulate_on_plant(plant, surface, **common)
    settings: dict[str, Any] = {
        "road": road, "speed_kmh": speed_kmh, "mode": struts, "vehicle": vehicle,
        "sensors": sensors, "grade": grade, "plant": plant, "seed": seed,
    }  # fmt: skip
    if position_noise:
        settings["position_noise"] = True
    if out:
        write_record(out, record, settings, car.modes)
    if truth:
        write_csv(surface, truth)
    if plot:
        plots.draw_drive(record, profile, plot)
    rms = dict(zip(record.channels, np.sqrt(np.nanmean(record.a**2, axis=1)), strict=True))
    facts = {
        **settings, "length_m": surface.length, "duration_s": float(record.t[-1]),
        "samples": record.t.size, "lost_samples": int(np.isnan(record.a).any(axis=0).sum()),
        "iri_mm_per_m": [float(iri(z, surface.ds)) for z in surface.z],
        "rms_acceleration": {name: float(value) for name, value in rms.items()},
        "notes": list(surface.notes), "written": [str(p) for p in (out, truth, plot) if p],
    }  # fmt: skip
    return Output(facts=facts)
