"""Sensing policy: the constant pair of states with the best trade-off of comfort and information.

In the linear model the unresolved variance of the road and the expected comfort do not depend on
the measurements. Both are closed forms of states and speed, and the best pair can be computed in
advance. At constant speed the greedy policy is therefore optimal, and it does not switch.
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from road_envs.analysis.comfort import wk
from road_envs.analysis.information_bound import BoundTable, RoadPrior, equivalent_damping
from road_envs.core.config import NonNegative, Settings
from road_envs.policies.api import PolicyContext
from road_envs.vehicle.linear_model import frequency_response, linearise
from road_envs.vehicle.parameters import VehicleParameters

FREQUENCIES = np.geomspace(0.2, 50.0, 400)  # [Hz] over which the acceleration is integrated


@dataclass(kw_only=True)
class GreedyInformation(Settings):
    """Policy that minimises expected comfort [m/s²] + `weight` x unresolved share of variance.

    The costs are those of a class-D road at the first measured speed.
    """

    weight: Annotated[NonNegative, "m/s²", "of the unresolved share of variance"] = 100.0
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Discard the choice; the next observation determines a new one."""
        self.context, self.actions = context, np.zeros(0, dtype=int)

    def act(self, observations: np.ndarray) -> np.ndarray:
        if self.actions.size == 0:
            measured = self.context.signal("speed", observations)[:, 0]
            speeds, which = np.unique(np.round(measured), return_inverse=True)
            costs = [self.action_costs(max(float(v), 1.0)) for v in speeds]
            self.actions = np.argmin(costs, axis=1)[which]
        return self.actions

    def action_costs(self, v: float) -> np.ndarray:
        """Return the cost of every action at `v` [m/s]."""
        car, prior, context = self.context.car, RoadPrior(), self.context
        modes = tuple(dict.fromkeys(mode for pair in context.actions for mode in pair))
        table = BoundTable.tabulate(car, context.instruments, prior, [v], modes)
        return np.array(
            [
                _expected_comfort(car, front, rear, v, prior)
                + self.weight * table.interpolate(front, rear, v) ** 2
                for front, rear in context.actions
            ]
        )


def _expected_comfort(
    car: VehicleParameters, front: str, rear: str, v: float, prior: RoadPrior
) -> float:
    """Return the W_k-weighted RMS heave acceleration [m/s²] of the linear vehicle at `v` [m/s]."""
    mode = {"front": front, "rear": rear}
    damping = equivalent_damping(car, mode, v, prior)
    model = linearise(car, mode, {"heave": (0.0, 0.0)}, damping=damping, speed=v)
    H = frequency_response(model, v, f=FREQUENCIES)
    density = np.real(np.einsum("fsa,fab,fsb->f", H, prior.spectrum(FREQUENCIES / v) / v, H.conj()))
    return float(np.sqrt(np.trapezoid(wk(FREQUENCIES) ** 2 * density, FREQUENCIES)))
