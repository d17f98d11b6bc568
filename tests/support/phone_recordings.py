"""Recordings as phones and loggers write them, generated after the public specifications.

The specifications are named in `road_envs/drives/recordings`; nothing is copied from real files.
`python tests/support/phone_recordings.py` writes the samples in `tests/data/recordings`.
"""

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

G = 9.80665
EPOCH = 1_777_887_000.25
"""A time since 1970 [s] in May 2026."""

FOLDER = Path(__file__).parents[1] / "data/recordings"


@dataclass(frozen=True)
class Phone:
    """What a phone measured: times (N,), axes (N, 3) [m/s²] with gravity, fixes at 1 Hz.

    `vertical` (N,) is the truth. `rotation` turns the vehicle's frame into the phone's.
    """

    t: np.ndarray
    axes: np.ndarray
    vertical: np.ndarray
    fix_t: np.ndarray
    lat: np.ndarray
    lon: np.ndarray
    v: np.ndarray
    rotation: Rotation


def phone(
    rotation: Rotation, vertical: np.ndarray | None = None, *, fs: float = 100.0,
    duration: float = 60.0, seed: int = 1, speed: float | None = None,
) -> Phone:  # fmt: skip
    """Return a drive with braking, turning and noise; constant `speed` [m/s] if it is given."""
    rng = np.random.default_rng(seed)
    n = round(fs * duration) if vertical is None else vertical.size
    t = np.arange(n) / fs
    if vertical is None:
        body = np.sin(2 * np.pi * 1.4 * t + rng.uniform(0, 6)) * (0.5 + 0.3 * np.sin(0.2 * t))
        vertical = body + 0.4 * rng.standard_normal(n)
    v = 12.0 + 4.0 * np.sin(2 * np.pi * t / 23.0) if speed is None else np.full(n, speed)
    heading = 0.7 + 0.9 * np.sin(2 * np.pi * t / 41.0) * (speed is None)
    ahead = np.gradient(v, t) + 0.15 * rng.standard_normal(n)
    left = -v * np.gradient(heading, t) + 0.15 * rng.standard_normal(n)  # heading is clockwise
    axes = rotation.apply(np.column_stack([ahead, left, vertical + G]))
    north = np.cumsum(v * np.cos(heading)) / fs
    east = np.cumsum(v * np.sin(heading)) / fs
    once = np.arange(0, n, round(fs))
    lat = 48.137 + north[once] / 111_195.0
    lon = 11.575 + east[once] / 111_195.0 / np.cos(np.radians(48.137))
    return Phone(t, axes, vertical, t[once], lat, lon, v[once], rotation)


def _csv(columns: dict[str, np.ndarray], quoted: bool = False) -> str:
    heads = [f'"{name}"' if quoted else name for name in columns]
    rows = (",".join(f"{x:.9g}" if x == x else "NaN" for x in row)
            for row in zip(*columns.values(), strict=True))  # fmt: skip
    return "\n".join([",".join(heads), *rows]) + "\n"


