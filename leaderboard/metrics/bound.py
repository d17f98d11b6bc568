"""The bound beside every score: what the task's instruments can know of the road that was driven.

For a drive the bound is that of a Gaussian road with the spectrum of the realised one: the line
through its density inside the scored band, rounded to 1 dB and 0.1 in waviness, on the car and with
the instruments that the maker knows (`road_envs.analysis.information_bound`). A road that is not Gaussian, such
as one of obstacles, and an estimator that is not linear may do better than it.
"""

import json
from functools import lru_cache

import numpy as np

from leaderboard.evaluation.tasks import Condition, Task
from leaderboard.metrics.roughness import THIRDS
from road_envs.analysis.information_bound import RoadPrior, bound
from road_envs.analysis.roughness import CLASSES, dsd, fit_line, smooth
from road_envs.data.record import Profile, scored_band
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle

LINES = 1001
"""Frequencies over the scored band: the bound to three digits."""

WAVINESS = (1.0, 4.0)
"""The line through a density is kept between these."""


def nrmse_bound(task: Task, condition: Condition, truth: Profile) -> float:
    """Least in-band NRMSE [-] on a road like `truth`; NaN on a level one."""
    v = condition.speed_kmh / 3.6
    road = spectrum(truth, scored_band(v))
    if road is None:
        return np.nan
    return pooled(task.car, task.instruments, condition.command, v, *road)


def bound_over_n(task: Task, condition: Condition, G_d0: float = CLASSES["D"]) -> list[float]:
    """Least NRMSE [-] in each of `spectral.THIRDS` on an ISO road (w = 2) of the level `G_d0`."""
    v, edge = condition.speed_kmh / 3.6, 2.0 ** (1 / 6)
    car, instruments = load_vehicle(task.car), load_instruments(task.instruments)
    n = np.geomspace(THIRDS[0] / edge, THIRDS[-1] * edge, 15 * 60)
    found = bound(car, condition.command, v, instruments, RoadPrior(G_d0=G_d0), n=n)
    shares = []
    for centre in THIRDS:
        inside = (n >= centre / edge) & (n < centre * edge)
        wrong = np.trapezoid(found.paths[inside].sum(axis=1), n[inside])
        prior = np.trapezoid(np.real(np.trace(found.prior[inside], axis1=1, axis2=2)), n[inside])
        shares.append(float(np.sqrt(wrong / prior)))
    return shares


def spectrum(truth: Profile, band: tuple[float, float]) -> tuple[float, float] | None:
    """Level [dB over 1 m³ at n0] and waviness of a road inside `band`, rounded; None if level."""
    n, G = smooth(*dsd(truth.z, truth.ds))
    G = G.mean(axis=0)
    inside = (n >= band[0]) & (n <= band[1]) & (G > 0.0)
    if inside.sum() < 2:
        return None
    _, w = fit_line(n, G, band=band)
    w = round(float(np.clip(w, *WAVINESS)), 1)
    level, _ = fit_line(n, G, w=w, band=band)
    return round(10.0 * np.log10(level)), w


def pooled(
    car: str, instruments: str, mode: str | dict[str, str], v: float, level: float, w: float
) -> float:
    """Least in-band NRMSE [-] at `v` [m/s] on a road of `level` and `w`, as `spectrum` has them."""
    return _pooled(car, instruments, json.dumps(mode), v, level, w)


@lru_cache(maxsize=4096)
def _pooled(car: str, instruments: str, command: str, v: float, level: float, w: float) -> float:
    vehicle, prior = load_vehicle(car), RoadPrior(G_d0=10.0 ** (level / 10.0), w=w)
    n = np.linspace(*scored_band(v), LINES)
    mode = json.loads(command)
    return bound(vehicle, mode, v, load_instruments(instruments), prior, n=n).pooled
