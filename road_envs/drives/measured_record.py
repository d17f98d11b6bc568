"""Records of measured drives, from the tables of other data loggers.

The table is text, Parquet or MDF4, with a header of column names and one row for each sample:

| quantity | column |
|---|---|
| `t` | time [s], time since 1970, or calendar time in ISO 8601 |
| `a_rf`, `a_lr`, `a_rr` | vertical accelerations of the body, upwards, at right front, left and right rear [m/s²]; others by the description |
| `v` | speed [m/s] |
| `s` | odometer [m]; without it the speed is integrated |
| `lat`, `lon` | position [°]; without `v` and `s`, the distance is that of the positions |
| `mode`, or `mode_front` and `mode_rear` | state of the struts (`ride`, `handling`, ...) |

Other columns are ignored. A header may contain its unit: `a_rf [g]`, `speed (km/h)`, `v_kmh`. Other
names and units, accelerometers at other places, axes that point down, and one speed or mode for the
whole drive are given by a `DriveDescription`. An empty cell is a lost sample of an acceleration; speed, odometer and position
are interpolated between the rows that hold them. A clock that jitters is resampled.
"""  # noqa: E501

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.channels import Channels, TableFindings
from road_envs.drives.logger_tables.clock import MAX_LOST_SHARE, check_rate, read_clock, resample
from road_envs.drives.logger_tables.description import DEVICE, SEAT_NOTE, DriveDescription
from road_envs.drives.logger_tables.motion import read_motion
from road_envs.drives.logger_tables.table import Table
from road_envs.drives.mount import level
from road_envs.drives.recordings.recording import Recording, Series
from road_envs.records.accelerometers import column
from road_envs.records.record import LowPass, Record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import decode_commands, encode_command

ONE_DEVICE = (
    "one phone will do: record its three axes x, y and z, from which the vertical one is found, or "
    "name a vertical column with --columns a_phone=NAME and its place with --at dashboard"
)  # what to do where a table has no acceleration that is known


class MeasuredRecord(NamedTuple):
    """Record of a drive, and what a report needs beside it.

    `notes` are assumptions and corrections; `chainage` [m] is that of station 0 of the record in
    the distances of the user; `position` (2, N) are latitude and longitude [°] at the samples, if
    known; `fs` [Hz] is the rate at which the accelerations were sampled; `has_distance`:
    the speed agrees with an odometer or with positions; `place` is that of one device, in words.
    """

    record: Record
    notes: tuple[str, ...] = ()
    chainage: float = 0.0
    position: np.ndarray | None = None
    fs: float = np.inf
    has_distance: bool = False
    place: str = ""


def recording_to_record(
    recording: Recording, description: DriveDescription, car: VehicleParameters
) -> MeasuredRecord:
    """Return the record of a device with three axes, turned upright. Raises ConfigError."""
    upright, seat = level(recording), (SEAT_NOTE,) if description.at == "seat" else ()
    table = _joined_table(upright.t, upright.vertical, recording.track)
    known = replace(description, columns={}, units={})  # the recording has been read by them
    drive = to_measured_record(table, car.wheelbase, known, car)
    notes = (*upright.notes, *recording.notes, *seat, *drive.notes)
    return drive._replace(notes=notes, place=description.at or "")


def _joined_table(t: np.ndarray, vertical: np.ndarray, track: Series | None) -> Table:
    """Return an acceleration (N,) and the track as one table, empty where either has no row.

    Times are rounded to a microsecond, so that equal ones are one row.
    """
    import pyarrow as pa

    parts = [(np.round(t, 6), vertical, f"{column(DEVICE)} [m/s2]")]
    if track is not None:
        names, slow = ("lat", "lon", "v [m/s]", "s [m]"), np.round(track.t, 6)
        known = zip(track.x.T, names, strict=True)
        parts += [(slow, x, name) for x, name in known if np.isfinite(x).any()]
    t = np.union1d(parts[0][0], slow if track is not None else ())
    columns = {"t [s]": t}
    for own, x, name in parts:
        columns[name] = np.full(t.size, np.nan)
        columns[name][np.searchsorted(t, own)] = x
    return {name: pa.array(x) for name, x in columns.items()}


