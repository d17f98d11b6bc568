"""Lower bound on the NRMSE of a drive, given the task's instruments and the road driven.

The bound (`road_envs.analysis.information_bound`) holds for linear estimators that know the nominal
car and its instruments, on a Gaussian road with the spectrum of the realised one: a line fitted to
its density inside the scored band, rounded to 1 dB and to 0.1 in waviness. Nonlinear estimators,
and roads that are not Gaussian (such as single obstacles), may do better than the bound.
"""

import json
from functools import lru_cache

import numpy as np

from leaderboard.evaluation.tasks import Condition, Task
from road_envs.analysis.information_bound import RoadPrior, bound
from road_envs.plants.commonroad_car import as_driven
from road_envs.records.record import Profile, scored_band
from road_envs.records.roughness import displacement_psd, fit_line, smooth_psd
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle

_N_FREQUENCIES = 1001  # frequencies over the scored band: enough for three digits of the bound
_WAVINESS_LIMITS = (1.0, 4.0)  # limits of the waviness fitted to a density


def nrmse_bound(task: Task, condition: Condition, truth: Profile) -> float:
    """Return the least in-band NRMSE [-] on a road like `truth`; NaN if level or without noise."""
    v = condition.speed_kmh / 3.6
    road = fit_spectrum(truth, scored_band(v))
    if road is None or not task.test.noise:
        return np.nan
    mode = json.dumps(condition.simulator_mode)
    car, options = condition.car or task.car, {"is_linear": condition.plant == "commonroad"}
    try:
        return pooled_bound(car, task.instruments, mode, v, *road, content=task.digest, **options)
    except np.linalg.LinAlgError:  # instruments without noise
        return np.nan


def fit_spectrum(truth: Profile, band: tuple[float, float]) -> tuple[float, float] | None:
    """Fit level [dB re 1 m³ at n0] and waviness of a road inside `band`; None on a level road.

    Both are rounded, to 1 dB and to 0.1.
    """
    n, G = smooth_psd(*displacement_psd(truth.z, truth.ds))
    G = G.mean(axis=0)
    inside = (n >= band[0]) & (n <= band[1]) & (G > 0.0)
    if inside.sum() < 2:
        return None
    _, w = fit_line(n, G, band=band)
    w = round(float(np.clip(w, *_WAVINESS_LIMITS)), 1)
    level, _ = fit_line(n, G, w=w, band=band)  # refit the level to the rounded waviness
    return round(10.0 * np.log10(level)), w


@lru_cache(maxsize=4096)
def pooled_bound(
    car: str,
    instruments: str,
    mode: str,
    v: float,
    level: float,
    w: float,
    *,
    is_linear: bool = False,
    content: str = "",
) -> float:
    """Return the least in-band NRMSE [-] at `v` [m/s] on a road of `level` [dB] and waviness `w`.

    `mode` is JSON text; `level` and `w` are rounded as `fit_spectrum` returns them, so that results
    can be cached, for a `content` of the files of car and instruments. `is_linear`: the car has the
    struts of the plant `commonroad`.
    """
    vehicle = as_driven(load_vehicle(car)) if is_linear else load_vehicle(car)
    prior = RoadPrior(G_d0=10.0 ** (level / 10.0), w=w)
    n = np.linspace(*scored_band(v), _N_FREQUENCIES)
    return bound(vehicle, json.loads(mode), v, load_instruments(instruments), prior, n=n).pooled
