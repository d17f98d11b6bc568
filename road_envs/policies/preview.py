"""Running RMS with wheelbase preview: in a turn the rear axle lets a bump that comes pass softly.

The front axle tells of the road what the rear axle will meet a wheelbase later (`ahead.py`: a
causal estimate in the loop; the delay is that of Moran & Nagai, JSME Int. J. C 37, 1994, and of
other wheelbase preview).
"""

from dataclasses import dataclass, field

import numpy as np

from road_envs.policies.api import PolicyContext
from road_envs.policies.rrms import RunningRmsPolicy
from road_envs.policies.wheelbase_preview import WheelbasePreview


@dataclass(kw_only=True)
class Preview(RunningRmsPolicy):
    """As `RunningRmsPolicy`, but the rear axle is in ride while within the next `reach` [m] the
    road's heights, on either wheel path, differ by more than `bump` [m]. Needs "planar" and
    "struts".
    """

    bump: float = 0.04
    reach: float = 2.0
    preview: WheelbasePreview = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        super().__post_init__()
        for name in ("bump", "reach"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    def reset(self, context: PolicyContext) -> None:
        """Forget the past."""
        super().reset(context)
        self.preview = WheelbasePreview(context)
        self.distances = np.linspace(0.0, min(self.reach, self.preview.wheelbase), 9)

    def firm_axles(self, observations: np.ndarray) -> np.ndarray:
        """The rear axle is firm where the front one is and nothing is coming."""
        self.preview.update(observations)
        road_heights = self.preview.heights_at(self.distances)
        obstacle_ahead = np.ptp(road_heights, axis=1).max(axis=1) > self.bump
        firm_axles = super().firm_axles(observations)
        firm_axles[:, 1] &= ~obstacle_ahead
        return firm_axles
