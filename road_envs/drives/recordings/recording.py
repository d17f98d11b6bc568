"""Content of a recording, whichever app or logger wrote it: three axes, a track, a clock.

All times are in seconds on one clock, whose zero is that of the recording; `epoch` [s] is the time
since 1970 at its zero where the file tells. Values that are not known are NaN.
"""

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from road_envs.core.config import ConfigError

LONGEST_PAUSE = 2.0
"""Time [s] without acceleration from which on a recording is another drive: a second of loss is a
gap, and at 10 m/s two seconds are more than the waves that an estimator joins."""

SHORTEST_DRIVE = 8.0  # shortest part [s] that is a drive; shorter ones are left out, with a note
STANDING_SPEED = 0.5  # speed [m/s] below which a vehicle stands
KEPT_STANDING = 2.0  # time [s] of standing that is kept at each end; beyond it the phone is handled
KEPT_UNKNOWN = 1.5  # time [s] kept before the first speed and behind the last, of one a second
MOST_REPEATED = 0.01  # largest share of samples with the time of the one before, to be left out


@dataclass(frozen=True)
class Series:
    """Values `x` (N, K) at the times `t` (N,) [s]."""

    t: np.ndarray
    x: np.ndarray

    def __getitem__(self, samples: slice | np.ndarray) -> "Series":
        return Series(self.t[samples], self.x[samples])

    @property
    def duration(self) -> float:
        """Time [s] from the first sample to the last; 0 without any."""
        return float(self.t[-1] - self.t[0]) if self.t.size else 0.0

    def between(self, begin: float, end: float) -> "Series":
        """The samples from `begin` to `end` [s]."""
        return self[(self.t >= begin) & (self.t <= end)]


def make_track(
    t: np.ndarray,
    lat: np.ndarray | None = None,
    lon: np.ndarray | None = None,
    v: np.ndarray | None = None,
    s: np.ndarray | None = None,
) -> Series:
    """Return the track (N, 4) of columns (N,), NaN for those that are not known."""
    nothing = np.full(t.size, np.nan)
    return Series(t, np.column_stack([nothing if x is None else x for x in (lat, lon, v, s)]))


