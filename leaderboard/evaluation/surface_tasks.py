"""Tasks for a surface file: the measured road under the paper's protocol and as a new road."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.evaluation.tasks import Task
from leaderboard.metrics.heights import scored_band
from road_envs.analysis.roughness import displacement_psd, fit_line, roughness_class, smooth_psd
from road_envs.config import build
from road_envs.data.record import PROFILE_SPACING, profile_stations
from road_envs.roads import Surface, load_road

MIN_LENGTH = 100.0
"""A shorter surface is repeated, mirrored, up to this length [m]."""

MAX_LENGTH = 300.0
"""Only this length [m] from the start of a longer surface is driven."""

CONDITIONS = (
    {"mode": "ride", "speed_kmh": 14.5},
    {"mode": "handling", "speed_kmh": 14.5},
    {"mode": {"front": "ride", "rear": "handling"}, "speed_kmh": 14.5},
)
SEEDS = (1, 2, 3, 4, 5)


def surface_tasks(path: Path, conditions: tuple[dict[str, Any], ...] = CONDITIONS) -> list[Task]:
    """Return two tasks on one file: trained on altered copies of it, and on roads of its class.

    The class is computed from the file, which is information that no estimator would have on the
    road; title and note of the task say so. Raises ConfigError if the file cannot be used.
    """
    native = load_road(path).length
    length = min(max(native, MIN_LENGTH), MAX_LENGTH)
    road = {"kind": "measured", "path": str(path), "length": length}
    if native < length:
        road["repeat"] = "mirror"
    surface = load_road(road).realise(np.random.default_rng(0))
    letter = surface_class(surface)
    common = {
        "version": 1,
        "car": "land_rover_defender_110",
        "instruments": "paper",
        "conditions": list(conditions),
        "test": {"roads": [road], "seeds": [1001], "step": 0.0005},
        "bumps": True,
        "source": path.name,
    }
    stem = re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem)
    copies = {
        "name": f"{stem}_paper",
        "title": f"{path.stem}: trained on an altered copy of itself, as the paper does",
        "board": "measured",
        "training": {"roads": [{"kind": "altered", "road": road}], "seeds": [1], "noise": False},
        "trains_on_test_road": True,
    }
    others = {
        "name": f"{stem}_new_road",
        "title": f"{path.stem}: trained on random roads of class {letter}, the class of this file",
        "board": "measured",
        "training": {"roads": [f"iso_{letter.lower()}"], "seeds": list(SEEDS), "length": 100.0},
        "note": "The class of the training roads was computed from the file; on a drive it would "
        "have to be estimated.",
    }
    return [build(Task, {**common, **special}, str(path)) for special in (copies, others)]


def surface_class(surface: Surface) -> str:
    """Return the ISO 8608 class of the rougher wheel path in the scored band of 1 m/s, w = 2."""
    s = profile_stations(surface.length)
    n, G = smooth_psd(*displacement_psd(surface.height(s), PROFILE_SPACING))
    band = scored_band(1.0)
    return roughness_class(max(fit_line(n, path, w=2.0, band=band)[0] for path in G))
