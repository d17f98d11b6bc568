"""Errors of estimators on a drive, shared by studies."""

from collections.abc import Sequence

from estimators.estimation import estimate
from leaderboard.scoring import score
from road_envs.records.record import Profile, Record
from road_envs.vehicle.parameters import VehicleParameters


def in_band_errors(
    names: Sequence[str],
    drive: tuple[Record, Profile],
    car: VehicleParameters,
    speed_kmh: float | None = None,
) -> list[float]:
    """Return the NRMSE [-] of estimators on a drive, in the band of `speed_kmh` if given."""
    record, truth = drive
    estimates = (estimate(name, record, car) for name in names)
    return [score(each, truth, speed_kmh=speed_kmh)["nrmse"] for each in estimates]
