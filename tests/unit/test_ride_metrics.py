"""Metrics of a drive: values known in closed form, counts of hits, time shares of states."""

import numpy as np
import pytest

from leaderboard.policies.ride_metrics import (
    count_bump_stop_hits,
    ride_metrics,
    state_time_shares,
)
from road_envs.analysis.comfort import weighted_rms
from road_envs.simulation.drive import Trajectory
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")


def motion(n: int = 4000, **parts) -> Trajectory:
    """Return a motion at 10 m/s on static loads, except for `parts` of the signals (n, ...)."""
    signals = np.zeros((n, 29))
    signals[:, 25:29] = np.repeat(CAR.tyre_loads, 2)
    t = 0.001 * np.arange(n)
    commands = parts.pop("commands", np.zeros(n, dtype=np.uint8))
    columns = {
        "phi": slice(1, 2),
        "heave": slice(14, 15),
        "e": slice(21, 25),
        "load": slice(25, 29),
    }
    for name, value in parts.items():
        signals[:, columns[name]] = value
    return Trajectory(t, 10.0 * t, np.full(n, 10.0), commands, signals)


def test_metrics_of_a_motion_known_in_closed_form():
    t = 0.001 * np.arange(4000)
    roll = 0.1 * np.sin(2.0 * np.pi * t)
    load = np.repeat(CAR.tyre_loads, 2) * (1.0 + 0.5 * np.sin(2.0 * np.pi * 2.0 * t)[:, None])
    load[1000:1500, 2] = 0.0
    heave = np.sin(2.0 * np.pi * 4.0 * t)
    commands = np.zeros(4000, dtype=np.uint8)
    commands[20:] = 255  # from the first interval's mode to the policy's first choice
    commands[1000:] = 0
    commands[3000:] = 255
    found = ride_metrics(
        motion(phi=roll[:, None], load=load, heave=heave[:, None], commands=commands), CAR, 20
    )
    assert found["roll"] == pytest.approx(0.1 / np.sqrt(2.0))
    assert found["roll_peak"] == pytest.approx(0.1, rel=1e-4)
    assert found["lift_per_km"] == pytest.approx(0.5 / 0.04)
    assert found["switches_per_km"] == pytest.approx(2 / 0.04)
    assert found["dwell"] == pytest.approx(4.0 / 3)
    assert found["comfort"] == pytest.approx(weighted_rms(heave, 1000.0))
    assert found["vdv"] == pytest.approx((4.0 * 3 / 8) ** 0.25, rel=0.05)  # W_k(4 Hz) = 0.967
    extension = 0.05 * np.cos(2.0 * np.pi * t)[:, None] * [1.0, -1.0, 1.0, 1.0]
    still = ride_metrics(motion(e=extension), CAR)
    assert still["rattle"] == pytest.approx(0.05 / np.sqrt(2.0))
    assert still["rattle_peak"] == pytest.approx(0.05)
    assert (still["tyre_load"], still["roll"], still["switches_per_km"]) == (0.0, 0.0, 0.0)


def test_a_bump_stop_hit_is_counted_once_per_excursion_beyond_free_travel():
    e = np.zeros((100, 4))
    e[10:20, 0] = e[30:31, 0] = -0.086  # front: free from -85 to 95 mm
    e[50:, 1] = 0.096
    e[10:20, 2] = -0.1049  # rear: free from -105 to 115 mm
    e[0:5, 3] = 0.1151
    assert count_bump_stop_hits(e, CAR) == 4


def test_time_shares_of_the_states():
    commands = np.array([0] * 30 + [0b11001100] * 60 + [255] * 10, dtype=np.uint8)
    ride_handling = (False, False, True, True)
    assert state_time_shares(commands) == {
        (False,) * 4: 0.3,
        ride_handling: 0.6,
        (True,) * 4: 0.1,
    }
