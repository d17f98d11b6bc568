"""Running RMS with wheelbase preview: the rear axle is soft while a bump approaches.

The road under the front axle is what the rear axle meets a wheelbase later; it is estimated
causally in the loop (`wheelbase_preview.py`). Wheelbase preview with this delay: Moran & Nagai,
JSME Int. J. C 37, 1994.
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from road_envs.core.config import Positive
from road_envs.policies.api import PolicyContext
from road_envs.policies.rrms import RunningRmsPolicy
from road_envs.policies.wheelbase_preview import WheelbasePreview


@dataclass(kw_only=True)
class Preview(RunningRmsPolicy):
    """Policy as `RunningRmsPolicy`, with the rear axle in ride ahead of bumps.

    A bump is a height range of more than `bump` on either wheel path within the next `reach`. Needs
    the observation groups "planar" and "struts".
    """

    bump: Annotated[Positive, "m", "least height range of a bump"] = 0.04
    reach: Annotated[Positive, "m", "distance ahead of the rear axle"] = 2.0
    preview: WheelbasePreview = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Reset the running RMS and the preview."""
        super().reset(context)
        self.preview = WheelbasePreview(context)
        self.distances = np.linspace(0.0, min(self.reach, self.preview.wheelbase), 9)

    def firm_axles(self, observations: np.ndarray) -> np.ndarray:
        """Return which axles (N, 2) are in handling: the rear one only without a bump ahead."""
        self.preview.update(observations)
        road_heights = self.preview.heights_at(self.distances)
        obstacle_ahead = np.ptp(road_heights, axis=1).max(axis=1) > self.bump
        firm_axles = super().firm_axles(observations)
        firm_axles[:, 1] &= ~obstacle_ahead
        return firm_axles
