"""What learned policies see: the instruments of one interval as FEATURES numbers of order one.

Heave, roll and pitch acceleration and rates, felt horizontal accelerations, struts, running RMS of
vertical and lateral acceleration over a second, speed, commanded states. Those that need a past
have a memory for every car, which is forgotten when its episode ends.

Those who look ahead also see AHEAD more: how much higher than under the rear axle the road is
before it, half the sum and half the difference of the wheel paths, as felt by the front axle.
"""

import numpy as np

from road_envs.policies.api import Cabin
from road_envs.policies.body_motion import Body, Running
from road_envs.policies.wheelbase_preview import RoadAhead

SCALES = np.concatenate(
    [
        np.full(3, 0.5),  # accelerations [m/s², rad/s²]
        np.full(3, 3.0),  # rates [m/s, rad/s]
        np.full(2, 0.3),  # felt [m/s²]
        np.full(4, 20.0),  # extensions [m]
        np.full(4, 3.0),  # their rates [m/s]
        np.full(2, 0.5),  # running RMS [m/s²]
        np.full(1, 0.05),  # speed [m/s]
        np.ones(4),  # states
    ]
)
FEATURES = SCALES.size
DISTANCES = np.linspace(0.0, 2.4, 7)
"""From the rear axle [m]; heights are told from that at the first."""

AHEAD, HEIGHT = 2 * (DISTANCES.size - 1), 20.0
"""Features of the road ahead, and their scale [1/m]."""

MOST = 5.0
"""Largest size of a feature."""


class Features:
    """Turns observations (N, d) into features (N, K): K = FEATURES, and AHEAD more for those who
    look `ahead`. Needs "planar" and "struts".
    """

    def __init__(self, cabin: Cabin, ahead: bool = False):
        self.cabin, self.body = cabin, Body(cabin, leak=0.2)
        self.vertical, self.lateral = Running(cabin, 1.0), Running(cabin, 1.0)
        self.road = RoadAhead(cabin) if ahead else None

    def restart(self, mask: np.ndarray) -> None:
        """Forget the cars in `mask` (N,)."""
        for memory in (self.body, self.vertical, self.lateral, self.road):
            if memory is not None:
                memory.restart(mask)

    def of(self, observations: np.ndarray) -> np.ndarray:
        """Features (N, K) float32, going on by one interval."""
        self.body.feel(observations)
        planar = self.cabin.part("planar", observations)
        others = ("extension", "extension_rate")
        running = (self.vertical.add(self.body.a[:, 0]), self.lateral.add(planar[:, 1]))
        columns = [
            self.body.a,
            self.body.v,
            planar,
            *(self.cabin.part(name, observations) for name in others),
            np.stack(running, axis=1),
            *(self.cabin.part(name, observations) for name in ("speed", "front", "rear")),
        ]
        features = np.concatenate(columns, axis=1) * SCALES
        if self.road is not None:
            features = np.concatenate([features, self._ahead(observations)], axis=1)
        return np.clip(features, -MOST, MOST).astype(np.float32)

    def _ahead(self, observations: np.ndarray) -> np.ndarray:
        """Features (N, AHEAD) of the road ahead of the rear axle."""
        assert self.road is not None
        self.road.feel(observations)
        z = self.road.at(DISTANCES)
        left, right = np.moveaxis(z[:, 1:] - z[:, :1], -1, 0)
        return 0.5 * HEIGHT * np.concatenate([left + right, left - right], axis=1)


def width(ahead: bool) -> int:
    """How many features there are."""
    return FEATURES + AHEAD * ahead
