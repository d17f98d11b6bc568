"""Gravity from three axes: how a device is mounted, and the vertical acceleration of its vehicle.

A device at rest in its mount measures, along its own axes, the specific force

    f(t) = g u + a_ahead(t) p + a_left(t) q + vibration,        u, p, q unit vectors of the vehicle

Over seconds the vibration averages to zero, and the manoeuvres are known where the speed v and the
heading psi are: a_ahead = dv/dt, a_left = v dpsi/dt. Regression of the averages over BLOCK on
[1, a_ahead, a_left] therefore gives g u, which is the mount. Its residuals have a standard error,
which is that of the tilt; where the direction of the averages changes and stays changed, the device
has moved in its mount, and each part has a mount of its own. The vertical acceleration is f u - g.
Unlike the complementary filters of attitude (Mahony, Hamel & Pflimlin, IEEE Trans. Automatic
Control 53, 2008), which need a gyroscope, this has no phase and no drift.
"""

import itertools
from typing import NamedTuple

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.motion import EARTH_RADIUS, continued
from road_envs.drives.recordings.recording import Recording, Series
from road_envs.records.units import STANDARD_GRAVITY

BLOCK = 1.0  # time [s] over which the specific force is averaged: the body bounces at 1 to 2 Hz

NEAR = 8  # least number of blocks of a part with a mount of its own
COARSE = 300  # number of places at which a movement is looked for first

MOVED, MOVED_BLINDLY = np.radians(6.0), np.radians(15.0)
"""Least change of direction [rad] between parts that is a movement of the device: of a road, a hill
of 10 %. The second where speed and heading are not known, so that braking and turning change it."""

MOST_MOVES = 4  # most movements of a device that is still mounted; more are of a loose one
LEFT_OUT = 1.5  # time [s] on either side of a movement that is left out
EXCITED = 0.25  # least standard deviation [m/s²] of a manoeuvre's acceleration that is regressed on

IN_G = (0.93, 1.07)  # magnitude [g] of the mean that is gravity: phones are off by some hundredths
GRAVITY_RANGE = (0.93 * STANDARD_GRAVITY, 1.07 * STANDARD_GRAVITY)  # the same [m/s²]
CORRELATED = 4.0  # blocks for which a residual of the slow motion lasts


class _Mount(NamedTuple):
    """Unit vector `up` (3,) in axes of a device, its standard error [rad], and `gravity` [m/s²]."""

    up: np.ndarray
    gravity: float
    tilt_std: float


class _Levelled(NamedTuple):
    """Vertical accelerations (N,) [m/s²] at times `t` [s], NaN where the device moved."""

    t: np.ndarray
    vertical: np.ndarray
    mounts: tuple[_Mount, ...]
    notes: tuple[str, ...]


def level(recording: Recording) -> _Levelled:
    """Return the vertical accelerations of the vehicle in a recording.

    Raises ConfigError if gravity is missing, has no plausible magnitude, or moves all the time.
    """
    a, notes = _in_si(recording)
    if recording.lacks_gravity:
        raise ConfigError(
            f"the accelerations of {recording.name} are without gravity (linear), so that the "
            "mount of the device cannot be found: record the accelerations with gravity, too "
            "(phyphox: 'Acceleration with g'; Sensor Logger: 'Total Acceleration' or 'Gravity'), "
            "or say which column is vertical (--columns a_phone=NAME)"
        )
    t, f = _blocks(a)
    manoeuvres = _manoeuvres(recording.track, t)
    moves = _moves(t, f, manoeuvres)
    if len(moves) > MOST_MOVES:
        raise ConfigError(
            f"the device of {recording.name} turned in its mount {MOST_MOVES + 1} times or more: "
            "it is loose; fix it and drive again"
        )
    vertical, mounts = np.full(a.t.size, np.nan), []
    for begin, end in itertools.pairwise([-np.inf, *moves, np.inf]):
        inside, part = ((x > begin + LEFT_OUT) & (x < end - LEFT_OUT) for x in (t, a.t))
        if inside.sum() < 3:
            continue
        mount = _mount(f[inside], [x[inside] for x in manoeuvres])
        mounts.append(mount)
        vertical[part] = a.x[part] @ mount.up - mount.gravity
    return _Levelled(a.t, vertical, tuple(mounts), (*notes, *_mount_notes(mounts, moves)))


def _in_si(recording: Recording) -> tuple[Series, list[str]]:
    """Return the accelerations in m/s², by the magnitude of gravity where no unit is named."""
    a = recording.acceleration
    x = a.x[np.isfinite(a.x).all(axis=1)]
    if not x.size:
        raise ConfigError(f"{recording.name} has no sample of all three axes")
    size = float(np.linalg.norm(np.median(x, axis=0)))
    if GRAVITY_RANGE[0] <= size <= GRAVITY_RANGE[1] or recording.lacks_gravity:
        return a, []
    if not recording.unit_named and IN_G[0] <= size <= IN_G[1]:
        a = Series(a.t, STANDARD_GRAVITY * a.x)
        return a, [f"the accelerations are read as g: their mean has a magnitude of {size:.3f}"]
    if size < 0.5 * IN_G[0]:
        raise ConfigError(
            f"the mean of the three accelerations of {recording.name} has a magnitude of "
            f"{size:.2g}, which is not gravity (9.81 m/s² or 1 g): they are without gravity, so "
            "that the mount of the device cannot be found; record them with gravity"
        )
    raise ConfigError(
        f"the mean of the three accelerations of {recording.name} has a magnitude of {size:.4g}, "
        "where gravity is 9.81 m/s² or 1 g: check their unit, and that the device lay still in its "
        "mount"
    )


