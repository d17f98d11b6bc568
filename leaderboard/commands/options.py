"""Options that several commands share, and the limits of guests from them."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from leaderboard.sandbox.limits import Isolation, Limits
from road_envs.core.config import ConfigError, names, validate_choice
from road_envs.vehicle.struts import MODES, PASSIVE_MODES

CORES = os.cpu_count() or 1


def argument(text: str) -> Any:
    """An argument with its help."""
    return typer.Argument(help=text)


def option(text: str, *names: str, **settings: Any) -> Any:
    """An option with its help; `names` are those that differ from its parameter's."""
    return typer.Option(*names, help=text, **settings)


Road = Annotated[
    str,
    option(
        "Road: a name of `road-recon list roads`, a YAML path or a surface file "
        "(.crg, .erd, .csv, .parquet)."
    ),
]
Speed = Annotated[float, option("Speed in km/h.")]
MODE_NAMES = f"Mode of the struts: {', '.join([*MODES, *PASSIVE_MODES])}, or front=MODE,rear=MODE."
Mode = Annotated[str | None, option(f"{MODE_NAMES} Default: the vehicle's first.")]
Length = Annotated[float | None, option("Another length of the road in metres.")]
Seed = Annotated[int, option("Seed of the road, and of the sensors' noise.", min=0)]
VEHICLE = option(f"Vehicle: {', '.join(names('vehicles'))}, or a YAML path.")
SENSORS = option(f"Instruments: {', '.join(names('sensors'))}, or a YAML path.")
Vehicle = Annotated[str, VEHICLE]
Sensors = Annotated[str, SENSORS]
Settings = Annotated[list[str] | None, option("Setting, key=value; may be given again.", "--set")]
KnownRoads = Annotated[
    list[str] | None,
    option("Known road of each drive in turn (.csv, .crg, ...), or one for all.", "--profile"),
]
ResultsFolder = Annotated[Path, option("Folder of results, as for `leaderboard`.")]
Share = Annotated[float, option("Share of the drives of each task.", min=0.0, max=1.0)]
Workers = Annotated[int, option("Jobs at a time on this machine.", min=1)]
Json = Annotated[bool, option("Print JSON instead of a table.", "--json")]


@dataclass(frozen=True, kw_only=True)
class LimitOptions:
    """Options that limit code from other packages."""

    time_limit: Annotated[
        float,
        option("Time limit in seconds, of an entry per condition or a policy per case.", min=0.001),
    ] = Limits.seconds
    memory_limit: Annotated[float, option("Memory limit in GiB.", min=0.1)] = Limits.memory
    isolation: Annotated[
        str,
        option(
            "Isolation of code from other packages: bubblewrap; process: with your rights; "
            "auto: bubblewrap where it is available, else the code is refused."
        ),
    ] = "auto"

    def parse(self) -> Limits:
        """Return the limits. Raises ConfigError."""
        choice: Any = validate_choice("isolation", self.isolation, list(get_args(Isolation)))
        try:
            return Limits(seconds=self.time_limit, memory=self.memory_limit, isolation=choice)
        except ValueError as error:
            raise ConfigError(f"limits: {error}") from None
