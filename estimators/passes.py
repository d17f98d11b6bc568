"""One road from several passes over it, each with its own vehicle, speed and strut states.

Each pass is estimated singly. The single estimates are aligned with that of the first pass by
cross-correlation in the band that both resolve, which maps the stations of each odometer to those
of the first (`estimators.common.alignment`). Then the road is estimated from all passes together
by an estimator that can (`JointEstimator`). For any other it is the mean of the single estimates,
weighted by inverse variance at each station where they have standard deviations.

Call it with records and vehicles, and with names for the messages:

    road = estimate_passes("map_smoother", [first, second, third], "land_rover_defender_110")

All vehicles are supposed to have driven in the same wheel paths: lateral wander is neglected.
"""

import dataclasses
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple, Protocol, Self, runtime_checkable

import numpy as np

from estimators.api import Cars, Estimator, Records, check_estimate
from estimators.common.alignment import MIN_OVERLAP, StationMap, identity_map, map_stations
from estimators.common.explained import mark_impossible
from estimators.common.odometer import calibrate_odometer
from estimators.lookup import resolve_estimator, training_notes
from road_envs.core.config import ConfigError
from road_envs.records.record import PROFILE_SPACING, Estimate, Record, scored_band
from road_envs.records.roughness import band_pass
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

_Vehicle = str | Path | VehicleParameters
WANDER_NOTE = "lateral wander between the passes is neglected"
# Largest displacement [m] of an odometer for which passes count as begun at the same place
_LEVEL_START = 2.0


@runtime_checkable
class JointEstimator(Estimator, Protocol):
    """An estimator that estimates one road from several passes together."""

    def for_one_of_many(self) -> Self:
        """Return the estimator of each single pass, whose estimates are aligned."""

    def estimate_jointly(
        self, records: Records, cars: Cars, start: Estimate, names: Sequence[str]
    ) -> Estimate:
        """Return both wheel paths on the stations of `start`, the mean of the single estimates.
        The `records` have stations of one odometer; the `length` of each is the station at which
        its own road ends. A pass may begin elsewhere. `names` of the passes are for notes.
        """


class AlignedPass(NamedTuple):
    """A pass by its `name`: its `record` with the stations of the first pass, the `estimate` of it
    alone with its own stations, and the map of these to those of the first.
    """

    name: str
    record: Record
    estimate: Estimate
    stations: StationMap


def estimate_passes(
    estimator: str | Path | Estimator,
    records: Sequence[Record],
    vehicles: _Vehicle | Sequence[_Vehicle] = "land_rover_defender_110",
    *,
    names: Sequence[str] | None = None,
    **settings: object,
) -> Estimate:
    """Return one road, on the stations of the first record, from several passes over it; what was
    found in the alignment is in its notes. `vehicles` is one for all or for each record; `names` of
    the records are for messages. Raises what `estimators.estimate` does, and ConfigError if a pass
    is given twice, matches the first nowhere or was driven in the opposite direction.
    """
    estimator = resolve_estimator(estimator, settings)
    cars = _load_vehicles(vehicles, len(records))
    names = list(names or (f"pass {k + 1}" for k in range(len(records))))
    if len(names) != len(records):
        raise ConfigError(f"{len(records)} records need as many names, got {len(names)}")
    refuse_repetitions(records, names)
    calibrated = [calibrate_odometer(record) for record in records]
    records = [odometer.record for odometer in calibrated]
    joint = isinstance(estimator, JointEstimator) and len(records) > 1
    one = estimator.for_one_of_many() if joint else estimator  # type: ignore[attr-defined]
    singles = [one.estimate(record, car) for record, car in zip(records, cars, strict=True)]
    for record, single in zip(records, singles, strict=True):
        check_estimate(single, record)
    aligned, notes = align_passes(records, singles, names)
    found = join_passes(estimator, aligned, cars)
    notes += [f"{n}: {note}" for n, x in zip(names, calibrated, strict=True) for note in x.notes]
    if len(records) > 1:
        notes += [WANDER_NOTE]
    pairs = zip(records, cars, strict=True)
    trained = dict.fromkeys(x for pair in pairs for x in training_notes(estimator, *pair))
    return dataclasses.replace(
        found,
        notes=(*found.notes, *notes, *trained),
        speed=min(float(np.nanmedian(record.v)) for record in records),
        s_std=calibrated[0].s_std,  # all passes are moved to the stations of the first
    )


def refuse_repetitions(records: Sequence[Record], names: Sequence[str]) -> None:
    """Raise ConfigError if two records have the same accelerations, which are no two passes."""
    for (one, a), (other, b) in combinations(zip(names, records, strict=True), 2):
        if np.array_equal(a.a, b.a, equal_nan=True):
            raise ConfigError(f"{one} and {other} are the same drive: give each pass once")


def join_passes(estimator: Estimator, aligned: Sequence[AlignedPass], cars: Cars) -> Estimate:
    """Return one road from aligned passes with the vehicles `cars`, one for each."""
    found = _combine(aligned)
    names, records = [each.name for each in aligned], [each.record for each in aligned]
    if isinstance(estimator, JointEstimator) and len(aligned) > 1:
        found = estimator.estimate_jointly(records, cars, found, names)
        check_estimate(found, records[0])
    return mark_impossible(found, records[0], cars[0], estimator)


def _load_vehicles(vehicles: _Vehicle | Sequence[_Vehicle], count: int) -> list[VehicleParameters]:
    if count < 1:
        raise ConfigError("an estimate needs at least one record")
    if isinstance(vehicles, str | Path | VehicleParameters):
        vehicles = [vehicles] * count
    if len(vehicles) != count:
        raise ConfigError(f"{count} records need one vehicle or {count}, got {len(vehicles)}")
    return [x if isinstance(x, VehicleParameters) else load_vehicle(x) for x in vehicles]


