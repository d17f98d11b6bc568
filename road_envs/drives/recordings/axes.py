"""Tables with the three axes of one accelerometer: which columns they are, and their unit."""

import re

import numpy as np

from road_envs.drives.logger_tables.channels import Channels, TableFindings
from road_envs.drives.logger_tables.clock import read_clock
from road_envs.drives.logger_tables.description import DEVICE, PREFIX, DriveDescription
from road_envs.drives.logger_tables.table import Table, numeric_values
from road_envs.drives.recordings.recording import Recording, Series, make_track
from road_envs.records import units
from road_envs.records.accelerometers import column

AXIS = re.compile(r"(?P<before>.*?)[ _.\-]*(?P<axis>[xyz])(?P<after>[ _.\-]*(acc\w*)?)")
"""A name of an axis: "acc_x", "ax", "accelerationX", "linear_acceleration.x", "x_accel", "x"."""

LINEAR = ("linear", "user", "without gravity", "no gravity", "nograv")
"""Words in a name without gravity; the `linear_acceleration` of ROS includes it."""

_Axes = tuple[list[str], bool]  # headers of x, y and z, and whether they are without gravity


def find_axes(table: Table, description: DriveDescription) -> _Axes | None:
    """Return the columns of the three axes of one accelerometer; None if there are none.

    A table with a column of an acceleration of this package, or that is described, has none.
    """
    if any(name.startswith(PREFIX) for name in description.columns) or description.accelerometers:
        return None
    groups: dict[str, dict[str, str]] = {}
    for header in table:
        name = units.split_header(header)[0].strip().lower()
        if name in ("a_rf", "a_lr", "a_rr", "a_phone"):
            return None
        found = AXIS.fullmatch(name)
        key = found and re.sub(r"[^a-z]+", " ", found["before"] + " " + found["after"]).strip()
        if found and key is not None and ("acc" in key or key in ("", "a")):
            groups.setdefault(key, {})[found["axis"]] = header
    complete = {key: axes for key, axes in groups.items() if len(axes) == 3}
    if not complete:
        return None
    # gravity tells the mount: axes that include it come first, then those that are named, and
    # those of ROS only if there are no others
    best = min(complete, key=lambda key: (_is_linear(key), "acc" not in key, "linear" in key))
    return [complete[best][axis] for axis in "xyz"], _is_linear(best)


def _is_linear(key: str) -> bool:
    return any(word in key for word in LINEAR) and key != "linear acceleration"


def to_recording(name: str, table: Table, axes: _Axes, description: DriveDescription) -> Recording:
    """Return the recording in a table with three axes. Raises ConfigError."""
    (headers, is_linear), channels = axes, Channels(table, description, (DEVICE,))
    findings, clock = channels.findings, read_clock(channels)
    given = description.units.get(column(DEVICE), "")
    x = np.column_stack([_acceleration(table, h, given, findings) for h in headers])
    columns = [channels.numbers(key) for key in ("lat", "lon", "v", "s")]
    findings.raise_problems()
    assert clock is not None
    track = make_track(clock.t, *columns)
    track = track[np.isfinite(track.x).any(axis=1)]
    return Recording(
        name=name, acceleration=Series(clock.t, x)[np.isfinite(x).all(axis=1)],
        track=track if track.t.size else None,
        lacks_gravity=is_linear, epoch=clock.epoch, notes=tuple(findings.notes),
        unit_named=bool(given) or any(units.split_header(h)[1] for h in headers),
        is_table=True,
    )  # fmt: skip


def _acceleration(table: Table, header: str, given: str, findings: TableFindings) -> np.ndarray:
    """Return an axis [m/s²] by the unit that is `given`, if any, or that of its `header`."""
    try:
        x = numeric_values(table[header])
        unit = given or units.split_header(header)[1]
        return x * (units.factor("acceleration", unit) if unit else 1.0)
    except ValueError as error:
        findings.problems.append(f"the column {header}: {error}")
        return np.full(len(table[header]), np.nan)