def _blocks(a: Series) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles (K,) [s] and the means (K, 3) of blocks of BLOCK with samples."""
    good = np.isfinite(a.x).all(axis=1)
    t, x = a.t[good], a.x[good]
    index = np.floor((t - t[0]) / BLOCK).astype(int)
    count = np.bincount(index)
    full = count >= 0.5 * np.median(count[count > 0])
    means = np.column_stack([np.bincount(index, axis) for axis in x.T])[full] / count[full, None]
    return t[0] + BLOCK * (np.flatnonzero(full) + 0.5), means


def _manoeuvres(track: Series | None, t: np.ndarray) -> list[np.ndarray]:
    """Return the accelerations (K,) ahead and to the left at the times `t` (K,), where known."""
    if track is None:
        return []
    found = []
    v, lat, lon = (_known(track, column, t) for column in (2, 0, 1))
    north, east = np.zeros((2, t.size))
    if lat is not None and lon is not None and t.size > 4:
        scale = np.radians(EARTH_RADIUS)
        north = scale * np.gradient(lat, t)
        east = scale * np.gradient(lon, t) * np.cos(np.radians(lat))
        v = np.hypot(north, east) if v is None else v
    if v is not None and t.size > 2:
        found.append(np.gradient(v, t))
    if v is not None and north.any():
        heading = np.unwrap(np.arctan2(north, east))  # counter-clockwise: positive to the left
        turn = v * np.gradient(heading, t)
        found.append(np.where(v > 3.0, np.clip(turn, -8.0, 8.0), 0.0))
    return [x for x in found if float(np.std(x)) > EXCITED]


def _known(track: Series, column: int, t: np.ndarray) -> np.ndarray | None:
    good = np.isfinite(track.x[:, column])
    if good.sum() < 3:
        return None
    return np.interp(t, *continued(track.t[good], track.x[good, column], t[0], t[-1]))


def _moves(t: np.ndarray, f: np.ndarray, manoeuvres: list[np.ndarray]) -> list[float]:
    """Return the times [s] at which the direction of gravity in the averages `f` (K, 3) changes.

    One break after the other is placed where the regression with a level for each part, and the
    manoeuvres in common, fits best; the last is one if the levels on both sides differ by MOVED.
    """
    common = np.column_stack([np.empty((t.size, 0)), *manoeuvres])
    least, stride = MOVED if manoeuvres else MOVED_BLINDLY, max(1, t.size // COARSE)
    breaks: list[int] = []

    def best_of(places: range) -> int | None:
        edges = np.array([0, *breaks, t.size])
        free = [k for k in places if np.abs(edges - k).min() >= NEAR]
        return min(free, default=None, key=lambda k: _fit(f, common, [*breaks, k])[1])

    while len(breaks) <= MOST_MOVES:
        if (near := best_of(range(0, t.size, stride))) is None:
            break
        best = best_of(range(max(0, near - stride), near + stride + 1)) or near
        levels = _fit(f, common, trial := sorted([*breaks, best]))[0]
        k = trial.index(best)
        sine = np.linalg.norm(np.cross(levels[k], levels[k + 1]))
        if np.arctan2(sine, levels[k] @ levels[k + 1]) < least:
            break
        breaks = trial
    return [float(t[k] - 0.5 * BLOCK) for k in breaks]


def _fit(f: np.ndarray, common: np.ndarray, breaks: list[int]) -> tuple[np.ndarray, float]:
    """Return the levels (P, 3) of the parts between `breaks`, and the sum of squared residuals."""
    part = np.searchsorted(np.sort(breaks), np.arange(f.shape[0]), side="right")
    X = np.column_stack([part[:, None] == np.arange(len(breaks) + 1), common]).astype(float)
    B = np.linalg.solve(X.T @ X + 1e-9 * np.eye(X.shape[1]), X.T @ f)
    return B[: len(breaks) + 1], float(np.sum((f - X @ B) ** 2))


def _mount(f: np.ndarray, manoeuvres: list[np.ndarray]) -> _Mount:
    """Return the mount by regression of the averages `f` (K, 3) on the manoeuvres (K,)."""
    used = [x for x in manoeuvres if float(np.std(x)) > EXCITED]
    X = np.column_stack([np.ones(f.shape[0]), *used])
    B = np.linalg.lstsq(X, f, rcond=None)[0]
    residual = f - X @ B
    gravity = float(np.linalg.norm(B[0]))
    up = B[0] / gravity
    across = residual - np.outer(residual @ up, up)
    spread = np.sqrt(np.sum(across**2) / max(f.shape[0] - X.shape[1], 1))
    variance = CORRELATED * np.linalg.pinv(X.T @ X)[0, 0]
    return _Mount(up, gravity, float(spread * np.sqrt(variance) / gravity))


def _mount_notes(mounts: list[_Mount], moves: list[float]) -> list[str]:
    if not mounts:
        raise ConfigError("the device moves all the time: fix it in its mount and drive again")
    notes = []
    if moves:
        turned = ", ".join(f"{at:.0f} s" for at in moves)
        notes.append(
            f"the device moved in its mount at {turned} on its clock: {2 * LEFT_OUT:g} s about "
            "each are left out, and each part is turned upright by itself; fix the device"
        )
    for mount in mounts:
        up, error = np.abs(mount.up), max(1.0, 1.96 * np.degrees(mount.tilt_std))
        notes.append(
            f"the device is mounted with its {'xyz'[int(up.argmax())]} axis "
            f"{np.degrees(np.arccos(min(up.max(), 1.0))):.0f} ± {error:.0f} degrees from the "
            f"vertical, by gravity ({mount.gravity:.2f} m/s²); its accelerations are turned upright"
        )
    return notes