def to_measured_record(
    table: Table, wheelbase: float, description: DriveDescription, car: VehicleParameters | None
) -> MeasuredRecord:
    """Return the record in a table, of a vehicle of this `wheelbase` [m].

    The speed and the mode of a description are those of the whole drive; each is required if the
    table does not hold it, and a speed besides that of the table is invalid, as is another mode.
    Modes are those of the `car`, by default of a 4S4 suspension; passive struts need none. The road
    extends from the rear axle at the first sample to the front axle at the last. Raises one
    ConfigError that lists all problems, with the columns, and the rows if there are any.
    """
    instruments = load_instruments(description.instruments)
    if description.layout is not None:
        instruments = replace(instruments, accelerometers=description.layout)
    layout = instruments.layout
    channels = Channels(table, description, layout)
    findings, clock = channels.findings, read_clock(channels)
    found = [channels.acceleration(column(name)) for name in layout]
    given = [x for x in found if x is not None]
    commands = _commands(channels, car)
    if not given and description.layout is None:
        findings.problems.append(ONE_DEVICE)
    if clock is None or not given:
        findings.raise_problems()
    assert clock is not None
    a = np.array(given)
    sampled = np.isfinite(a).any(axis=0)  # the other rows are those of slower sensors
    pairs = zip(layout, found, strict=True)
    named = {channels.headers[column(name)]: x[sampled] for name, x in pairs if x is not None}
    for (one, x), (other, y) in itertools.combinations(named.items(), 2):
        if np.array_equal(x, y, equal_nan=True):
            findings.problems.append(f"{one} and {other} are equal in all rows")
    sampled &= _new_samples(a, findings)
    t = clock.t[sampled]
    dt = check_rate(t, findings)
    motion = read_motion(channels, clock.t, t)
    findings.raise_problems()
    assert motion is not None and commands is not None
    start = float(t[0])
    even, a = resample(t - start, a[:, sampled], dt, findings)
    if (share := float(np.isnan(a).any(axis=0).mean())) > MAX_LOST_SHARE:
        raise ConfigError(
            f"{share:.0%} of the samples are lost; at most {MAX_LOST_SHARE:.0%} may be"
        )
    position = motion[2]
    v, s = (np.interp(even, t - start, x) for x in motion[:2])
    if position is not None:
        position = np.array([np.interp(even, t - start, x) for x in position])
    before = np.searchsorted(clock.t - start, even + 0.5 * dt) - 1  # a state holds until the next
    stiff, high = decode_commands(commands[np.clip(before, 0, commands.size - 1)])
    chainage = (s[0] if description.offset is None else description.offset) - wheelbase
    s = s - s[0] + wheelbase
    low_pass = None if description.low_pass is None else LowPass(description.low_pass)
    return MeasuredRecord(
        Record(even, a, v, s, stiff, high, float(s[-1]), layout, low_pass),
        notes=tuple(findings.notes),
        chainage=float(chainage),
        position=position,
        fs=1.0 / dt,
        has_distance="s" in channels or position is not None,
    )


def _new_samples(a: np.ndarray, findings: TableFindings) -> np.ndarray:
    """Return which rows (N,) of channels (K, N) are samples: all, or the new of repeated ones."""
    new = np.r_[True, (np.diff(np.nan_to_num(a), axis=1) != 0.0).any(axis=0)]
    rows = float(np.median(np.diff(np.flatnonzero(np.r_[new, True]))))
    if rows < 2.0:  # a vehicle that stands repeats its samples, too, but not between new ones
        return np.ones(new.size, dtype=bool)
    findings.notes.append(
        f"the accelerations are repeated for {rows:g} rows each; the first of equal rows are the "
        "samples"
    )
    return new


def _commands(channels: Channels, car: VehicleParameters | None) -> np.ndarray | None:
    """Return the command bytes (N,) of the strut states, None if unknown."""
    problems = channels.findings.problems
    mode, size = channels.description.mode, len(next(iter(channels.table.values()), ()))
    given = [name for name in ("mode", "mode_front", "mode_rear") if name in channels]
    if car is not None and car.is_passive and not given and mode is None:
        mode = "passive"
    if given not in ([], ["mode"], ["mode_front", "mode_rear"]) or not (given or mode):
        problem = f"given as {', '.join(given)}" if given else "missing"
        problems.append(
            f"the state of the struts is {problem}: give the column mode, or mode_front and "
            f"mode_rear, or one mode for the whole drive (--mode); {channels.list_columns()}"
        )
        return None
    try:
        whole = np.full(size, encode_command(mode, car), dtype=np.uint8) if mode else None
        if whole is not None and not given:
            return whole
        columns = [channels.texts(name) for name in (given if len(given) == 2 else given * 2)]
        pairs = list(zip(*columns, strict=True))
        encoded = {
            pair: encode_command(dict(zip(("front", "rear"), pair, strict=True)), car)
            for pair in set(pairs)
        }
        commands = np.array([encoded[pair] for pair in pairs], dtype=np.uint8)
        if whole is not None and (commands != whole).any():
            raise ConfigError(
                f"the mode {mode} is given for the whole drive (--mode), and the table has other "
                f"ones in {' and '.join(given)}: leave out --mode"
            )
        return commands
    except ConfigError as error:
        problems.append(str(error))
        return None
