"""Command `new-vehicle`: a vehicle file for those who know little of their car."""

from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import console
from road_envs.core.config import ConfigError
from road_envs.vehicle.generic_cars import CLASSES, fitted_vehicle
from road_envs.vehicle.parameters import write_vehicle

Class = Annotated[
    str, typer.Option("--class", prompt="class", help=f"One of {', '.join(CLASSES)}.")
]
Mass = Annotated[float, typer.Option(prompt="mass [kg]", help="Mass ready to drive [kg].")]
Wheelbase = Annotated[float, typer.Option(prompt="wheelbase [m]", help="Between the axles [m].")]
Track = Annotated[
    float, typer.Option(prompt="track [m]", help="Between a left and right tyre [m].")
]


def new_vehicle(
    out: Annotated[Path, typer.Argument(help="File to write, such as my_car.yaml.")],
    car_class: Class,
    mass: Mass,
    wheelbase: Wheelbase,
    track: Track,
) -> None:
    """Write a vehicle file of a class with its mass, wheelbase, track and tolerances.

    What is not given is asked for. The registration papers have mass and wheelbase; the track is
    in any data sheet.
    """
    if out.exists():
        raise ConfigError(f"{out} exists: choose another file, or remove it")
    car = fitted_vehicle(out.stem, car_class, mass, wheelbase, track)
    head = f"A {car_class} of {mass:g} kg, {wheelbase:g} m wheelbase, {track:g} m track. SI units."
    write_vehicle(out, car, head)
    console.print(str(out), highlight=False)
    console.print(
        f"next: road-recon identify DRIVE DRIVE --vehicle {out} narrows its tolerances",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
