"""Several passes over one road: their alignment, and the agreement of their estimates."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

import estimators.passes
from estimators.api import Estimator
from estimators.common.alignment import identity_map
from estimators.passes import AlignedPass
from leaderboard.drive_report.analysis import DriveResult
from leaderboard.drive_report.notes import ONE_ROAD
from leaderboard.metrics import agreement
from road_envs.core.config import ConfigError
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.records.record import Estimate
from road_envs.vehicle.parameters import VehicleParameters

_MIN_SEGMENTS = 3  # least number of common segments for an ICC


class ReportedPass(NamedTuple):
    """A pass: name, measured record and estimate, in the stations of the first if `aligned`."""

    name: str
    measured: MeasuredRecord
    estimate: Estimate
    aligned: AlignedPass | None = None

    def with_note(self, note: str) -> "ReportedPass":
        """The pass with a further note."""
        return self._replace(measured=self.measured._replace(notes=(*self.measured.notes, note)))


def align_passes(passes: Sequence[ReportedPass]) -> list[ReportedPass]:
    """Return the passes in the stations of the first; one that matches nowhere has a note of it."""
    name, measured, first, _ = passes[0]
    whole = identity_map(measured.record.length)
    found = [passes[0]._replace(aligned=AlignedPass(name, measured.record, first, whole))]
    for one in passes[1:]:
        records, singles = (measured.record, one.measured.record), (first, one.estimate)
        try:
            pair, notes = estimators.passes.align_passes(records, singles, (name, one.name))
        except ConfigError as error:
            found.append(one.with_note(f"not compared with the first drive: {error}"))
            continue
        moved = one.measured._replace(
            record=pair[1].record, chainage=measured.chainage, notes=(*one.measured.notes, *notes)
        )
        found.append(_cut(one._replace(measured=moved, aligned=pair[1]), first))
    return found


def _cut(one: ReportedPass, first: Estimate) -> ReportedPass:
    """Return an aligned pass with its estimate at those stations of the `first` that it covers;
    station 0 is the first of them.
    """
    assert one.aligned is not None
    s, estimate, record = first.s, one.estimate, one.measured.record
    own = one.aligned.stations.inverse().apply(s)
    inside = np.flatnonzero((own >= 0.0) & (own <= estimate.s[-1]))
    begin = float(s[inside[0]])
    moved: dict[str, Any] = {
        name: np.apply_along_axis(lambda x: np.interp(own[inside], estimate.s, x), -1, values)
        for name in ("z", "z_std", "draws", "unsure")
        if (values := getattr(estimate, name)) is not None
    }
    if estimate.unsure is not None:
        moved["unsure"] = moved["unsure"] > 0.0
    measured = one.measured._replace(
        record=replace(record, s=record.s - begin, length=float(s[inside[-1]]) - begin),
        chainage=one.measured.chainage + begin,
    )
    part = replace(estimate, s=s[inside] - begin, distance=first.distance, **moved)
    return one._replace(measured=measured, estimate=part)


def join(
    estimator: Estimator, passes: Sequence[ReportedPass], cars: Sequence[VehicleParameters]
) -> ReportedPass | None:
    """Return the road of all aligned passes, as a pass over the first's road; None if there is one.

    `cars` are the vehicles of all passes. Speed and states are those of the first.
    """
    chosen = [(each, car) for each, car in zip(passes, cars, strict=True) if each.aligned]
    aligned = [each.aligned for each, _ in chosen if each.aligned]
    if len(aligned) < 2:
        return None
    road = estimators.passes.join_passes(estimator, aligned, [car for _, car in chosen])
    first, names = passes[0].measured, ", ".join(each.name for each, _ in chosen)
    note = f"{ONE_ROAD} {names}; speed and states are those of {passes[0].name}"
    notes = (note, estimators.passes.WANDER_NOTE)
    road = replace(road, notes=(), distance=passes[0].estimate.distance)
    return ReportedPass("all_passes", first._replace(notes=notes), road)  # its name in files, too


def compare(results: Sequence[DriveResult]) -> dict[str, Any] | None:
    """Return the agreement of aligned passes by their common segments; None if there are none."""
    iri = [
        {(round(x["begin_m"], 2), round(x["end_m"], 2)): x["iri_mean"] for x in result.segments}
        for result in results
    ]
    common = [key for key in iri[0] if all(key in each for each in iri)]
    if len(results) < 2 or not common:
        return None
    x = np.array([[each[key] for each in iri] for key in common])
    segments, others = [], []
    for (begin, end), line in zip(common, x, strict=True):
        spread = {"mean": float(line.mean()), "std": float(line.std(ddof=1))}
        segments.append({"begin_m": begin, "end_m": end, "iri": line.tolist(), **spread})
    for result, own in zip(results[1:], x.T[1:], strict=True):
        one = {"name": result.name, "speed_kmh": result.facts["speed_kmh"]}
        one |= agreement.bland_altman(own, x[:, 0])._asdict()
        one["rmse"] = float(np.sqrt(np.mean((own - x[:, 0]) ** 2)))
        others.append(one | {"correlation": _profile_correlation(results[0], result)})
    return {
        "first": results[0].name,
        "names": [result.name for result in results],
        "segments": segments,
        "repeatability": agreement.repeatability(x),
        "relative": agreement.repeatability(x) / float(x.mean()),
        "icc": agreement.intraclass_correlation(x) if len(common) >= _MIN_SEGMENTS else np.nan,
        "passes": others,
    }


def _profile_correlation(first: DriveResult, other: DriveResult) -> float:
    """Return the IRI-filtered cross-correlation, R 56-style, over the common road."""
    ds = first.estimate.ds
    end = min(r.chainage + r.estimate.s[-1] for r in (first, other))
    s = np.arange(max(first.chainage, other.chainage), end, ds)
    if s.size * ds < 20.0:
        return np.nan
    paths = [
        [np.interp(s, r.chainage + r.estimate.s, z) for z in r.estimate.z] for r in (first, other)
    ]
    pairs = zip(*paths, strict=True)
    return float(np.mean([agreement.iri_filtered_correlation(y, a, ds) for y, a in pairs]))
