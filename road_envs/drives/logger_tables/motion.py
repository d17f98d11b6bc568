"""Speed, distance and position of a drive from what a table holds, at the times of the record."""

import numpy as np
import scipy

from road_envs.drives.logger_tables.channels import Channels, TableFindings

EARTH_RADIUS = 6_371_008.8  # mean radius of the earth [m]
LONGEST_GAP = 10.0  # longest time [s] over which a speed or position is interpolated

HELD_ROWS = 5  # rows per change of value from which on a column is one of a slower sensor
SPEED_MAX, SPEED_QUESTIONED = 70.0, 42.0  # [m/s], of no drive (250 km/h), and questioned
STANDING = -0.3  # least speed [m/s] that is noise of a standing vehicle
TRACK_SMOOTHING = 5.0  # time [s] over which positions are averaged: noise lengthens their track

POSITION_ERROR, SPEED_ERROR = 1.0, 0.01
"""Assumed standard deviations of the length [m] of a track of satellite positions, whose error
changes slowly, and of a speed, relative to it."""

MAX_SPEED_ERROR = 0.05  # largest relative error of a speed that is taken as its calibration
DISAGREEMENT = 0.25  # relative difference of two distances of a drive of which one is wrong
_Motion = tuple[np.ndarray, np.ndarray, np.ndarray | None]


def read_motion(channels: Channels, t_rows: np.ndarray, t: np.ndarray) -> _Motion | None:
    """Return the motion at the times `t` (N,) of a table with rows at `t_rows` [s].

    It is speed [m/s] and odometer [m] (N,), and latitude and longitude [°] (2, N) or None. The
    distance is the odometer's, the integral of the speed, or the length of the track, in this
    order. Returns None if it is unknown, which is added to the problems.
    """
    findings = channels.findings
    before = len(findings.problems)
    whole = channels.description.speed_kmh
    v, s, lat, lon = (_at(channels, name, t_rows, t) for name in ("v", "s", "lat", "lon"))
    position = None if lat is None or lon is None else np.stack([lat, lon])
    if v is not None and STANDING < v.min() < 0.0:
        findings.notes.append(f"speeds down to {v.min():.2g} m/s are taken as standstill")
        v = np.maximum(v, 0.0)
    if position is not None and (np.abs(position).max(axis=1) > (90.0, 180.0)).any():
        findings.problems.append(
            "the positions are no latitudes within ±90° and longitudes within ±180°"
        )
        return None
    if whole is not None and "v" in channels:
        findings.problems.append(
            f"the speed is given twice, by the column {channels.headers['v']} and for the whole "
            "drive: leave out one of them"
        )
    if len(findings.problems) > before:
        return None
    if whole is not None:
        v = np.full(t.size, whole / 3.6)
    track = None if position is None else _track_length(position)
    if v is None and s is None and track is None:
        findings.problems.append(
            "the speed is missing: give one of the columns v [m/s], v_kmh, s [m], or lat and lon, "
            "a track beside it (--track FILE.gpx), or one speed for the whole drive (--speed-kmh); "
            f"{channels.list_columns()}"
        )
        return None
    if s is None and v is None and position is not None:
        findings.notes.append("speed and distance are those of the positions")
        track = _track_length(np.array([_smoothed(x, t, 2.0) for x in position]))
    if s is None and v is not None and position is not None:
        v = _calibrated(t, v, position, findings)
    distance = track if s is None else s
    if s is None and v is not None:
        distance = scipy.integrate.cumulative_trapezoid(v, t, initial=0.0)
    assert distance is not None
    if v is None:
        v = np.maximum(np.gradient(_smoothed(distance, t, 1.0), t), 0.0)
    _check(t, v, distance, track, s is not None, findings)
    return (v, distance, position) if len(findings.problems) == before else None


def _track_length(position: np.ndarray) -> np.ndarray:
    """Return the distance [m] along latitudes and longitudes (2, N) [°] on a sphere."""
    lat, lon = np.radians(position)
    x = np.diff(np.unwrap(lon)) * np.cos(0.5 * (lat[1:] + lat[:-1]))
    return np.concatenate([[0.0], np.cumsum(EARTH_RADIUS * np.hypot(x, np.diff(lat)))])


def _calibrated(
    t: np.ndarray, v: np.ndarray, position: np.ndarray, findings: TableFindings
) -> np.ndarray:
    """Return the speed, scaled towards the length of the track as far as that is known better."""
    smooth = np.array([_smoothed(x, t, TRACK_SMOOTHING) for x in position])
    middle = (t >= t[0] + TRACK_SMOOTHING) & (t <= t[-1] - TRACK_SMOOTHING)
    if middle.sum() < 2:
        return v
    track = _track_length(smooth[:, middle])[-1]
    driven = scipy.integrate.cumulative_trapezoid(v[middle], t[middle])[-1]
    error = track / max(driven, 1e-9) - 1.0
    weight = 1.0 / (1.0 + (POSITION_ERROR / (SPEED_ERROR * max(track, 1e-9))) ** 2)
    scale = 1.0 + weight * error
    is_far = abs(track - driven) > 5.0 * POSITION_ERROR
    if is_far and MAX_SPEED_ERROR <= abs(error) < DISAGREEMENT:
        findings.notes.append(
            f"{driven:.0f} m by the speed are {track:.0f} m by the positions: distances are those "
            "of the speed; check its unit and scale"
        )
        return v
    if not abs(error) < MAX_SPEED_ERROR or not abs(scale - 1.0) > 1e-4:
        return v
    findings.notes.append(
        f"the speed is scaled by {scale:.4f}, towards the length of the track of the positions"
    )
    return scale * v


