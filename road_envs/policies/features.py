"""What learned policies see: the instruments of one interval as FEATURES numbers of order one.

Heave, roll and pitch acceleration and rates, felt horizontal accelerations, struts, running RMS of
vertical and lateral acceleration over a second, speed, commanded states. Those that need a past
have a memory for every car, which is forgotten when its episode ends.

Those who look ahead also see AHEAD more: how much higher than under the rear axle the road is
before it, half the sum and half the difference of the wheel paths, as felt by the front axle.
"""

import numpy as np

from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator, RunningRms
from road_envs.policies.wheelbase_preview import WheelbasePreview

FEATURE_SCALES = np.concatenate(
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
N_FEATURES = FEATURE_SCALES.size
PREVIEW_DISTANCES = np.linspace(0.0, 2.4, 7)
"""From the rear axle [m]; heights are told from that at the first."""

N_PREVIEW_FEATURES, HEIGHT_SCALE = 2 * (PREVIEW_DISTANCES.size - 1), 20.0
"""Features of the road ahead, and their scale [1/m]."""

MAX_FEATURE = 5.0
"""Largest size of a feature."""


class FeatureExtractor:
    """Turns observations (N, d) into features (N, K): K = FEATURES, and AHEAD more for those who
    look `preview`. Needs "planar" and "struts".
    """

    def __init__(self, context: PolicyContext, preview: bool = False):
        self.context, self.body = context, BodyMotionEstimator(context, leak=0.2)
        self.vertical, self.lateral = RunningRms(context, 1.0), RunningRms(context, 1.0)
        self.preview = WheelbasePreview(context) if preview else None

    def reset(self, mask: np.ndarray) -> None:
        """Forget the cars in `mask` (N,)."""
        for memory in (self.body, self.vertical, self.lateral, self.preview):
            if memory is not None:
                memory.reset(mask)

    def update(self, observations: np.ndarray) -> np.ndarray:
        """Features (N, K) float32, going on by one interval."""
        self.body.update(observations)
        planar = self.context.signal("planar", observations)
        others = ("extension", "extension_rate")
        running = (self.vertical.add(self.body.a[:, 0]), self.lateral.add(planar[:, 1]))
        columns = [
            self.body.a,
            self.body.v,
            planar,
            *(self.context.signal(name, observations) for name in others),
            np.stack(running, axis=1),
            *(self.context.signal(name, observations) for name in ("speed", "front", "rear")),
        ]
        features = np.concatenate(columns, axis=1) * FEATURE_SCALES
        if self.preview is not None:
            features = np.concatenate([features, self._preview_features(observations)], axis=1)
        return np.clip(features, -MAX_FEATURE, MAX_FEATURE).astype(np.float32)

    def _preview_features(self, observations: np.ndarray) -> np.ndarray:
        """Features (N, AHEAD) of the road ahead of the rear axle."""
        assert self.preview is not None
        self.preview.update(observations)
        z = self.preview.heights_at(PREVIEW_DISTANCES)
        left, right = np.moveaxis(z[:, 1:] - z[:, :1], -1, 0)
        return 0.5 * HEIGHT_SCALE * np.concatenate([left + right, left - right], axis=1)


def n_features(preview: bool) -> int:
    """How many features there are."""
    return N_FEATURES + N_PREVIEW_FEATURES * preview
