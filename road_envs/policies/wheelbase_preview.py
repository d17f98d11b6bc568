"""Causal estimate of the road ahead of the rear axle, from the motion of the front axle.

Body accelerations and strut extensions determine the positions of the axles and the forces on them
without a model of springs and dampers. The estimate therefore holds in every state of the
suspension and while it switches. With q_b heave, roll and pitch of the body, q_a heave and roll of
both axles, and e the strut extensions:

    q_b'' from the accelerometers, q_b' and q_b by leaky integration
    e = S_b q_b + S_a q_a                    gives q_a, and q_a'' from e'
    M_b q_b'' = S_b^T f                      gives the strut forces f of least norm
    M_a q_a'' = S_a^T f + R^T k_t (z - R q_a)    gives the heights z under the wheels

Lever arms and masses are those of `linear_model.linearise`. Neglected are the tyre damping, wheels
off the ground, and the slow load transfer in turns. Heights below the corner of the integrators
are not determined: only differences of heights are meaningful.
"""

import numpy as np

from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator
from road_envs.vehicle.linear_model import linearise

LEAK = 0.2  # corner of both leaky integrators [Hz]
MIN_SPEED = 1.0  # [m/s] from which on the history covers the wheelbase


class WheelbasePreview:
    """Estimator of the road between the axles of N vehicles.

    `wheel_heights` (N, 4) [m] are the heights under the wheels FL, FR, RL, RR at the end of the
    last interval; `body_position` (N, 3), `axles` and `axle_rates` (N, 4) heave, roll and pitch of
    the body, and heave and roll of both axles and their rates. Needs the group "struts".
    """

    def __init__(self, context: PolicyContext):
        car, size = context.car, context.n_vehicles
        model = linearise(car.sliding, "ride", {})  # levers and masses do not depend on the mode
        n, body = model.M.size, 3
        self.context, self.body = context, BodyMotionEstimator(context, LEAK)
        self.wheelbase = model.wheelbase
        self.inertias = model.M[:body], model.M[body:]
        self.strut_rows = model.strut_rows[:, :body], model.strut_rows[:, body:]  # S_b, S_a
        self.tyre_stiffness = model.M[body:, None] * model.B[n + body :, :4]  # R^T k_t
        self.k_t = np.repeat([axle.k_t for axle in car.axles], 2)
        self.body_to_struts = np.linalg.pinv(self.strut_rows[0].T)
        self.struts_to_axles = np.linalg.inv(self.strut_rows[1])
        self.axles_to_tyres = np.linalg.inv(self.tyre_stiffness)
        self.body_position = np.zeros((size, body))
        self.axles, self.axle_rates = np.zeros((2, size, 4))
        self.wheel_heights, self.speed = np.zeros((size, 4)), np.full(size, MIN_SPEED)
        steps = int(np.ceil(self.wheelbase / (MIN_SPEED * context.interval))) + 2
        self.history, self.newest = np.zeros((steps, size, 2)), 0

    def update(self, observations: np.ndarray) -> None:
        context, dt, before = self.context, self.context.interval, self.body.v
        self.body.update(observations)
        mean_rate = 0.5 * (before + self.body.v)
        self.body_position = self.body.decay * (self.body_position + dt * mean_rate)
        S_b, S_a = self.strut_rows
        e, e_dot = (context.signal(x, observations) for x in ("extension", "extension_rate"))
        self.axles = (e - self.body_position @ S_b.T) @ self.struts_to_axles.T
        rates = (e_dot - self.body.v @ S_b.T) @ self.struts_to_axles.T
        accelerations, self.axle_rates = (rates - self.axle_rates) / dt, rates
        body_inertia, axle_inertia = self.inertias
        f = (body_inertia * self.body.a) @ self.body_to_struts.T
        tyre_compression = (axle_inertia * accelerations - f @ S_a) @ self.axles_to_tyres.T
        self.wheel_heights = self.axles @ self.tyre_stiffness / self.k_t + tyre_compression
        self.speed = context.signal("speed", observations)[:, 0].astype(float)
        self.newest = (self.newest + 1) % len(self.history)
        self.history[self.newest] = self.wheel_heights[:, :2]

    def heights_at(self, distances: np.ndarray) -> np.ndarray:
        """Return heights (N, K, 2) [m] of both wheel paths at `distances` (K,) or (N, K) [m] ahead
        of the rear axle, up to the wheelbase, for vehicles at constant speed.
        """
        step = np.maximum(self.speed, 1e-3)[:, None] * self.context.interval
        ago = np.clip((self.wheelbase - distances) / step, 0.0, len(self.history) - 2.0)
        whole = ago.astype(int)
        share, cars = (ago - whole)[:, :, None], np.arange(len(ago))[:, None]
        at = (self.newest - whole) % len(self.history)  # row of the ring; one earlier is the older
        return (1.0 - share) * self.history[at, cars] + share * self.history[at - 1, cars]
