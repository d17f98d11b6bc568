"""Inputs of the sequence networks, computed from a drive over distance.

An FIR bank (`fir_bank.py`) gives a first estimate. The network receives it together with the
motions, both divided by the drive's level l, and adds a correction:

    m, q  =  bank  +  l network(motions / l, bank / l; speed, states, l, ratios)

Friction breaks the scale equivariance, so log l is a condition, beside speed and strut states; so
are the ratios of the motions' powers, which tell how the vehicle's body departs from a rigid one. A
mirrored drive gives the mirrored road by construction: the network also processes the mirrored
inputs, and both outputs are averaged.

The level is the RMS of the first estimate above 0.15 cycles/m, the band in which the network
corrects and for which its standard deviation holds. A causal network uses samples up to the moment
when the front axle is LAG ahead of the estimated station; its level is an exponentially weighted
mean with length _LEVEL_DECAY_LENGTH.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy import signal

from estimators.common.pretrained import STATIONS_AHEAD
from estimators.common.spatial_signals import (
    EDGE_STATIONS,
    LEVEL_MIN,
    N_MOTIONS,
    N_RATIOS,
    SPACING,
    SpatialSignals,
    keep_short_waves,
)
from estimators.linear.fir_bank import FirBank

_LEVEL_DECAY_LENGTH = 30.0  # decay length [m] of the causal level
N_INPUTS, N_CONDITIONS = 10, 8 + N_RATIOS


class NetworkInputs(NamedTuple):
    """Inputs `x` (N_INPUTS, behind + M + ahead), `conditions` (N_CONDITIONS, 1 or as many), and the
    `level` (M,) and `first` estimate (2, M) [m] of m and q, which make heights of the output.
    """

    x: np.ndarray
    conditions: np.ndarray
    level: np.ndarray
    first: np.ndarray


# Signs of the inputs of the mirrored drive
MIRROR_SIGNS = np.array([1, 1, -1, 1, 1, -1, 1, -1, 1, -1], dtype=np.float32)[:, None]


def network_inputs(
    signals: SpatialSignals, bank: FirBank, wheelbase: float, network: Any, causal: bool
) -> NetworkInputs:
    """Return the inputs of a `network` that reads so many stations `behind` and `ahead`. Rows of x:
    accelerations and velocities of front, rear and roll; m and q of the first estimate, and the
    same a wheelbase behind. For a causal network the motions are those sensed STATIONS_AHEAD beyond
    the estimated station; the first estimate is that of the station itself.
    """
    lookahead, rear = STATIONS_AHEAD if causal else 0, round(wheelbase / SPACING)
    behind, ahead = network.behind, network.ahead
    extra = max(behind + lookahead + rear, ahead)
    first = bank(signals, extra)
    short_waves = keep_short_waves(first, causal)
    level = _level(short_waves, extra, causal)
    M = signals.size
    at = np.arange(-behind, M + ahead)  # the station estimated at each row of x
    sensed = signals.margin + at + lookahead
    u = np.log(np.maximum(signals.v[sensed], 0.1))
    l = level[extra + at]
    # inputs of about unit scale at every speed and level
    scale = np.exp(0.7 * (u - np.log(5.0))) * 100.0 * l
    motions = signals.motions[:, sensed]
    waves = short_waves[:, extra + at] / l, short_waves[:, extra + at - rear] / l
    x = np.concatenate([motions[:N_MOTIONS] / scale, motions[N_MOTIONS:] * (8.0 / scale), *waves])
    states, speed_term = signals.states[sensed].T, (u - 2.0) / 0.8
    speed_terms, sizes = (speed_term, speed_term**2 - 1), (np.log(l) + 5.5, np.log(scale))
    conditions = np.array([*speed_terms, *(2 * states - 1), *sizes, *signals.spectrum[:, sensed]])
    if np.ptp(conditions, axis=1).max() == 0.0:
        conditions = conditions[:, :1]
    inner = slice(extra, extra + M)
    arrays = x.astype(np.float32), conditions.astype(np.float32)
    return NetworkInputs(*arrays, level[inner], first[:, inner])


def _level(short_waves: np.ndarray, extra: int, causal: bool) -> np.ndarray:
    """Return the level (M + 2 extra,) [m] of a first estimate (2, M + 2 extra)."""
    square = np.mean(short_waves**2, axis=0)
    if not causal:
        inside = square[extra : square.size - extra]
        return np.full(square.size, LEVEL_MIN + np.sqrt(inside.mean()))
    decay = np.exp(-SPACING / _LEVEL_DECAY_LENGTH)
    on_road = (np.arange(square.size) >= extra - EDGE_STATIONS).astype(float)
    total, weight = signal.lfilter([1.0], [1.0, -decay], np.array([square * on_road, on_road]))
    return LEVEL_MIN + np.sqrt(total / np.maximum(weight, 5.0 / SPACING))
