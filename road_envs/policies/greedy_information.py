"""Sensing: the pair of states that will have told most of the road, at a price in comfort.

In the linear model neither what is left unknown of the road nor the expected comfort depends on
what is measured, so both are closed forms of the states and the speed, and the best pair is found
before anything has happened: a greedy policy is an optimal one as long as the speed stays. This is
why it does not switch.
"""

from dataclasses import dataclass, field

import numpy as np

from road_envs.analysis.comfort import wk
from road_envs.analysis.information_bound import BoundTable, RoadPrior, equivalent_damping
from road_envs.config import STRICT
from road_envs.policies.api import PolicyContext
from road_envs.vehicle.linear_model import frequency_response, linearise
from road_envs.vehicle.parameters import VehicleParameters

FREQUENCIES = np.geomspace(0.2, 50.0, 400)
"""Frequencies [Hz] over which the comfort is added up."""


@dataclass(kw_only=True)
class GreedyInformation:
    """Minimises expected comfort [m/s²] + `weight` x the variance left unknown, of 1, for a road of
    class D and the speed as it is first measured.
    """

    __pydantic_config__ = STRICT

    weight: float = 100.0
    context: PolicyContext = field(init=False, repr=False, compare=False)
    best_actions: dict[tuple, int] = field(
        init=False, repr=False, compare=False, default_factory=dict
    )

    def __post_init__(self):
        if not self.weight >= 0:
            raise ValueError(f"weight must not be negative, got {self.weight}")

    def reset(self, context: PolicyContext) -> None:
        """Choose anew at the next observation."""
        self.context = context
        self.actions = np.zeros(0, dtype=int)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """The pair chosen at the first observation."""
        if self.actions.size == 0:
            measured = self.context.signal("speed", observations)[:, 0]
            speeds, which = np.unique(np.round(measured), return_inverse=True)
            self.actions = np.array([self.best_action(max(float(v), 1.0)) for v in speeds])[which]
        return self.actions

    def best_action(self, v: float) -> int:
        """The action of least cost at `v` [m/s]; kept, for it takes a second to find."""
        key = (v, self.context.actions, repr(self.context.car), repr(self.context.instruments))
        if key not in self.best_actions:
            self.best_actions[key] = int(np.argmin(self.action_costs(v)))
        return self.best_actions[key]

    def action_costs(self, v: float) -> np.ndarray:
        """The cost of every action at `v` [m/s]."""
        car, prior, context = self.context.car, RoadPrior(), self.context
        modes = tuple(dict.fromkeys(mode for pair in context.actions for mode in pair))
        table = BoundTable.tabulate(car, context.instruments, prior, [v], modes)
        return np.array(
            [
                expected_comfort(car, front, rear, v, prior)
                + self.weight * table.interpolate(front, rear, v) ** 2
                for front, rear in context.actions
            ]
        )


def expected_comfort(
    car: VehicleParameters, front: str, rear: str, v: float, prior: RoadPrior
) -> float:
    """W_k-weighted RMS heave acceleration [m/s²] of the linear car at `v` [m/s] on such a road."""
    mode = {"front": front, "rear": rear}
    model = linearise(
        car, mode, {"heave": (0.0, 0.0)}, damping=equivalent_damping(car, mode, v, prior)
    )
    H = frequency_response(model, v, f=FREQUENCIES)
    density = np.real(np.einsum("fsa,fab,fsb->f", H, prior.spectrum(FREQUENCIES / v) / v, H.conj()))
    return float(np.sqrt(np.trapezoid(wk(FREQUENCIES) ** 2 * density, FREQUENCIES)))
