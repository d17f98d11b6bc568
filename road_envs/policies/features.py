"""Features of learned policies: the instruments of one interval, scaled to order one.

They are equal for a drive and its mirror image: quantities that change their sign with the side,
such as roll, are multiplied by the sign of the low-passed lateral force, so that every turn is one
to the left. `NAMES` lists them. Filtered features have a state per vehicle, which is reset when its
episode ends.
"""

import numpy as np

from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator, RunningRms

FEATURES = {
    "heave_acceleration": 0.5,
    "pitch_acceleration": 0.5,
    "heave_rate": 3.0,
    "pitch_rate": 3.0,
    "longitudinal": 0.3,
    "front_extension": 20.0,
    "rear_extension": 20.0,
    "front_extension_rate": 3.0,
    "rear_extension_rate": 3.0,
    "roll_acceleration": 0.5,
    "roll_rate": 3.0,
    "lateral": 0.3,
    "front_extension_difference": 20.0,
    "rear_extension_difference": 20.0,
    "front_rate_difference": 3.0,
    "rear_rate_difference": 3.0,
    "lateral_fast": 0.5,
    "lateral_slow": 0.5,
    "front_stroke": 1.0,
    "rear_stroke": 1.0,
    "vertical_rms": 0.5,
    "lateral_rms": 0.5,
    "speed": 0.05,
    "front_stiff": 1.0,
    "front_high": 1.0,
    "rear_stiff": 1.0,
    "rear_high": 1.0,
}
"""Features and their scales, one over a unit: m/s², rad/s², m/s, rad/s, m; strokes are a share."""

NAMES = tuple(FEATURES)
N_FEATURES, SCALES = len(NAMES), np.array(list(FEATURES.values()))
FAST, SLOW = 0.05, 0.5  # time constants [s] of the low-passed lateral forces
LOOK_AHEAD = 0.05  # time [s] ahead at which strokes are taken, by the rates of the struts
MAX_FEATURE = 5.0  # features are clipped to this magnitude


class FeatureExtractor:
    """Map from observations (N, d), with "planar" and "struts", to features (N, N_FEATURES)."""

    def __init__(self, context: PolicyContext):
        self.context, self.body = context, BodyMotionEstimator(context, leak=0.2)
        self.vertical, self.lateral = RunningRms(context, 0.5), RunningRms(context, 0.5)
        self.low_passed = np.zeros((2, context.n_vehicles))
        self.decay = np.exp(-context.interval / np.array([[FAST], [SLOW]]))
        self.stops = context.car.free_travel

    def reset(self, mask: np.ndarray) -> None:
        for part in (self.body, self.vertical, self.lateral):
            part.reset(mask)
        self.low_passed[:, mask] = 0.0

    def update(self, observations: np.ndarray) -> np.ndarray:
        """Advance by one interval, and return the features (N, K), float32."""
        signal = self.context.signal
        self.body.update(observations)
        a, v = self.body.a.T, self.body.v.T
        a_x, a_y = signal("planar", observations).T
        e, rate = signal("extension", observations).T, signal("extension_rate", observations).T
        self.low_passed = self.decay * self.low_passed + (1.0 - self.decay) * a_y
        side = np.where(self.low_passed[0] < 0.0, -1.0, 1.0)
        # relative to the stops in jounce and in rebound: 1 where a bump stop begins
        use = (e + LOOK_AHEAD * rate) / self.stops.T[:, :, None]
        stroke = use.max(axis=0).reshape(2, 2, -1).max(axis=1)
        even = [
            a[0], a[2], v[0], v[2], a_x, 0.5 * (e[0] + e[1]), 0.5 * (e[2] + e[3]),
            0.5 * (rate[0] + rate[1]), 0.5 * (rate[2] + rate[3]),
        ]  # fmt: skip
        odd = [a[1], v[1], a_y, e[0] - e[1], e[2] - e[3], rate[0] - rate[1], rate[2] - rate[3]]
        running = self.vertical.add(a[0]), self.lateral.add(a_y)
        states = [signal(name, observations).T for name in ("speed", "front", "rear")]
        rows = [even, side * np.stack(odd), side * self.low_passed, stroke, running, *states]
        features = np.concatenate(rows).T * SCALES
        return np.clip(features, -MAX_FEATURE, MAX_FEATURE).astype(np.float32)
