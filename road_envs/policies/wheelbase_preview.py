"""The road ahead of the rear axle, as the front axle has felt it: a causal estimate, interval by
interval, for policies that look ahead by a wheelbase.

Accelerometers on the body and the struts' instruments together tell where the axles are and what
presses on them, whatever the springs and dampers do, so the estimate holds in every state of the
suspension and through every switch. With q_b heave, roll, pitch of the body, q_a heave and roll of
both axles, e the struts' extensions:

    q_b'' from the accelerometers, q_b' and q_b by leaky integration
    e = S_b q_b + S_a q_a                    the axles' places, and their accelerations from e'
    M_b q_b'' = S_b^T f                      the struts' forces f, the least that do it
    M_a q_a'' = S_a^T f + R^T k_t (z - R q_a)    the heights z under the wheels

Levers and masses are those of `linear.linearise`. What is left out: the tyres' damping, wheels in
the air, and in a turn the load that the body's inertia shifts, which is slow. Below the leak
nothing is known: heights are told from one another, not from a datum.
"""

import numpy as np

from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator
from road_envs.vehicle.linear_model import linearise

LEAK = 0.2
"""Of both integrations [Hz]."""

MIN_SPEED = 1.0
"""At lower speeds than this [m/s] only a part of the wheelbase is remembered."""


class WheelbasePreview:
    """What N cars know of the road between their axles. Needs the instruments "struts".

    `wheel_heights` (N, 4) [m]: heights under the wheels FL, FR, RL, RR at the end of the last
    interval.
    """

    def __init__(self, context: PolicyContext):
        car = context.car
        model = linearise(car, "ride", {})
        n, body = model.M.size, 3
        self.context, self.body, self.wheelbase = (
            context,
            BodyMotionEstimator(context, LEAK),
            model.wheelbase,
        )
        self.inertias = model.M[:body], model.M[body:]
        self.struts = model.strut_rows[:, :body], model.strut_rows[:, body:]
        self.tyres = model.M[body:, None] * model.B[n + body :, :4]  # R^T k_t
        self.k_t = np.repeat([axle.k_t for axle in car.axles], 2)
        self.forces = np.linalg.pinv(self.struts[0].T)
        self.axles, self.loads = np.linalg.inv(self.struts[1]), np.linalg.inv(self.tyres)
        self.body_position, self.extension_rates = (
            np.zeros((context.n_vehicles, body)),
            np.zeros((context.n_vehicles, 4)),
        )
        self.wheel_heights, self.speed = (
            np.zeros((context.n_vehicles, 4)),
            np.full(context.n_vehicles, MIN_SPEED),
        )
        steps = int(np.ceil(self.wheelbase / (MIN_SPEED * context.interval))) + 2
        self.history, self.newest = np.zeros((steps, context.n_vehicles, 2)), 0

    def reset(self, mask: np.ndarray) -> None:
        """Forget the cars in `mask` (N,): they stand on a level road."""
        self.body.reset(mask)
        for memory in (self.body_position, self.extension_rates, self.wheel_heights):
            memory[mask] = 0.0
        self.history[:, mask] = 0.0

    def update(self, observations: np.ndarray) -> None:
        """Go on by one interval, from observations (N, d)."""
        context, before = self.context, self.body.v
        self.body.update(observations)
        mean_rate = 0.5 * (before + self.body.v)
        self.body_position = self.body.decay * (self.body_position + context.interval * mean_rate)
        axles, rates = (
            (context.signal(name, observations) - motion @ self.struts[0].T) @ self.axles.T
            for name, motion in (("extension", self.body_position), ("extension_rate", self.body.v))
        )
        accelerations, self.extension_rates = (
            (rates - self.extension_rates) / context.interval,
            rates,
        )
        body_inertia, axle_inertia = self.inertias
        f = (body_inertia * self.body.a) @ self.forces.T
        tyre_compression = (axle_inertia * accelerations - f @ self.struts[1]) @ self.loads.T
        self.wheel_heights = axles @ self.tyres / self.k_t + tyre_compression
        self.speed = context.signal("speed", observations)[:, 0].astype(float)
        self.newest = (self.newest + 1) % len(self.history)
        self.history[self.newest] = self.wheel_heights[:, :2]

    def heights_at(self, distances: np.ndarray) -> np.ndarray:
        """Heights (N, K, 2) [m] of the left and the right wheel path at `distances` (K,) [m] ahead
        of the rear axle, up to the wheelbase; of a car that has kept its speed.
        """
        step = np.maximum(self.speed, 1e-3)[:, None] * self.context.interval
        ago = np.clip((self.wheelbase - distances) / step, 0.0, len(self.history) - 2.0)
        whole = ago.astype(int)
        share, cars = (ago - whole)[:, :, None], np.arange(len(ago))[:, None]
        newer, older = (
            self.history[(self.newest - whole - k) % len(self.history), cars] for k in (0, 1)
        )
        return (1.0 - share) * newer + share * older
