"""A package to begin with: an estimator of one's own that installs, is tested, and is judged.

Every file is written whole into a folder that must be new or empty. The estimator is a working one,
the accelerations of the body integrated twice, to be replaced by something better.
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
"""Heights from body accelerations integrated twice: a place to begin.

Left and right wheel path take the mean of what the sensors over the axles say, and their difference
across the car. Each signal is low-passed, integrated twice over time and high-passed, for drift is
what double integration makes of noise.

Known to fail: above the body's own frequency (about 1 Hz), where the suspension hides the road.
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
    """`n_low` [cycles/m]: slower waves are left out."""

    causal: ClassVar[bool] = False

    n_low: float = 0.1

    def __post_init__(self):
        if not self.n_low > 0:
            raise ValueError(f"n_low must be positive, got {{self.n_low}}")

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Both wheel paths on the grid of the record."""
        stations = profile_stations(record.length)
        rf, lr, rr = preprocess_accelerations(fill_gaps(record.a), record.fs)
        roll = 0.5 * (lr - rr)
        middle = np.array([rf + roll, roll])  # over the front axle, and half the difference
        f_low = max(self.n_low * float(np.median(record.v)), 0.05)
        z = record.interpolate(stations, integrate_twice(middle, record.fs, f_low))
        return Estimate(stations, np.array([z[0] + z[1], z[0] - z[1]]))


def fill_gaps(a: np.ndarray) -> np.ndarray:
    """Accelerations (k, N) [m/s²] with straight lines where samples were lost, which are NaN."""
    k = np.arange(a.shape[1])
    return np.array([np.interp(k, k[known], x[known]) for x in a for known in [np.isfinite(x)]])


def integrate_twice(a: np.ndarray, fs: float, f_low: float) -> np.ndarray:
    """Displacements (k, N) [m] of accelerations (k, N) [m/s²], above `f_low` [Hz]."""
    sos = signal.butter(2, f_low, "high", fs=fs, output="sos")
    v = signal.sosfiltfilt(sos, np.cumsum(a, axis=1) / fs, axis=1)
    return signal.sosfiltfilt(sos, np.cumsum(v, axis=1) / fs, axis=1)
'''

TEST = '''\
"""What the estimator keeps, tested without a simulator."""

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


def test_lost_samples_are_fill_gaps():
    a = np.array([[0.0, np.nan, 2.0, np.nan, np.nan, 5.0]])
    np.testing.assert_array_equal(fill_gaps(a), [[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]])


def test_the_estimate_can_be_judged():
    t = np.arange(4000) / 400.0
    a = np.random.default_rng(0).standard_normal((3, t.size))
    off = np.zeros((t.size, 4), dtype=bool)
    record = Record(t, a, np.full(t.size, 5.0), 5.0 * t - 5.0, off, off, 40.0)
    check_estimate({cls}().estimate(record, load_vehicle("land_rover_defender_110")), record)
'''

README = """\
# {distribution}

An estimator of road profiles for RoadRecon, called `{name}`.

    pip install --editable ".[test]"
    python -m pytest
    road-recon check-estimator {name}
    road-recon leaderboard --task new_road --estimator {name} --roads 2

The estimator stands in `{module}/estimator.py`: a frozen dataclass of settings with a method
`estimate(record, car)` that returns heights of both wheel paths at the stations
`profile_stations(record.length)`. One that is trained has `fit`, `weights` and
`with_weights` too; `estimators/api.py` documents them.
`pyproject.toml` registers it under the entry-point group `road_envs.estimators`.
"""


def write_package(name: str, folder: Path) -> list[Path]:
    """Write a package with the estimator `name` into an empty `folder`; returns its files.

    Raises ConfigError, before anything is written, if the name cannot be used or the folder is in
    use.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise ConfigError(
            f"{name!r} cannot be the name of an estimator: small letters, digits and '_' are "
            "wanted, a letter first"
        )
    if name in available():
        raise ConfigError(f"the name {name!r} is taken by an estimator that is installed")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} is in use; a new or empty folder is wanted")
    module = f"road_recon_{name}"
    words = {
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
        write_text(folder / path, text.format(**words))
    return [folder / path for path in files]