class Track(NamedTuple):
    """A track (M, 4) of its own file, with `epoch` and `notes` as of a Recording."""

    series: Series
    epoch: float | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Accelerations (N, 3) [m/s²] along the axes of a device, with gravity unless it `lacks` it.

    The `track` (M, 4) holds latitude and longitude [°], speed [m/s] and odometer [m]. `unit_named`:
    the unit of the accelerations is told; `is_table`: columns and units were found by their names;
    `breaks` [s]: times of pauses in which the clock went on.
    """

    name: str
    acceleration: Series
    track: Series | None = None
    lacks_gravity: bool = False
    unit_named: bool = True
    is_table: bool = False
    epoch: float | None = None
    breaks: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()

    def with_track(self, track: Track, source: str) -> "Recording":
        """The recording with the `track` of another file, the `source`.

        Times since 1970 are compared where both files have them, otherwise both clocks are taken to
        begin together. Raises ConfigError if the two do not overlap.
        """
        shift, common = 0.0, "both clocks are taken to begin together"
        if track.epoch is not None and self.epoch is not None:
            shift, common = track.epoch - self.epoch, "joined by the time since 1970"
        t = track.series.t + shift
        begin, end = self.acceleration.t[0], self.acceleration.t[-1]
        overlap = min(end, t[-1]) - max(begin, t[0])
        if overlap < SHORTEST_DRIVE:
            raise ConfigError(
                f"the track {source} and the accelerations overlap by {max(overlap, 0.0):.3g} s: "
                f"the track lasts from {t[0]:.6g} to {t[-1]:.6g} s on the clock of the "
                f"accelerations, which last from {begin:.6g} to {end:.6g} s"
            )
        said = f"speed and positions are those of {source}, {common}"
        notes = (*self.notes, *track.notes, said)
        return replace(self, track=Series(t, track.series.x), notes=notes)


def drives_of(recording: Recording) -> list[Recording]:
    """Return the drives of a recording: the parts between pauses, without standing at their ends.

    Each is named after the recording, with its number if there are several. Raises ConfigError if
    none lasts SHORTEST_DRIVE.
    """
    recording = replace(recording, acceleration=_increasing(recording.acceleration))
    t = recording.acceleration.t
    steps = np.flatnonzero(np.diff(t) > LONGEST_PAUSE) + 1
    edges = np.unique(np.r_[0, steps, np.searchsorted(t, recording.breaks), t.size])
    found = [
        _without_standing(_cut(recording, slice(int(first), int(last))))
        for first, last in itertools.pairwise(edges)
    ]
    parts = [part for part in found if part.acceleration.duration >= SHORTEST_DRIVE]
    short = len(found) - len(parts)
    if not parts:
        raise ConfigError(
            f"no part of the recording lasts {SHORTEST_DRIVE:g} s in motion: it has {t.size} "
            f"samples in {edges.size - 1} parts"
        )
    notes = [f"parts shorter than {SHORTEST_DRIVE:g} s are left out: {short}"] if short else []
    if len(parts) == 1:
        return [replace(parts[0], notes=(*parts[0].notes, *notes))]
    told = f"the recording is split at its pauses into {len(parts)} drives"
    return [
        replace(part, name=f"{part.name}_{k}", notes=(told, *part.notes, *notes))
        for k, part in enumerate(parts, 1)
    ]


def _increasing(series: Series) -> Series:
    """Return a series without the few samples that repeat the time before. Raises ConfigError."""
    series = series[np.isfinite(series.t)]
    if not series.t.size:
        raise ConfigError("the recording has no acceleration with a time")
    steps = np.diff(series.t)
    if (steps < 0.0).any():
        k = int(np.argmin(steps))
        raise ConfigError(
            f"the clock of the accelerations jumps back by {-steps[k]:.3g} s after sample {k + 1}: "
            "cut the file there"
        )
    new = np.r_[True, steps > 0.0]
    if (repeated := 1.0 - float(new.mean())) > MOST_REPEATED:
        raise ConfigError(
            f"{repeated:.0%} of the accelerations have the time of the one before: the clock is "
            "rounded; write it with more decimals"
        )
    return series[new]


def _cut(recording: Recording, part: slice) -> Recording:
    a, track = recording.acceleration[part], recording.track
    if track is not None and a.t.size:
        track = track.between(a.t[0] - LONGEST_PAUSE, a.t[-1] + LONGEST_PAUSE)
    return replace(recording, acceleration=a, track=track if track and track.t.size else None)


def _without_standing(recording: Recording) -> Recording:
    """Return a recording from shortly before the motion, or the first speed, to behind it."""
    if recording.track is None:
        return recording
    known = np.isfinite(recording.track.x[:, 2])
    t, v = recording.track.t[known], recording.track.x[known, 2]
    moving = t[v > STANDING_SPEED]
    if not moving.size:
        return recording
    a = recording.acceleration
    known_at_begin, known_at_end = moving[0] > t[0], moving[-1] < t[-1]
    begin = moving[0] - (KEPT_STANDING if known_at_begin else KEPT_UNKNOWN)
    end = moving[-1] + (KEPT_STANDING if known_at_end else KEPT_UNKNOWN)
    part, notes = a.between(begin, end), recording.notes
    left = a.duration - part.duration if part.t.size else 0.0
    if not known_at_begin and (late := begin - a.t[0]) > 0.0:
        notes = (
            *notes,
            f"no speed is known in the first {late:.1f} s: they are left out, and distances begin "
            "behind them (--offset is the chainage there)",
        )
    elif left > 1.0:
        notes = (*notes, f"{left:.0f} s of standing before and behind the drive are left out")
    track = recording.track.between(begin - LONGEST_PAUSE, end + LONGEST_PAUSE)
    return replace(recording, acceleration=part, track=track, notes=notes)
