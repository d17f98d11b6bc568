"""Bounds on the error of the road estimate by mode and speed, from Python.

car, prior = load_vehicle("land_rover_defender_110"), RoadPrior()
rows, curves = bounds_by_state(car, "paper", prior, modes=["ride"], speeds_kmh=[54.0])
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from estimators.map_smoother.attainable import attainable_error, van_trees_error
from road_envs.analysis.information_bound import Posterior, RoadPrior, bound, equivalent_damping
from road_envs.core.config import ConfigError, validate_choice
from road_envs.drives.recording import simulate_record
from road_envs.records.record import F_C, scored_band
from road_envs.roads.iso8608 import Iso8608
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import decode_commands, encode_command

_Mode = str | dict[str, str]
_PLOTTED_BAND = (0.05, 2.5)  # band [cycles/m] of a curve, cut at the low-pass of the sensors
BANDWIDTHS = (25.0, 100.0, 333.0)  # of the data [Hz] for the attainable error
_ATTAINABLE_LENGTH = 100.0  # of its road [m]
_Curve = tuple[str, float, Posterior, float]
"""Mode, speed [km/h], posterior of the road over spatial frequency, in-band NRMSE [-]."""


def bounds_by_state(
    car: VehicleParameters,
    sensors: str,
    prior: RoadPrior,
    modes: Sequence[_Mode],
    speeds_kmh: Sequence[float],
    *,
    noise_density: float | None = None,
    dampers: Mapping[str, float] | None = None,
    model_error: float = 0.0,
    attainable: bool = False,
    with_curves: bool = False,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> tuple[list[dict[str, Any]], list[_Curve]]:
    """Return a row of bounds and, `with_curves`, the curve over frequency of each mode at each
    speed [km/h].

    `sensors` name the instruments; `noise_density` [(m/s²)/sqrt(Hz)] replaces that of each sensor;
    `dampers` [N s/m] by name of a mode replace the equivalent ones; `model_error` is relative to
    the signal of each sensor. With `attainable`, a row has the attainable NRMSE by BANDWIDTHS, the
    bound of van Trees and that of linear estimators, too. Raises ConfigError.
    """
    for speed in speeds_kmh:
        if not (np.isfinite(speed) and speed > 0):
            raise ConfigError(f"the speed must be positive, got {speed} km/h")
    instruments = load_instruments(sensors)
    if noise_density is not None:
        try:
            instruments = dataclasses.replace(instruments.noiseless, noise_density=noise_density)
        except ValueError as error:
            raise ConfigError(str(error)) from None
    elif attainable and (instruments.noise_densities != instruments.noise_density).any():
        raise ConfigError(
            f"sensors of {sensors} have noise of their own; what is attainable is computed for one "
            "noise of all: give it in (m/s²)/sqrt(Hz) (--noise), or leave out --attainable"
        )
    chosen = [_damping_by_strut(dampers, mode, car) for mode in modes]  # fails before all else
    rows: list[dict[str, Any]] = []
    curves: list[_Curve] = []
    jobs = [(*pair, speed) for pair in zip(modes, chosen, strict=True) for speed in speeds_kmh]
    for k, (mode, c, speed) in enumerate(jobs):
        name, v = _front_rear(mode), speed / 3.6
        progress(f"{name}, {speed:g} km/h", k / len(jobs))
        c = equivalent_damping(car, mode, v, prior) if c is None else c
        settings: dict[str, Any] = {"damping": c, "model_error": model_error}
        posterior = bound(car, mode, v, instruments, prior, **settings)
        left, right = posterior.nrmse().tolist()
        row = {"mode": name, "speed_kmh": speed, "band": scored_band(v)}
        row |= {"nrmse": posterior.pooled, "nrmse_left": left, "nrmse_right": right}
        rows.append(row | {"damping": c.tolist()})
        if attainable:
            floor = bound(car, mode, v, instruments, prior, residual_as_noise=True, **settings)
            rows[-1]["linear_estimators"] = floor.pooled
            road = Iso8608(G_d0=prior.G_d0, w=prior.w, track=prior.track, length=_ATTAINABLE_LENGTH)
            drive: dict[str, Any] = {"speed_kmh": speed, "mode": mode, "instruments": sensors}
            record, truth = simulate_record(road, vehicle=car, **drive)
            given: dict[str, Any] = {"instruments": sensors, "noise_density": noise_density}
            rows[-1]["attainable"] = {
                f"{f:g}": attainable_error(record, truth, car, prior, bandwidth=f, **given)
                for f in BANDWIDTHS
            }
            widest = van_trees_error(record, car, prior, bandwidth=BANDWIDTHS[-1], **given)
            rows[-1]["van_trees"] = widest
        if with_curves:
            n = np.geomspace(_PLOTTED_BAND[0], min(_PLOTTED_BAND[1], F_C / v), 3000)
            drawn = bound(car, mode, v, instruments, prior, n=n, **settings)
            curves.append((name, speed, drawn, posterior.pooled))
    return rows, curves


def _front_rear(mode: _Mode) -> str:
    """Return a short name of a mode, "ride / handling" for front and rear."""
    if isinstance(mode, str):
        return f"{mode} / {mode}"
    if set(mode) == {"front", "rear"}:
        return f"{mode['front']} / {mode['rear']}"
    return ", ".join(f"{wheel} {state}" for wheel, state in mode.items())


def _damping_by_strut(
    dampers: Mapping[str, float] | None, mode: _Mode, car: VehicleParameters
) -> np.ndarray | None:
    """Return the damping (4,) [N s/m] of each strut in its mode; None without `dampers`."""
    stiff, high = (flags[0] for flags in decode_commands(np.array([encode_command(mode, car)])))
    if dampers is None:
        return None
    for name, damping in dampers.items():
        validate_choice("suspension mode", name, car.modes)
        if not (math.isfinite(damping) and damping >= 0.0):
            raise ConfigError(f"the damping of {name} must be at least 0 N s/m, got {damping}")
    names = {state: name for name, state in car.modes.items()}
    modes = [names[bool(s), bool(h)] for s, h in zip(stiff, high, strict=True)]
    if missing := sorted(set(modes) - set(dampers)):
        raise ConfigError(f"dampings are given for {sorted(dampers)}, but not for {missing}")
    return np.array([dampers[name] for name in modes])
