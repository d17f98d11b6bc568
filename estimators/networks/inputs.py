"""What the sequence networks read: how a drive becomes their input.

A bank of linear windows (`bank.py`) makes a first estimate; the network sees it beside the motions,
all over the level l of the drive, and adds what it believes is missing:

    m, q  =  bank  +  l network(motions / l, bank / l; speed, states, l)

Friction breaks the equivariance of scale, so the logarithm of the level is a condition, beside the
speed and the states of the struts. A mirrored drive gives the mirrored road by construction: the
network is asked twice, and the second time roll and q have the other sign.

The level is the RMS of the first estimate above 0.15 cycles/m; that is also the band in which the
network corrects and to which its standard deviation belongs. A causal network may use what was
sensed until the front axle is LAG ahead of the estimated station; its level is that of the last
LEVEL_REACH metres.
"""

from typing import NamedTuple, Protocol

import numpy as np
from scipy import signal

from estimators.common.spatial_signals import (
    EDGE_STATIONS,
    FILTER_REACH,
    N_MOTIONS,
    SPACING,
    SpatialSignals,
)
from estimators.linear.fir_bank import FirBank, keep_short_waves
from estimators.networks.training_data import STATIONS_BEHIND

LAG = 4.79
"""How far the front axle of the Defender is past a station when a causal network tells its height
[m]: a wheelbase and 2 m."""

STATIONS_AHEAD = int((LAG - 2.0 * FILTER_REACH) / SPACING)
"""Stations after the estimated one that a causal estimator may read; the filters take the rest."""

LEVEL_DECAY_LENGTH = 30.0
"""Distance [m] over which the level of a causal network fades."""

LEVEL_MIN = 3e-4
"""Added to the level [m]: a drive over a level road is not amplified."""

N_INPUTS, N_CONDITIONS = 10, 8


class NetworkInputs(NamedTuple):
    """What a network reads: `x` (INPUTS, behind + M + ahead), `conditions` (CONDITIONS, 1 or as
    many); and what makes heights of its answer: the `level` (M,) [m] and `first` estimate (2, M)
    [m] of m and q.
    """

    x: np.ndarray
    conditions: np.ndarray
    level: np.ndarray
    first: np.ndarray


class ReceptiveField(Protocol):
    """What a network reads before and after the stations for which it answers."""

    behind: int
    ahead: int


MIRROR_SIGNS = np.array([1, 1, -1, 1, 1, -1, 1, -1, 1, -1], dtype=np.float32)[:, None]
"""Signs of the inputs in the mirror."""


def window_span(causal: bool) -> tuple[int, int]:
    """Stations before and after the estimated one that the linear window reads."""
    return STATIONS_BEHIND, STATIONS_AHEAD if causal else STATIONS_BEHIND


def network_inputs(
    signals: SpatialSignals, bank: FirBank, wheelbase: float, field: ReceptiveField, causal: bool
) -> NetworkInputs:
    """What a network reads of a drive.

    Rows of x: accelerations and velocities of front, rear and roll; m and q of the first estimate,
    and the same as the rear axle meets it. A causal network answers when the front axle is `STATIONS_AHEAD`
    stations further on, so its rows stand at the moment of sensing, and the first estimate comes
    lookahead by as much.
    """
    lookahead = STATIONS_AHEAD if causal else 0
    behind, ahead = field.behind, field.ahead
    rear = round(wheelbase / SPACING)
    extra = max(behind + lookahead + rear, ahead)
    first = bank(signals, extra)
    short_waves = keep_short_waves(first, causal)
    level = _level(short_waves, extra, causal)
    M = signals.size
    at = np.arange(-behind, M + ahead)  # the station estimated at each row of x
    sensed = signals.margin + at + lookahead
    u = np.log(np.maximum(signals.v[sensed], 0.1))
    l = level[extra + at]
    scale = np.exp(0.7 * (u - np.log(5.0))) * 100.0 * l
    x = np.concatenate(
        [
            signals.motions[:N_MOTIONS, sensed] / scale,
            signals.motions[N_MOTIONS:, sensed] * (8.0 / scale),
            short_waves[:, extra + at] / l,
            short_waves[:, extra + at - rear] / l,
        ]
    )
    states = signals.states[sensed].T
    speed_term = (u - 2.0) / 0.8
    conditions = np.array(
        [speed_term, speed_term**2 - 1, *(2 * states - 1), np.log(l) + 5.5, np.log(scale)]
    )
    if np.ptp(conditions, axis=1).max() == 0.0:
        conditions = conditions[:, :1]
    inner = slice(extra, extra + M)
    return NetworkInputs(
        x.astype(np.float32), conditions.astype(np.float32), level[inner], first[:, inner]
    )


def _level(short_waves: np.ndarray, extra: int, causal: bool) -> np.ndarray:
    """The level (M + 2 extra,) [m] of a first estimate (2, M + 2 extra)."""
    square = np.mean(short_waves**2, axis=0)
    if not causal:
        inside = square[extra : square.size - extra]
        return np.full(square.size, LEVEL_MIN + np.sqrt(inside.mean()))
    decay = np.exp(-SPACING / LEVEL_DECAY_LENGTH)
    on_road = (np.arange(square.size) >= extra - EDGE_STATIONS).astype(float)
    total, weight = signal.lfilter([1.0], [1.0, -decay], np.array([square * on_road, on_road]))
    return LEVEL_MIN + np.sqrt(total / np.maximum(weight, 5.0 / SPACING))
