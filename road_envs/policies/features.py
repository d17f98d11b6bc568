"""Features of learned policies: the instruments of one interval, scaled to order one.

The N_FEATURES features are heave, roll and pitch acceleration and rates, planar specific force,
strut extensions and their rates, running RMS of vertical and lateral acceleration over a second,
speed, and commanded states. Filtered features have a state per vehicle, which is reset when its
episode ends.

With preview there are N_PREVIEW_FEATURES more: the heights of the road ahead of the rear axle
relative to the height under it, as half the sum and half the difference of the wheel paths, from
`WheelbasePreview`.
"""

import numpy as np

from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator, RunningRms
from road_envs.policies.wheelbase_preview import WheelbasePreview

FEATURE_SCALES = np.concatenate(
    [
        np.full(3, 0.5),  # accelerations [m/s², rad/s²]
        np.full(3, 3.0),  # rates [m/s, rad/s]
        np.full(2, 0.3),  # planar specific force [m/s²]
        np.full(4, 20.0),  # extensions [m]
        np.full(4, 3.0),  # their rates [m/s]
        np.full(2, 0.5),  # running RMS [m/s²]
        np.full(1, 0.05),  # speed [m/s]
        np.ones(4),  # states
    ]
)
N_FEATURES = FEATURE_SCALES.size

PREVIEW_DISTANCES = np.linspace(0.0, 2.4, 7)
"""Distances ahead of the rear axle [m]; heights are relative to the one at the first distance."""

N_PREVIEW_FEATURES, HEIGHT_SCALE = 2 * (PREVIEW_DISTANCES.size - 1), 20.0
"""Number of preview features, and their scale [1/m]."""

MAX_FEATURE = 5.0
"""Features are clipped to this magnitude."""


class FeatureExtractor:
    """Map from observations (N, d) to features (N, K), K = `n_features(preview)`.

    Needs the observation groups "planar" and "struts".
    """

    def __init__(self, context: PolicyContext, preview: bool = False):
        self.context, self.body = context, BodyMotionEstimator(context, leak=0.2)
        self.vertical, self.lateral = RunningRms(context, 1.0), RunningRms(context, 1.0)
        self.preview = WheelbasePreview(context) if preview else None

    def reset(self, mask: np.ndarray) -> None:
        """Reset the vehicles in `mask` (N,)."""
        for part in (self.body, self.vertical, self.lateral, self.preview):
            if part is not None:
                part.reset(mask)

    def update(self, observations: np.ndarray) -> np.ndarray:
        """Advance by one interval, and return the features (N, K), float32."""
        self.body.update(observations)
        planar = self.context.signal("planar", observations)
        running = (self.vertical.add(self.body.a[:, 0]), self.lateral.add(planar[:, 1]))
        columns = [
            self.body.a,
            self.body.v,
            planar,
            *(self.context.signal(name, observations) for name in ("extension", "extension_rate")),
            np.stack(running, axis=1),
            *(self.context.signal(name, observations) for name in ("speed", "front", "rear")),
        ]
        features = np.concatenate(columns, axis=1) * FEATURE_SCALES
        if self.preview is not None:
            features = np.concatenate([features, self._preview_features(observations)], axis=1)
        return np.clip(features, -MAX_FEATURE, MAX_FEATURE).astype(np.float32)

    def _preview_features(self, observations: np.ndarray) -> np.ndarray:
        """Return the features (N, N_PREVIEW_FEATURES) of the road ahead of the rear axle."""
        assert self.preview is not None
        self.preview.update(observations)
        z = self.preview.heights_at(PREVIEW_DISTANCES)
        left, right = np.moveaxis(z[:, 1:] - z[:, :1], -1, 0)
        return 0.5 * HEIGHT_SCALE * np.concatenate([left + right, left - right], axis=1)


def n_features(preview: bool) -> int:
    """Return the number of features."""
    return N_FEATURES + N_PREVIEW_FEATURES * preview