def _zip(members: dict[str, str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for name, text in members.items():
            file.writestr(zipfile.ZipInfo(name, (2026, 5, 4, 9, 30, 0)), text, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def phyphox_members(one: Phone, pauses: tuple[float, ...] = ()) -> dict[str, str]:
    """Return the files of phyphox' export; times stand still in `pauses` [s] of 30 s."""
    begins, ends = [0.0, *pauses], [*pauses, one.t[-1]]
    events, system = [], EPOCH
    for begin, end in zip(begins, ends, strict=True):
        events.append(("START", begin, system))
        events.append(("PAUSE", end, system + end - begin))
        system += end - begin + 30.0
    rows = [f'"{kind}",{at:.9E},{when:.3f},"2026-05-04"' for kind, at, when in events]
    heads = '"event","experiment time","system time","system time text"'
    x, y, z = one.axes.T
    return {
        "Accelerometer.csv": _csv(
            {"Time (s)": one.t, "X (m/s^2)": x, "Y (m/s^2)": y, "Z (m/s^2)": z}, True
        ),
        "Location.csv": _csv(
            {
                "Time (s)": one.fix_t, "Latitude (°)": one.lat, "Longitude (°)": one.lon,
                "Height (m)": 0 * one.v, "Velocity (m/s)": one.v, "Direction (°)": 0 * one.v,
                "Horizontal Accuracy (m)": 4 + 0 * one.v, "Vertical Accuracy (m)": 9 + 0 * one.v,
            },
            True,
        ),
        "meta/device.csv": '"property","value"\n"version","1.2.0"\n',
        "meta/time.csv": "\n".join([heads, *rows]) + "\n",
    }  # fmt: skip


def phyphox(one: Phone) -> bytes:
    """Return the zip file of phyphox' experiment "Acceleration with g" with location."""
    return _zip(phyphox_members(one))


def sensor_logger(one: Phone, total: bool = True) -> bytes:
    """Return the zip file of Sensor Logger: with `total` acceleration, or its two parts."""

    def axes(x: np.ndarray) -> str:
        stamps = (1e9 * (EPOCH + one.t)).astype(np.int64)
        rows = (f"{ns},{s:.6f},{z:.9g},{y:.9g},{x_:.9g}"
                for ns, s, (x_, y, z) in zip(stamps, one.t, x, strict=True))  # fmt: skip
        return "\n".join(["time,seconds_elapsed,z,y,x", *rows]) + "\n"

    gravity = np.tile(one.rotation.apply([0.0, 0.0, G]), (one.t.size, 1))
    members = {"Accelerometer.csv": axes(one.axes - gravity), "Gravity.csv": axes(gravity)}
    if total:
        members = {"TotalAcceleration.csv": axes(one.axes), **members}
    speed = one.v.copy()
    speed[0] = -1.0  # not known yet
    heads = "time,seconds_elapsed,bearingAccuracy,speedAccuracy,verticalAccuracy," + (
        "horizontalAccuracy,speed,bearing,altitude,longitude,latitude"
    )
    rows = [
        f"{int(1e9 * (EPOCH + t))},{t:.6f},1,0.5,3,5,{v:.4f},90,500,{lon:.7f},{lat:.7f}"
        for t, v, lat, lon in zip(one.fix_t, speed, one.lat, one.lon, strict=True)
    ]
    members["Location.csv"] = "\n".join([heads, *rows]) + "\n"
    members["Metadata.csv"] = "version,device name\n3,phone\n"
    return _zip({f"2026-05-04_09-30-00/{name}": text for name, text in members.items()})


def _wide(one: Phone) -> dict[str, np.ndarray]:
    """Return one table with empty cells where there is no fix."""
    slow = {key: np.full(one.t.size, np.nan) for key in ("v", "lat", "lon")}
    index = np.searchsorted(one.t, one.fix_t - 1e-9)
    for key in slow:
        slow[key][index] = getattr(one, key)
    x, y, z = one.axes.T
    return {"t": one.t, "acc_x": x, "acc_y": y, "acc_z": z, **slow}


def table(one: Phone) -> bytes:
    """Return one CSV table with three axes, whose unit is not named."""
    return pd.DataFrame(_wide(one)).to_csv(index=False, float_format="%.9g").encode()


def parquet(one: Phone) -> bytes:
    """Return a Parquet file with the time as its index."""
    frame = pd.DataFrame(_wide(one))
    frame.index = pd.to_datetime(1e9 * (EPOCH + frame.pop("t")), utc=True)
    frame.index.name = None
    buffer = io.BytesIO()
    frame.to_parquet(buffer)
    return buffer.getvalue()


def json_lines(one: Phone) -> bytes:
    """Return JSON lines with nested axes; a line without a fix lacks it."""
    columns, lines = _wide(one), []
    for k, t in enumerate(one.t):
        row = {"timestamp": float(EPOCH + t)}
        row["acceleration"] = dict(zip("xyz", map(float, one.axes[k]), strict=True))
        if np.isfinite(columns["v"][k]):
            row |= {key: float(columns[key][k]) for key in ("v", "lat", "lon")}
        lines.append(json.dumps(row))
    return "\n".join(lines).encode()


def vbo(one: Phone) -> bytes:
    """Return a VBOX file with the three accelerations of an inertial unit [g]."""
    seconds = EPOCH % 86400.0 + one.t
    stamp = (seconds // 3600) * 1e4 + (seconds % 3600 // 60) * 100 + seconds % 60
    lat, lon, v = (np.interp(one.t, one.fix_t, x) for x in (one.lat, one.lon, one.v))
    heads = ["satellites", "time", "latitude", "longitude", "velocity kmh", "X_Accel", "Y_Accel"]
    lines = ["File created on 04/05/2026 at 09:30:00", "", "[header]", *heads, "Z_Accel", ""]
    lines += ["[channel units]", "g", "g", "g", "", "[comments]", "Log Rate (Hz) : 100.00", ""]
    lines += ["[column names]", "sats time lat long velocity X_Accel Y_Accel Z_Accel", "", "[data]"]
    lines += [
        f"009 {s:010.3f} {60 * la:+013.6f} {-60 * lo:+013.6f} {3.6 * w:07.3f} "
        f"{x / G:+.6E} {y / G:+.6E} {z / G:+.6E}"
        for s, la, lo, w, (x, y, z) in zip(stamp, lat, lon, v, one.axes, strict=True)
    ]
    return "\r\n".join(lines).encode()


def gpx(one: Phone) -> bytes:
    """Return the track as GPX 1.1."""
    points = [
        f'<trkpt lat="{lat:.7f}" lon="{lon:.7f}"><time>'
        f"{pd.Timestamp(EPOCH + t, unit='s', tz='UTC').isoformat()}</time></trkpt>"
        for t, lat, lon in zip(one.fix_t, one.lat, one.lon, strict=True)
    ]
    space = 'xmlns="http://www.topografix.com/GPX/1/1"'
    body = "".join(points)
    return f'<gpx version="1.1" {space}><trk><trkseg>{body}</trkseg></trk></gpx>'.encode()


SAMPLES: dict[str, Callable[[Phone], bytes]] = {
    "phyphox.zip": phyphox, "sensor_logger.zip": sensor_logger, "table.csv": table,
    "index.parquet": parquet, "lines.jsonl": json_lines, "drive.vbo": vbo, "drive.gpx": gpx,
}  # fmt: skip
"""Writers of all formats, by the names of their samples."""


def sample() -> Phone:
    """Return the drive of the samples: ten seconds at 50 Hz of a phone tilted by 35 degrees."""
    tilt = Rotation.from_euler("zxy", [20.0, 35.0, 10.0], degrees=True)
    return phone(tilt, fs=50.0, duration=10.0)


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, write in SAMPLES.items():
        (FOLDER / name).write_bytes(write(sample()))