def _at(channels: Channels, name: str, t_rows: np.ndarray, t: np.ndarray) -> np.ndarray | None:
    """Return a slow channel interpolated to the times `t`; None if there is none to be read."""
    if (x := channels.numbers(name)) is None:
        return None
    header, findings = channels.headers[name], channels.findings
    if name in ("lat", "lon") and "lat" in channels and "lon" in channels:
        # 0° N 0° E, as a receiver writes before it has a fix
        lat, lon = (channels.numbers(each) for each in ("lat", "lon"))
        missing = np.logical_and(lat == 0.0, lon == 0.0)
        x = np.where(missing, np.nan, x)
        if missing.any() and name == "lat":
            findings.notes.append(f"{missing.sum()} positions at 0° N 0° E are taken as missing")
        if not np.isfinite(x).any():
            return None
    good = np.flatnonzero(np.isfinite(x))
    good = good[_updates(x[good])]
    far = np.diff(np.r_[t[0], t_rows[good], t[-1]])
    if (longest := float(far.max())) > LONGEST_GAP:
        row = 1 if far.argmax() == 0 else int(good[far.argmax() - 1]) + 1
        findings.problems.append(
            f"{header} has no value for {longest:.3g} s after row {row}; at most "
            f"{LONGEST_GAP:g} s are interpolated"
        )
        return None
    if good.size < 0.5 * x.size:
        interval = float(np.median(np.diff(t_rows[good])))
        findings.notes.append(f"{header}: values every {interval:.3g} s are interpolated")
    known, x = t_rows[good], x[good]
    if name != "v" and known.size > 1:
        known, x = continued(known, x, t[0], t[-1])
    return np.interp(t, known, x)


def continued(
    t: np.ndarray, x: np.ndarray, begin: float, end: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return values `x` (N,) at times `t`, extended linearly to `begin` and `end` [s]."""
    if t[0] > begin:
        first = x[0] + (x[1] - x[0]) / (t[1] - t[0]) * (begin - t[0])
        t, x = np.r_[begin, t], np.r_[first, x]
    if t[-1] < end:
        last = x[-1] + (x[-1] - x[-2]) / (t[-1] - t[-2]) * (end - t[-1])
        t, x = np.r_[t, end], np.r_[x, last]
    return t, x


def _updates(x: np.ndarray) -> np.ndarray:
    """Return at which of `x` (N,) a sensor had a new value, if it was slower than the rows.

    Within a value that lasts longer than the usual interval, a new one is taken at each interval.
    """
    starts = np.flatnonzero(np.r_[True, np.diff(x) != 0.0])
    if starts.size < 4 or starts.size * HELD_ROWS > x.size:
        return np.arange(x.size)
    lengths = np.diff(np.r_[starts, x.size])
    usual = max(1, int(np.median(lengths)))
    parts = [
        start + np.arange(0, max(n - usual // 2, 1), usual)
        for start, n in zip(starts, lengths, strict=True)
    ]
    return np.concatenate(parts)


def _smoothed(s: np.ndarray, t: np.ndarray, duration: float) -> np.ndarray:
    """Return the moving average of `s` (N,) over a `duration` [s], continued by odd reflection."""
    half = max(1, min(round(0.5 * duration * t.size / (t[-1] - t[0])), (t.size - 1) // 2))
    padded = np.r_[2 * s[0] - s[half:0:-1], s, 2 * s[-1] - s[-2 : -half - 2 : -1]]
    return scipy.signal.oaconvolve(padded, np.full(2 * half + 1, 1.0 / (2 * half + 1)), "valid")


def _check(
    t: np.ndarray,
    v: np.ndarray,
    s: np.ndarray,
    track: np.ndarray | None,
    has_odometer: bool,
    findings: TableFindings,
) -> None:
    """Add problems of a motion that no drive has."""
    problems, top = findings.problems, float(v.max())
    if (v < 0.0).any() or (np.diff(s) < 0.0).any():
        problems.append("the vehicle moves backwards: v must not be negative, nor s decrease")
        return
    if top == 0.0:
        problems.append("the speed is 0 in all rows: the vehicle stands, or the column is another")
    elif top > SPEED_MAX:
        problems.append(
            f"the speed reaches {top:.4g} m/s ({3.6 * top:.4g} km/h): is it in km/h "
            "(--units v=km/h)?"
        )
    elif top > SPEED_QUESTIONED:
        findings.notes.append(f"the speed reaches {3.6 * top:.0f} km/h: check its unit")
    travelled = {"speed": scipy.integrate.cumulative_trapezoid(v, t, initial=0.0)[-1]}
    if has_odometer:
        travelled["odometer"] = s[-1] - s[0]
    if track is not None:
        travelled["positions"] = track[-1]
    low = min(travelled, key=lambda k: travelled[k])
    high = max(travelled, key=lambda k: travelled[k])
    if travelled[high] > 20.0 and travelled[high] * (1.0 - DISAGREEMENT) > travelled[low]:
        lengths = f"{travelled[low]:.4g} m by the {low} and {travelled[high]:.4g} m by the {high}"
        problems.append(f"the drive is {lengths}: check their units (--units v=..., s=...)")
