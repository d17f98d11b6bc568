"""Template of a package with an own estimator, installable and tested.

The example estimator integrates body accelerations twice. It works and is meant to be replaced.
"""

import keyword
import re
from pathlib import Path

from estimators import available
from road_envs._atomic_io import write_text
from road_envs.config import ConfigError

PYPROJECT = """\
[build-system]
requires = ["hatchling>=1.25"]
build-backend = "hatchling.build"

[project]
name = "{distribution}"
version = "0.1.0"
description = "An estimator for RoadRecon"
readme = "README.md"
requires-python = ">=3.11"
dependencies = ["road-envs[board]"]

[project.optional-dependencies]
test = ["pytest>=8"]

[project.entry-points."road_envs.estimators"]
{name} = "{module}.estimator:{cls}"

[tool.hatch.build.targets.wheel]
packages = ["{module}"]
"""

INIT = '''\
"""An estimator for RoadRecon: `{name}`."""
'''

ESTIMATOR = '''\
"""Double integration of body accelerations, as a starting point.

The mean height of both wheel paths is computed from the sensor over the front axle, their
difference from the roll acceleration. Each signal is low-passed, integrated twice over time and
high-passed, since double integration turns noise into drift.

Known to fail above the body's natural frequency (about 1 Hz), where the suspension isolates the
body from the road.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy import signal

from road_envs.data.record import Estimate, Record, profile_stations
from road_envs.sensing.filters import preprocess_accelerations
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class {cls}:
    """`n_low` [cycles/m]: lower cut-off spatial frequency."""

    causal: ClassVar[bool] = False

    n_low: float = 0.1

    def __post_init__(self):
        if not self.n_low > 0:
            raise ValueError(f"n_low must be positive, got {{self.n_low}}")

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return the heights of both wheel paths at the profile stations."""
        stations = profile_stations(record.length)
        rf, lr, rr = preprocess_accelerations(fill_gaps(record.a), record.fs)
        roll = 0.5 * (lr - rr)
        signals = np.array([rf + roll, roll])  # mean over the front axle, half the difference
        f_low = max(self.n_low * float(np.median(record.v)), 0.05)
        mean, half_difference = record.interpolate(
            stations, integrate_twice(signals, record.fs, f_low)
        )
        return Estimate(stations, np.array([mean + half_difference, mean - half_difference]))


def fill_gaps(a: np.ndarray) -> np.ndarray:
    """Return accelerations (k, N) [m/s²] with lost samples, which are NaN, interpolated."""
    k = np.arange(a.shape[1])
    return np.array([np.interp(k, k[valid], x[valid]) for x in a for valid in [np.isfinite(x)]])


def integrate_twice(a: np.ndarray, fs: float, f_low: float) -> np.ndarray:
    """Return displacements (k, N) [m] above `f_low` [Hz] of accelerations (k, N) [m/s²]."""
    sos = signal.butter(2, f_low, "high", fs=fs, output="sos")
    v = signal.sosfiltfilt(sos, np.cumsum(a, axis=1) / fs, axis=1)
    return signal.sosfiltfilt(sos, np.cumsum(v, axis=1) / fs, axis=1)
'''

TEST = '''\
"""Tests of the estimator, without a simulator."""

import numpy as np
from {module}.estimator import {cls}, fill_gaps, integrate_twice

from estimators.api import check_estimate
from road_envs.data.record import Record
from road_envs.vehicle.parameters import load_vehicle


def test_a_sine_is_integrated_twice():
    t = np.arange(24_000) / 400.0
    w = 2.0 * np.pi * 2.0
    z = integrate_twice(-(w**2) * np.sin(w * t)[None], 400.0, 0.2)[0]
    np.testing.assert_allclose(z[8000:-8000], np.sin(w * t[8000:-8000]), atol=0.05)


def test_lost_samples_are_interpolated():
    a = np.array([[0.0, np.nan, 2.0, np.nan, np.nan, 5.0]])
    np.testing.assert_array_equal(fill_gaps(a), [[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]])


def test_the_estimate_is_valid():
    t = np.arange(4000) / 400.0
    a = np.random.default_rng(0).standard_normal((3, t.size))
    off = np.zeros((t.size, 4), dtype=bool)
    record = Record(t, a, np.full(t.size, 5.0), 5.0 * t - 5.0, off, off, 40.0)
    check_estimate({cls}().estimate(record, load_vehicle("land_rover_defender_110")), record)
'''

README = """\
# {distribution}

The estimator `{name}` of road profiles, for RoadRecon.

    pip install --editable ".[test]"
    python -m pytest
    road-recon check-estimator {name}
    road-recon leaderboard --task new_road --estimator {name} --roads 2

The estimator is defined in `{module}/estimator.py`: a frozen dataclass of settings with a method
`estimate(record, car)` that returns the heights of both wheel paths at the stations
`profile_stations(record.length)`. A trainable estimator also has `fit`, `weights` and
`with_weights`; `estimators/api.py` documents them. `pyproject.toml` registers it under the
entry-point group `road_envs.estimators`.
"""


def write_package(name: str, folder: Path) -> list[Path]:
    """Write a package with the estimator `name` into a new or empty `folder`; return its files.

    Raises ConfigError, before anything is written, for an invalid name or a folder with files.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise ConfigError(
            f"{name!r} cannot be the name of an estimator: use lower-case letters, digits and "
            "'_', and begin with a letter"
        )
    if name in available():
        raise ConfigError(f"the name {name!r} is taken by an installed estimator; choose another")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} is not empty; choose a new or empty folder")
    module = f"road_recon_{name}"
    fields = {
        "name": name,
        "module": module,
        "distribution": module.replace("_", "-"),
        "cls": "".join(part.capitalize() for part in name.split("_")),
    }
    files = {
        "pyproject.toml": PYPROJECT,
        "README.md": README,
        f"{module}/__init__.py": INIT,
        f"{module}/estimator.py": ESTIMATOR,
        "tests/test_estimator.py": TEST,
    }
    for path, text in files.items():
        write_text(folder / path, text.format(**fields))
    return [folder / path for path in files]
