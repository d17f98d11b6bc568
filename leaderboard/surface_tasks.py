"""Tasks for a surface file: the measured road under the paper's protocol and as a new road."""

import re
from pathlib import Path

import numpy as np

from leaderboard.evaluation.tasks import Task
from leaderboard.metrics.heights import scored_band
from road_envs.core.config import ConfigError, build
from road_envs.core.reading import parsing
from road_envs.records.record import PROFILE_SPACING, profile_stations
from road_envs.records.roughness import (
    detrend_linear,
    displacement_psd,
    fit_line,
    roughness_class,
    smooth_psd,
)
from road_envs.roads import Surface, load_road, realise_road
from road_envs.roads.composite import NoisyCopy
from road_envs.simulation.drive import SimulationError, simulate
from road_envs.vehicle.parameters import load_vehicle

_MIN_LENGTH = 100.0  # a shorter surface is repeated, mirrored, up to this length [m]
_LEVEL_RANGE = 1e-6  # range [m] of heights about their line below which a surface is level
_MAX_LENGTH = 300.0  # only this length [m] from the start of a longer surface is driven
_CAR = "land_rover_defender_110"
_MODES = ("ride", "handling", {"front": "ride", "rear": "handling"})
_SPEEDS_KMH = (14.5, 10.0, 7.0, 5.0)  # driven is the highest at which wheels stay on the ground
_MAX_LIFTED_TIME = 0.001  # share of the time off the ground where wheels count as staying down
_SEEDS = (1, 2, 3, 4, 5)


def surface_tasks(path: Path) -> list[Task]:
    """Return two tasks on one file: trained on altered copies of it, and on roads of its class.

    The class is computed from the file, which no estimator would have on the road; title and note
    say so, and how much of the file is driven, at the highest of _SPEEDS_KMH at which the wheels
    stay on the ground. Where they do not at any, the tasks have no bound: of a road below wheels in
    the air nothing is learnt. Raises ConfigError, which names the file, if it cannot be used.
    """
    native = load_road(path).length
    length = min(max(native, _MIN_LENGTH), _MAX_LENGTH)
    road = {"kind": "measured", "path": str(path), "length": length}
    if native < length:
        road["repeat"] = "mirror"
    with parsing(path, ConfigError, "of no use as a test road"):
        surface = realise_road(road, 0)
        if not _uneven_paths(surface).any():
            raise ConfigError("a level surface, on which no estimate can be scored")
        letter = _surface_class(surface)
    try:
        speed, lifted = _choose_speed(surface)
    except SimulationError as error:
        raise ConfigError(
            f"{path}: the vehicle cannot drive over it at {_SPEEDS_KMH[-1]:g} km/h: {error}"
        ) from None
    note = _describe_drive(native, length, speed, lifted)
    common = {
        "board": "measured",
        "version": 2,
        "car": _CAR,
        "instruments": "paper",
        "conditions": [{"mode": mode, "speed_kmh": speed} for mode in _MODES],
        "bound": lifted <= _MAX_LIFTED_TIME,
        "test": {"roads": [road], "seeds": [1001], "step": 0.0005},
        "bumps": True,
        "source": path.name,
    }
    rest, heights = detrend_linear(surface.z), surface.z - surface.z.mean(axis=1, keepdims=True)
    noise = NoisyCopy.noise * float(rest.std())  # [m]: a hill is no roughness
    altered = {"kind": "noisy_copy", "road": road, "noise": round(noise / float(heights.std()), 6)}
    stem = re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem)
    copies = {
        "name": f"{stem}_paper",
        "title": f"{path.stem}: trained on an altered copy of itself, as the paper does",
        "training": {"roads": [altered], "seeds": [1], "noise": False},
        "trains_on_test_road": True,
        "note": f"{note} The copy has noise of {1e3 * noise:.2g} mm RMS, a tenth of that of the "
        "heights about their line.",
    }
    others = {
        "name": f"{stem}_new_road",
        "title": f"{path.stem}: trained on random roads of class {letter}, the class of this file",
        "training": {"roads": [f"iso_{letter.lower()}"], "seeds": list(_SEEDS), "length": 100.0},
        "note": f"{note} The class of the training roads was computed from the file; on a drive it "
        "would have to be estimated.",
    }
    return [build(Task, {**common, **special}, str(path)) for special in (copies, others)]


def _choose_speed(surface: Surface) -> tuple[float, float]:
    """Return the speed [km/h] of the drives, and the most time [-] with a wheel in the air."""
    car = load_vehicle(_CAR)
    for speed in _SPEEDS_KMH:
        try:
            motions = [simulate(car, surface, speed / 3.6, mode) for mode in _MODES]
        except SimulationError:
            if speed == _SPEEDS_KMH[-1]:
                raise
            continue
        lifted = max(float(np.mean((m.tyre_load <= 0.0).any(axis=1))) for m in motions)
        if lifted <= _MAX_LIFTED_TIME:
            break
    return speed, lifted


def _describe_drive(native: float, length: float, speed: float, lifted: float) -> str:
    """Return the note on what is driven of a surface of `native` length [m], and how."""
    part = f"All {native:.0f} m are driven"
    if round(native) > round(length):
        part = f"The first {length:.0f} m of {native:.0f} m are driven"
    elif round(native) < round(length):
        part = f"The surface of {native:.0f} m is driven, mirrored up to {length:.0f} m,"
    end = "." if speed == _SPEEDS_KMH[0] else ": at higher speeds wheels leave the ground."
    if lifted > _MAX_LIFTED_TIME:
        end = (
            f", where a wheel is still in the air for {lifted:.1%} of the time: the road below it "
            "cannot be known, and no bound is given."
        )
    return f"{part} at {speed:g} km/h{end}"


def _uneven_paths(surface: Surface) -> np.ndarray:
    """Return whether each wheel path (2,) is not level."""
    return np.ptp(detrend_linear(surface.z), axis=1) >= _LEVEL_RANGE


def _surface_class(surface: Surface) -> str:
    """Return the ISO 8608 class of the rougher wheel path in the scored band of 1 m/s, w = 2."""
    z = surface.height(profile_stations(surface.length))[_uneven_paths(surface)]
    n, G = smooth_psd(*displacement_psd(z, PROFILE_SPACING))
    band = scored_band(1.0)
    return roughness_class(max(fit_line(n, path, w=2.0, band=band)[0] for path in G))
