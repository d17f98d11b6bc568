"""What learning estimators read: sensor signals and truths over distance instead of time."""

import numpy as np

from road_envs.processing import process
from road_envs.record import GRID, Profile, Record, grid

F_C = 25.0
"""Band limit of the processed accelerations [Hz]."""


def accelerations(record: Record, margin: int = 0) -> np.ndarray:
    """Processed accelerations (3, M + 2 margin) [m/s²] at the moments when the front axle passed
    the grid and `margin` points beyond either end of it; zero where the record does not reach.
    """
    stations = GRID * np.arange(-margin, grid(record.length).size + margin)
    a = record.at(stations, process(record.a, record.fs, F_C))
    a[:, (stations < record.s[0]) | (stations > record.s[-1])] = 0.0
    return a


def heights(truth: Profile, stations: np.ndarray) -> np.ndarray:
    """True heights (2, M) [m] at `stations` (M,) [m]."""
    return np.array([np.interp(stations, truth.s, z) for z in truth.z])
