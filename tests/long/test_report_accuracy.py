"""A drive as phones log it, of a car that differs from its description, in a report that holds.

Own column names, g with gravity, a jittering clock of 100 Hz, speed and position once a second; the
road has a hump of 75 mm, a pothole of 50 mm and a bump of 30 mm. At 50 km/h (seed 1) the bump of
0.9 m is found 21 % too low, since the tyre envelops it and 100 Hz resolve less of it.
"""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from leaderboard.drive_report.posterior_iri import posterior_iri
from road_envs.data.record import Estimate
from road_envs.roads import realise_road

ROOT = Path(__file__).parents[2]
OBSTACLES = ((80.0, 75.0, "both"), (150.0, -50.0, "right"), (220.0, 30.0, "both"))
SECONDS = 120.0
"""Longest processor time of a report; its compilation is part of the first."""

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("speed", "seed"), [(36, 1), (36, 2)])
def test_obstacles_and_iri_of_a_phone_drive(tmp_path, seed, speed):
    example = [sys.executable, ROOT / "examples/phone_drive.py", "--out", tmp_path]
    options = ["--seed", str(seed), "--speed-kmh", str(speed)]
    subprocess.run([*example, *options], check=True, cwd=tmp_path)
    command = [sys.executable, "-m", "leaderboard.cli", "report", "phone_drive.csv"]
    began = _cpu_seconds()
    done = subprocess.run(
        [*command, "--description", "phone_drive.yaml", "--out", "report", "--json"],
        check=True, cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert _cpu_seconds() - began < SECONDS
    (drive,) = json.loads(done.stdout)["drives"]
    found = [(o["station_m"], o["height_mm"], o["wheel_path"]) for o in drive["obstacles"]]
    print(speed, seed, [(round(s, 1), round(h), side) for s, h, side in found])
    for station, height, _ in OBSTACLES:
        nearest = min(found, key=lambda o: abs(o[0] - station))
        assert abs(nearest[0] - station) < 0.5
        assert abs(nearest[1] / height - 1.0) < 0.2
    rows = pd.DataFrame(drive["segments"])
    true = _true_iri(np.append(rows["begin_m"], rows["end_m"].iloc[-1]))
    error = rows["iri_mean"].to_numpy() / true - 1.0
    print([f"{100 * e:+.1f} %" for e in error])
    assert np.abs(error).max() < 0.15
    assert (rows["iri_mean_low"] <= true).all() and (true <= rows["iri_mean_high"]).all()


def _cpu_seconds():
    """Return the time of ended processes, which other work on the machine does not change."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _true_iri(edges):
    surface = realise_road("street", 1)
    s = edges[0] + 0.025 * np.arange(int((edges[-1] - edges[0]) / 0.025))
    return posterior_iri(Estimate(s - s[0], surface.height(s)), 10.0, edges - s[0]).median[2]
