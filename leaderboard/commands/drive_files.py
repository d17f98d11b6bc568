"""Options of commands that read drives from files, and what an estimator adds to reading them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from leaderboard.commands import YAML, check_output_path, parse_mode, parse_pairs
from leaderboard.commands.options import MODE_NAMES, SENSORS, VEHICLE, argument, option
from leaderboard.drive_report.drive_estimates import with_doubts
from road_envs.core.config import ConfigError
from road_envs.drives import reading
from road_envs.drives.logger_tables.description import write_description
from road_envs.drives.reading import DriveFile

KINDS = "a record from `simulate`, or a measured drive: zip or folder of an app, table, .vbo, ..."
RecordFile = Annotated[Path, argument(f"The drive: {KINDS}")]
RecordFiles = Annotated[list[Path], argument(f"Drives over one road, each {KINDS}")]


@dataclass(frozen=True, kw_only=True)
class DriveOptions:
    """Options of a command that describe a drive; None is left to its description or file."""

    vehicle: Annotated[str | None, VEHICLE] = None
    at: Annotated[
        str | None,
        option(
            "Place of one phone: dashboard, floor, seat, trunk, bumper, or metres ahead of the "
            "front axle and to the left, -0.5,0.2."
        ),
    ] = None
    track: Annotated[
        Path | None, option("GPX file or table with speed or positions of the drive.")
    ] = None
    sensors: Annotated[str | None, SENSORS] = None
    mode: Annotated[str | None, option(MODE_NAMES)] = None
    speed_kmh: Annotated[float | None, option("Speed of the drive in km/h.", min=0.1)] = None
    columns: Annotated[
        str | None,
        option("Names of columns: a_rf=acc_front,v=speed,... (t, a_rf, a_lr, a_rr, v, s)."),
    ] = None
    units: Annotated[str | None, option("Units of columns: a_rf=g,t=ms,v=km/h,...")] = None
    invert: Annotated[str | None, option("Accelerations whose axis points down: a_rf,...")] = None
    offset: Annotated[
        float | None, option("Chainage in metres of the front axle at the first sample.")
    ] = None
    description: Annotated[
        Path | None, option("Read these choices from a description (.yaml).")
    ] = None
    save_description: Annotated[
        Path | None, option("Write the choices, and what was found, as a description (.yaml).")
    ] = None

    def given(self) -> dict[str, Any]:
        """The fields of a DriveDescription that are given. Raises ConfigError."""
        named = {"columns": self.columns, "units": self.units}
        pairs = {k: None if text is None else parse_pairs(k, text) for k, text in named.items()}
        invert = None if self.invert is None else tuple(x.strip() for x in self.invert.split(","))
        plain = {k: getattr(self, k) for k in ("vehicle", "at", "sensors", "speed_kmh", "offset")}
        mode = None if self.mode is None else parse_mode(self.mode)
        return {**plain, **pairs, "invert": invert, "mode": mode}


def read_drive(path: Path, options: DriveOptions) -> DriveFile:
    """Read the one drive in a file, with doubts of its description. Raises ConfigError."""
    check_output_path(options.save_description, *YAML)
    drive = reading.read_drive(path, options.description, track=options.track, **options.given())
    return _checked([drive], options)[0]


def read_passes(paths: Sequence[Path], options: DriveOptions) -> list[DriveFile]:
    """Read the drives in several files, with doubts of their descriptions. Raises ConfigError."""
    check_output_path(options.save_description, *YAML)
    drives = reading.read_passes(paths, options.description, track=options.track, **options.given())
    return _checked(drives, options)


def _checked(drives: list[DriveFile], options: DriveOptions) -> list[DriveFile]:
    if options.save_description:
        if not drives[0].is_table:
            raise ConfigError(
                "a record of `simulate` contains all that belongs to the drive: leave out "
                "--save-description"
            )
        write_description(options.save_description, drives[0].description)
    return [with_doubts(drive) for drive in drives]
