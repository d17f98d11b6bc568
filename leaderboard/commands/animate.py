"""Command `animate`: animation of the vehicle on its road."""

from pathlib import Path
from typing import Annotated

from leaderboard.commands import check_output_path, console, progress_bar
from leaderboard.commands.options import Length, Road, Speed, Vehicle, option
from leaderboard.report import animation
from road_envs.drives.reading import DEFAULT_VEHICLE


def animate(
    out: Annotated[Path, option("Picture to write (.gif or .webp).")],
    road: Road = "belgian",
    vehicle: Vehicle = DEFAULT_VEHICLE,
    speed_kmh: Speed = 54.0,
    length: Length = None,
    seconds: Annotated[float, option("Duration in seconds.", min=0.1)] = 6.5,
    enlarged: Annotated[float, option("Factor on the drawn vertical motion.")] = 2.0,
) -> None:
    """Draw the vehicle on its road: ride for the first half, handling for the second.

    Passive struts have one state. Wheelbase and track are the vehicle's, the outline is the same.
    """
    check_output_path(out, ".gif", ".webp")
    options = {"road": road, "vehicle": vehicle, "speed_kmh": speed_kmh, "length": length}
    with progress_bar() as progress:
        animation.animate(options | {"exaggeration": enlarged}, seconds, out, progress)
    console.print(f"written: {out} ({out.stat().st_size / 1e6:.1f} MB)")
