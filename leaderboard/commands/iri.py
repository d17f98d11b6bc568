"""Command `iri`: roughness indices of a profile."""

from pathlib import Path
from typing import Annotated

from leaderboard.commands import make_table
from leaderboard.commands.options import argument, option
from leaderboard.commands.output import Output
from road_envs.core.config import ConfigError
from road_envs.records.roughness import IN_PER_MI, profile_indices
from road_envs.roads import realise_road

_HEADS = ("from [m]", "to [m]", "left", "right", "mean", "half-car (HRI)", "mean [in/mi]")


def iri(
    *,
    profile: Annotated[Path, argument("Profile or surface: .csv, .erd, .crg, ...")],
    segment: Annotated[float, option("Length of a segment in m.", min=1.0)] = 100.0,
) -> Output:
    """Print the International Roughness Index of a profile by segment (ASTM E1926).

    Left and right are those of the wheel paths, mean is their mean (MRI), and the half-car index
    (HRI) that of the mean profile, in mm/m.
    """
    if not profile.is_file():
        raise ConfigError(f"{profile}: no such file; give a profile or a surface, such as road.erd")
    surface = realise_road(profile, 0)
    rows = profile_indices(surface.z, surface.ds, segment)
    whole = profile_indices(surface.z, surface.ds, float("inf"))[0]
    keys = ("left", "right", "mean", "half_car")
    cells = [
        (
            f"{row['begin_m']:.1f}",
            f"{row['end_m']:.1f}",
            *(f"{row[key]:.2f}" for key in keys),
            f"{IN_PER_MI * row['mean']:.0f}",
        )
        for row in (*rows, whole)
    ]
    facts = {"file": str(profile), "spacing_m": surface.ds, "segments": rows, "whole": whole,
             "notes": list(surface.notes)}  # fmt: skip
    told = "IRI in mm/m; the last line is that of the whole profile"
    return Output(facts=facts, shows=[make_table(_HEADS, cells), told])
