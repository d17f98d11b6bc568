"""Results of one drive: segments with IRI, class, condition and quality, and obstacles."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from estimators.common.gaps import unread_stations
from estimators.wiener.segments import dominant_modes
from leaderboard.drive_report import mean_path
from leaderboard.drive_report.conditions import Conditions
from leaderboard.drive_report.mean_path import HRI_STD, tells_paths_apart, tells_vehicle
from leaderboard.drive_report.notes import (
    in_order_of_weight,
    is_far_off,
    misfit_std,
    misfits,
    vehicle_in_words,
)
from leaderboard.drive_report.obstacles import CERTAIN, HEIGHT_STD, DetectedObstacle, detect
from leaderboard.drive_report.posterior_iri import NO_INTERVAL_NOTE, IriPosterior, posterior_iri
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.records import roughness
from road_envs.records.record import Estimate, scored_band
from road_envs.vehicle.struts import MODES, Modes

SEGMENT_LENGTHS = (10.0, 20.0, 100.0)  # lengths [m] of segments
_PLACE_STD = 0.15  # [m] of an obstacle's place where distance is right (studies/report_trial.py)
_RUN_IN = 11.0  # length [m] of the golden car's run-in (Sayers 1995)
_SLOW = 20.0 / 3.6  # speed [m/s] below which waves longer than 11 m, of 0.5 Hz, are flagged
_OCTAVES = (0.125, 0.25, 0.5, 1.0)  # centres [cycles/m] of the octaves of a class
_WAVES_PER_SEGMENT = 2.0  # least number of waves of an octave in a segment
_HUGE_RESIDUAL_NOTE = (
    "the IRI has no interval where the model leaves so much unexplained: on trial it was then a "
    "third to more than twice the true one"
)


class KnownFactor(NamedTuple):
    """True IRI over that of a report for one car and mount, and its relative standard deviation."""

    factor: float
    std: float


@dataclass(frozen=True)
class DriveResult:
    """A drive: its `segments` and `obstacles` as rows, `estimate`, and facts and notes of it.

    `chainage` [m] is that of station 0 of the estimate; stations of rows are chainages. With
    `is_mean_path` the sensors told no left and right (`mean_path.py`).
    """

    name: str
    measured: MeasuredRecord
    estimate: Estimate
    v: float
    chainage: float
    segments: list[dict[str, Any]]
    obstacles: list[dict[str, Any]]
    notes: tuple[str, ...]
    facts: dict[str, Any]
    is_mean_path: bool = False

    def position(self, station: float) -> tuple[float | None, float | None]:
        """Return latitude and longitude [°] of the front axle at a station, None if unknown."""
        if self.measured.position is None:
            return None, None
        lat, lon = (np.interp(station, self.measured.record.s, x) for x in self.measured.position)
        return float(lat), float(lon)


def analyse(
    name: str,
    measured: MeasuredRecord,
    estimate: Estimate,
    conditions: Conditions,
    *,
    segment: float = 100.0,
    clipping: float | np.ndarray = np.inf,
    noise: float = np.nan,
    tolerance_std: float = 0.0,
    distance_std: float = 0.0,
    modes: Modes = MODES,
    known: KnownFactor | None = None,
) -> DriveResult:
    """Return the results of a drive by segments of `segment` [m], at whole multiples of it.

    `clipping` [m/s²], one or (k, 1), is the magnitude from which on a sample is clipped, `noise`
    [m/s²] the RMS of the sensors' noise; `tolerance_std` is the relative standard deviation of the
    IRI by the tolerances of a vehicle that the sensors do not tell (`roughness_std`), and
    `distance_std` that of distances from the first sample. `modes` name the states of the struts;
    `known` is the factor of this car and mount by a stretch of known IRI.
    """
    record, v = measured.record, float(np.median(measured.record.v))
    if is_mean_path := not tells_paths_apart(record.sensors):
        unread = unread_stations(estimate.s, record)
        estimate = mean_path.with_mean_path(estimate, unread)
    edges = _edges(estimate, measured.chainage, segment, record.s[0])
    unknown = 0.0 if tells_vehicle(record.sensors) else float(np.hypot(HRI_STD, tolerance_std))
    factor, std = known or KnownFactor(1.0, unknown)
    std = float(np.hypot(std, misfit_std(estimate, is_mean_path)))
    if is_mean_path:
        index = np.searchsorted(estimate.s, edges)
        roads = estimate.draws if unread.any() and estimate.draws is not None else estimate.z[None]
        half, iri = mean_path.mean_path_indices(roads[:, 0], estimate.ds, index, factor, std)
    else:
        half, iri = None, posterior_iri(estimate, edges, factor=factor, relative_std=std)
    missing = (NO_INTERVAL_NOTE,) if np.isnan(iri.high).any() else ()
    if not is_mean_path and is_far_off(estimate, record, noise):
        none = np.full_like(iri.median, np.nan)
        iri, missing = iri._replace(low=none, high=none), (_HUGE_RESIDUAL_NOTE,)
    notes = in_order_of_weight((*estimate.notes, *measured.notes, *missing))
    place = measured.chainage
    result = DriveResult(name, measured, estimate, v, place, [], [], notes, {}, is_mean_path)
    for k in range(edges.size - 1):
        row = _segment(result, edges, k, iri, clipping, modes)
        row["condition"] = conditions.category(row["iri_mean"])
        row["iri_in_per_mi"] = roughness.IN_PER_MI * row["iri_mean"]
        if half is not None:
            row |= {"hri": float(half.median[-1, k]), "hri_low": float(half.low[-1, k]),
                    "hri_high": float(half.high[-1, k])}  # fmt: skip
        result.segments.append(row)
    result.obstacles.extend(_obstacle(result, found, distance_std) for found in detect(estimate))
    result.facts.update(
        length_m=float(edges[-1] - edges[0]),
        speed_kmh=3.6 * v,
        sampled_hz=float(min(measured.fs, record.fs)),
        duration_s=float(record.t[-1]),
        vehicle=vehicle_in_words(notes),
        iri_mean=float(np.average(iri.median[-1], weights=np.diff(edges))),
        # errors of segments have common causes: the interval of the mean is the mean interval
        iri_mean_low=float(np.average(iri.low[-1], weights=np.diff(edges))),
        iri_mean_high=float(np.average(iri.high[-1], weights=np.diff(edges))),
    )
    return result


def _edges(estimate: Estimate, chainage: float, segment: float, first: float) -> np.ndarray:
    """Return the stations (K + 1,) of segments at multiples of `segment` in the user's chainage.

    What remains at either end is a segment of its own if it is half as long, else it is joined.
    """
    begin, end = max(0.0, first - 5.0), float(estimate.s[-1])
    low, high = np.ceil((begin + chainage) / segment), np.floor((end + chainage) / segment)
    inner = segment * np.arange(low, high + 1) - chainage
    inner = inner[(inner > begin + 0.5 * segment) & (inner < end - 0.5 * segment)]
    return np.concatenate([[begin], inner, [end]])


def _segment(
    result: DriveResult,
    edges: np.ndarray,
    k: int,
    iri: IriPosterior,
    clipping: float | np.ndarray,
    modes: Modes,
) -> dict[str, Any]:
    begin, end = float(edges[k]), float(edges[k + 1])
    record = result.measured.record
    inside = np.flatnonzero((record.s >= begin) & (record.s < end))
    inside = inside if inside.size else np.array([int(np.searchsorted(record.s, begin))])
    speed = float(np.mean(record.v[inside]))
    levels = _levels(result.estimate, begin, end, result.v)
    if result.is_mean_path:
        levels = {n: mean_path.path_level_ratio(n) * level for n, level in levels.items()}
    row: dict[str, Any] = {"begin_m": result.chainage + begin, "end_m": result.chainage + end}
    for j, path in enumerate(("mean",) if result.is_mean_path else ("left", "right", "mean")):
        for limit, x in (("", iri.median), ("_low", iri.low), ("_high", iri.high)):
            row[f"iri_{path}{limit}"] = float(x[j, k])
    whole = np.exp(np.mean(np.log(list(levels.values())))) if levels else np.nan
    row["class"] = roughness.roughness_class(float(whole)) if levels else ""
    for n in _OCTAVES:
        row[f"class_{n:g}"] = roughness.roughness_class(levels[n]) if n in levels else ""
    row["speed_kmh"] = 3.6 * speed
    by_wheel = dominant_modes(record, inside, modes)
    row["state"] = "/".join(dict.fromkeys(by_wheel[wheel] for wheel in ("FL", "RL")))
    row["flags"] = "; ".join(_flags(result, inside, speed, begin, clipping))
    row["lat"], row["lon"] = result.position(0.5 * (begin + end))
    return row


def _levels(estimate: Estimate, begin: float, end: float, v: float) -> dict[float, float]:
    """Return the level G_d(n0) [m³] of each octave that segment and speed resolve."""
    i, j = np.searchsorted(estimate.s, [begin, end])
    roads = estimate.z[None] if estimate.draws is None else estimate.draws
    parts = [roughness.displacement_psd(z[:, i:j], estimate.ds) for z in roads]
    n, G = parts[0][0], np.mean([G for _, G in parts], axis=0)
    low = max(_WAVES_PER_SEGMENT * np.sqrt(2.0) / (end - begin), _OCTAVES[0])
    high = min(scored_band(v)[1] / np.sqrt(2.0), _OCTAVES[-1])
    if not high >= low:
        return {}
    centres, levels = roughness.octave_levels(n, G.mean(axis=0), (low, high))
    return {float(c): max(float(x), 1e-12) for c, x in zip(centres, levels, strict=True)}


def _flags(
    result: DriveResult,
    inside: np.ndarray,
    speed: float,
    begin: float,
    clipping: float | np.ndarray,
) -> list[str]:
    record, flags = result.measured.record, []
    if speed < _SLOW:
        flags.append(f"slow: waves longer than {speed / 0.5:.0f} m are uncertain")
    shortest = max(speed / (0.4 * min(result.measured.fs, 1e9)), 1.0 / scored_band(speed)[1])
    if shortest > 1.0:
        flags.append(f"waves shorter than {shortest:.1f} m are not resolved")
    lost = float(np.isnan(record.a[:, inside]).any(axis=0).mean())
    if lost > 0.01:
        flags.append(f"{lost:.0%} of the samples lost")
    if (np.abs(np.nan_to_num(record.a[:, inside])) >= 0.98 * clipping).any():
        flags.append("clipped")
    if begin < record.s[0] + _RUN_IN:
        flags.append("start of the drive")
    return flags


def _obstacle(result: DriveResult, found: DetectedObstacle, distance_std: float) -> dict[str, Any]:
    is_certain = found.confidence >= CERTAIN and not misfits(result.estimate, result.is_mean_path)
    lat, lon = result.position(found.station)
    distance = distance_std * (found.station - result.measured.record.s[0])
    height_std = float(np.hypot(found.height_std, HEIGHT_STD * found.height))
    low, high = (found.height + 1.96 * way * height_std for way in (-1.0, 1.0))
    return {
        "kind": ("" if is_certain else "possible ") + ("bump" if found.height > 0.0 else "hole"),
        "station_m": result.chainage + found.station,
        "station_std_m": float(np.hypot(_PLACE_STD, distance)),
        "height_mm": 1e3 * found.height,
        "height_low_mm": 1e3 * low,
        "height_high_mm": 1e3 * high,
        "length_m": found.length,
        "wheel_path": "not told" if result.is_mean_path else found.side,
        "confidence": found.confidence,
        "lat": lat,
        "lon": lon,
    }