def align_passes(
    records: Sequence[Record], estimates: Sequence[Estimate], names: Sequence[str]
) -> tuple[list[AlignedPass], list[str]]:
    """Return the passes on the stations of the first, and notes on what was found. Raises
    ConfigError if a pass does not match.
    """
    reference, first = records[0], estimates[0]
    aligned = [AlignedPass(names[0], reference, first, identity_map(reference.length))]
    notes = []
    for record, estimate, name in zip(records[1:], estimates[1:], names[1:], strict=True):
        fastest = max(float(np.nanmedian(r.v)) for r in (reference, record))
        stations = _match(first, estimate, scored_band(fastest), name, names[0])
        moved = dataclasses.replace(
            record,
            s=stations.apply(record.s),
            v=record.v * stations.scale(record.s),
            length=float(stations.apply(np.array([record.length]))[0]),
        )
        aligned.append(AlignedPass(name, moved, estimate, stations))
        note = (
            f"{name}: stations moved by {stations.lag:+.2f} m and stretched by "
            f"{100.0 * stations.stretch:+.2f} % onto {names[0]} (correlation of slopes "
            f"{stations.correlation:.2f})"
        )
        begin, end = stations.apply(np.array([0.0, record.length])).clip(0.0, reference.length)
        if end - begin < reference.length - _LEVEL_START:
            note += f"; it covers {begin:.1f} to {end:.1f} m"
        notes.append(note)
    return aligned, notes


def _match(
    first: Estimate, other: Estimate, band: tuple[float, float], name: str, reference: str
) -> StationMap:
    """Return the map of stations of a pass to those of the first. Raises ConfigError."""
    try:
        stations, matches = map_stations(first.z, other.z, first.ds, band)
        if matches:
            return stations
        _, backwards = map_stations(first.z, other.z[::-1, ::-1], first.ds, band)
        _, exchanged = map_stations(first.z, other.z[::-1], first.ds, band)
    except ValueError as error:
        raise ConfigError(f"{name}: {error}") from None
    if backwards or exchanged:
        what = "in the opposite direction" if backwards else "with left and right exchanged"
        raise ConfigError(f"{name} was recorded {what} to {reference}: leave it out")
    raise ConfigError(
        f"{name} matches {reference} nowhere: the best correlation of their slopes is "
        f"{stations.correlation:.2f}, at {stations.lag:+.1f} m; check that both are of one road, "
        "and the vehicle, speed and strut states of each"
    )


def _combine(passes: Sequence[AlignedPass]) -> Estimate:
    """Return the mean of the single estimates on the stations of the first, one road.

    Weights are inverse variances where every estimate has standard deviations, else equal. Means
    are taken of the increments, so that no step arises where a pass begins or a weight changes. The
    standard deviation is that of independent errors, times the Birge ratio where the passes
    disagree by more than that (Birge, Phys. Rev. 40, 1932, 207).
    """
    if len(passes) == 1:
        return passes[0].estimate
    s = passes[0].estimate.s
    rows = [_on_stations(each, s) for each in passes]
    heights, variance, inside = (np.array(x) for x in zip(*rows, strict=True))
    weight = inside[:, None] / variance
    weight /= weight.sum(axis=0)
    steps = np.diff(heights, axis=2, prepend=heights[:, :, :1])
    z = np.cumsum((weight * steps).sum(axis=0), axis=1)
    std = None
    if all(each.estimate.z_std is not None for each in passes):
        everywhere = np.all(inside, axis=0)
        speed = max(float(np.nanmedian(each.record.v)) for each in passes)
        ratio = _birge_ratio(heights - z, variance, everywhere, scored_band(speed))
        std = ratio * np.sqrt((weight**2 * variance).sum(axis=0))
    owners: dict[str, list[str]] = {}  # names of the passes with each note
    for each in passes:
        for note in each.estimate.notes:
            owners.setdefault(note, []).append(each.name)
    notes = tuple(
        note if len(names) == len(passes) else f"{', '.join(names)}: {note}"
        for note, names in owners.items()
    )
    return Estimate(s, z, std, notes)


def _on_stations(each: AlignedPass, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return heights (2, M) [m] of a pass at the reference stations `s` (M,) [m], their variance
    (2, M) [m²], 1 if it has none, and which stations (M,) it covers.
    """
    own, estimate = each.stations.inverse().apply(s), each.estimate
    z = np.array([np.interp(own, estimate.s, path) for path in estimate.z])
    std = np.ones_like(estimate.z) if estimate.z_std is None else estimate.z_std
    variance = np.array([np.interp(own, estimate.s, path) ** 2 for path in std])
    return z, np.maximum(variance, 1e-12), (own >= 0.0) & (own <= estimate.s[-1])


def _birge_ratio(
    error: np.ndarray, variance: np.ndarray, everywhere: np.ndarray, band: tuple[float, float]
) -> float:
    """Return the square root of chi-squared per degree of freedom, at least 1. `error` (P, 2, M)
    [m] are the deviations of P passes from their mean, with the expected `variance` (P, 2, M) [m²]
    inside `band`; stations that all passes cover count.
    """
    error, variance = error[:, :, everywhere], variance[:, :, everywhere]
    if error.shape[2] * PROFILE_SPACING < MIN_OVERLAP:
        return 1.0
    inside = band_pass(error, PROFILE_SPACING, band)
    cut = (error.shape[2] - inside.shape[2]) // 2
    expected = variance[:, :, cut : cut + inside.shape[2]]
    chi_squared = np.sum(inside**2 / expected, axis=0) / (error.shape[0] - 1)
    return max(1.0, float(np.sqrt(chi_squared.mean())))
