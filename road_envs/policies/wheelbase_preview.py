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

from road_envs.policies.api import Cabin
from road_envs.policies.body_motion import Body
from road_envs.vehicle.linear_model import linearise

LEAK = 0.2
"""Of both integrations [Hz]."""

SLOWEST = 1.0
"""At lower speeds than this [m/s] only a part of the wheelbase is remembered."""


class RoadAhead:
    """What N cars know of the road between their axles. Needs the instruments "struts".

    `wheels` (N, 4) [m]: heights under the wheels FL, FR, RL, RR at the end of the last interval.
    """

    def __init__(self, cabin: Cabin):
        car = cabin.car
        model = linearise(car, "ride", {})
        n, body = model.M.size, 3
        self.cabin, self.body, self.wheelbase = cabin, Body(cabin, LEAK), model.wheelbase
        self.inertias = model.M[:body], model.M[body:]
        self.struts = model.struts[:, :body], model.struts[:, body:]
        self.tyres = model.M[body:, None] * model.B[n + body :, :4]  # R^T k_t
        self.k_t = np.repeat([axle.k_t for axle in car.axles], 2)
        self.forces = np.linalg.pinv(self.struts[0].T)
        self.axles, self.loads = np.linalg.inv(self.struts[1]), np.linalg.inv(self.tyres)
        self.place, self.rates = np.zeros((cabin.number, body)), np.zeros((cabin.number, 4))
        self.wheels, self.speed = np.zeros((cabin.number, 4)), np.full(cabin.number, SLOWEST)
        steps = int(np.ceil(self.wheelbase / (SLOWEST * cabin.interval))) + 2
        self.past, self.now = np.zeros((steps, cabin.number, 2)), 0

    def restart(self, mask: np.ndarray) -> None:
        """Forget the cars in `mask` (N,): they stand on a level road."""
        self.body.restart(mask)
        for memory in (self.place, self.rates, self.wheels):
            memory[mask] = 0.0
        self.past[:, mask] = 0.0

    def feel(self, observations: np.ndarray) -> None:
        """Go on by one interval, from observations (N, d)."""
        cabin, before = self.cabin, self.body.v
        self.body.feel(observations)
        mean_rate = 0.5 * (before + self.body.v)
        self.place = self.body.decay * (self.place + cabin.interval * mean_rate)
        axles, rates = (
            (cabin.part(name, observations) - motion @ self.struts[0].T) @ self.axles.T
            for name, motion in (("extension", self.place), ("extension_rate", self.body.v))
        )
        accelerations, self.rates = (rates - self.rates) / cabin.interval, rates
        of_body, of_axles = self.inertias
        f = (of_body * self.body.a) @ self.forces.T
        pressed = (of_axles * accelerations - f @ self.struts[1]) @ self.loads.T
        self.wheels = axles @ self.tyres / self.k_t + pressed
        self.speed = cabin.part("speed", observations)[:, 0].astype(float)
        self.now = (self.now + 1) % len(self.past)
        self.past[self.now] = self.wheels[:, :2]

    def at(self, distances: np.ndarray) -> np.ndarray:
        """Heights (N, K, 2) [m] of the left and the right wheel path at `distances` (K,) [m] ahead
        of the rear axle, up to the wheelbase; of a car that has kept its speed.
        """
        step = np.maximum(self.speed, 1e-3)[:, None] * self.cabin.interval
        ago = np.clip((self.wheelbase - distances) / step, 0.0, len(self.past) - 2.0)
        whole = ago.astype(int)
        share, cars = (ago - whole)[:, :, None], np.arange(len(ago))[:, None]
        newer, older = (self.past[(self.now - whole - k) % len(self.past), cars] for k in (0, 1))
        return (1.0 - share) * newer + share * older
