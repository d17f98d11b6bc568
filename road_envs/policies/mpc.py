"""Model-predictive switching: at each decision the pair of states with the least predicted cost.

Every pair of `pairs` is held over a short horizon in the linear vehicle (`linear_model.linearise`,
with equivalent dampers), from a state that `WheelbasePreview` estimates from the instruments:

    x' = A x + B u,   u = road heights and rates under the wheels, forces of the struts' held oil,
                      horizontal specific forces

The road under the rear wheels is the one that the front wheels have passed, as estimated; that
ahead of the front wheels stays as it is, the best forecast of a random walk. The specific forces go
on at their rate for the time `lead`. A closed valve holds the oil of the second accumulator: a
strut that becomes stiff at the extension e_c has the spring force -k_soft e_c - k_stiff (e - e_c).
A command acts after the valves' delay and lag; until then the present pair goes on.

The cost is that of the score: the squared acceleration of the front seats, weighted by W_k, whose
filter goes on from the measured one, and the price of the time with a strut at its stops.
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import scipy

from road_envs.analysis.comfort import wk_sos
from road_envs.core.config import NonNegative, Positive, Settings
from road_envs.envs.safety_step import SEAT
from road_envs.policies.api import PolicyContext
from road_envs.policies.fixed import Mode
from road_envs.policies.rollout import VIOLATION_PRICE
from road_envs.policies.wheelbase_preview import WheelbasePreview
from road_envs.vehicle.equations import N_DOF, PHI, THETA, build_plant
from road_envs.vehicle.linear_model import gaussian_damping, linearise, strut_forces
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import MODES

PREDICTION_STEP = 0.01  # longest step of a prediction [s]
# standard deviation of the struts' rates of extension [m/s] for the equivalent dampers: that of a
# class-D road at 54 km/h in ride [assumed]
EXTENSION_RATE = 0.15
SMALL_EXTENSION = 0.01  # extension [m] over which the rate of a strut's spring is taken


@dataclass(kw_only=True)
class ModelPredictive(Settings):
    """Policy that predicts the cost of every pair of states and takes the best one.

    Needs the observation groups "planar" and "struts".
    """

    pairs: tuple[tuple[Mode, Mode], ...] = (
        ("ride", "ride"), ("ride", "handling"), ("stiff_low", "handling"), ("handling", "handling"),
    )  # fmt: skip
    horizon: Annotated[Positive, "s", "time over which a pair is held in the prediction"] = 0.4
    lead: Annotated[NonNegative, "s", "time for which specific forces go on at their rate"] = 0.1
    margin: Annotated[Positive, "m", "distance from a stop over which its price rises"] = 0.02
    advantage: Annotated[NonNegative, "", "share of the cost by which a new pair is better"] = 0.0
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Build the models of all pairs, and start from rest in the first one."""
        self.context, self.road = context, WheelbasePreview(context)
        self.actions = np.array([context.action_index(*pair) for pair in self.pairs])
        substeps = int(np.ceil(context.interval / PREDICTION_STEP - 1e-9))
        self.dt = context.interval / substeps
        self.steps = max(1, round(self.horizon / self.dt))
        car = context.car.sliding
        self.filter = _state_space(wk_sos(1.0 / self.dt))
        models = [_pair_model(car, pair, self.filter, self.dt) for pair in self.pairs]
        # (P, S, S + 6) and (P, 14, S + 6): the next states, and the outputs
        self.by_state = np.stack([np.hstack([A.T, C]) for A, _, C, _ in models])
        self.by_input = np.stack([np.hstack([B.T, D]) for _, B, _, D in models])
        self.stiff = np.array([[MODES[mode][0] for mode in pair] for pair in self.pairs])
        self.stiff = np.repeat(self.stiff, 2, axis=1)  # (P, 4)
        self.held_rate = _spring_rates(car, "handling") - _spring_rates(car, "ride")
        self.valve_time = car.valve.delay + car.valve.lag
        self.stops, size = car.free_travel, context.n_vehicles
        self.current, self.held = np.zeros(size, dtype=int), np.zeros((size, 4))
        self.planar, self.weighted = np.zeros((size, 2)), np.zeros((size, 2, len(self.filter[0])))

    def act(self, observations: np.ndarray) -> np.ndarray:
        signal, road, n = self.context.signal, self.road, self.context.n_vehicles
        road.update(observations)
        self._update_weighting(observations)
        e, e_dot = (signal(x, observations).astype(float) for x in ("extension", "extension_rate"))
        planar = signal("planar", observations).astype(float)
        rate, self.planar = (planar - self.planar) / self.context.interval, planar
        x = [road.body_position, road.axles, road.body.v, road.axle_rates]
        state = np.concatenate([*x, self.weighted.reshape(n, -1)], axis=1)
        heights, rates = self._road_ahead()
        # oil that a strut which is stiff already, or becomes so now, holds
        stiff_now = self.stiff[self.current]
        held = np.where(stiff_now, self.held, e + self.valve_time * e_dot)
        oil, wait = self.held_rate * held, round(self.valve_time / self.dt)
        times = np.minimum(self.dt * np.arange(len(heights)), self.lead)
        forecast = planar + times[:, None, None] * rate
        u = np.concatenate([heights, rates, np.zeros_like(heights), forecast], axis=2)
        u[:wait, :, 8:12] = stiff_now * oil
        for k in range(wait):
            row = np.einsum("ni,nij->nj", state, self.by_state[self.current])
            row += np.einsum("ni,nij->nj", u[k], self.by_input[self.current])
            state = row[:, :-6]
        by_oil = (self.stiff[:, None] * oil) @ self.by_input[:, 8:12]
        pushes = u[wait:] @ self.by_input[:, None] + by_oil[:, None]  # (P, K, N, S + 6)
        rows, states = np.empty_like(pushes), state
        for k in range(self.steps):
            rows[:, k] = states @ self.by_state + pushes[:, k]
            states = rows[:, k, :, :-6]
        weighted, e = rows[..., -6:-4], rows[..., -4:]
        beyond = np.maximum(self.stops[:, 0] - e, e - self.stops[:, 1]).max(axis=3)
        used = np.maximum(1.0 + beyond / self.margin, 0.0)
        cost = (np.square(weighted).sum(axis=3) + VIOLATION_PRICE * used).sum(axis=1)
        cars, best = np.arange(n), cost.argmin(axis=0)
        better = cost[best, cars] < (1.0 - self.advantage) * cost[self.current, cars]
        self.current, self.held = np.where(better, best, self.current), held
        return self.actions[self.current]

    def _update_weighting(self, observations: np.ndarray) -> None:
        """Advance the states of W_k by the accelerations that were measured at the seats."""
        body, substeps = self.road.body, round(self.context.interval / self.dt)
        samples = self.context.accelerations(observations)[:, body.on_body]
        F, G, _, _ = self.filter
        for part in np.array_split(samples, substeps, axis=2):
            motion = part.mean(axis=2) @ body.sensors_to_motion.T
            seats = motion @ np.array([[1.0, 0.0], [0.0, SEAT[1]], [-SEAT[0], 0.0]])
            self.weighted = self.weighted @ F.T + seats[:, :, None] * G

    def _road_ahead(self) -> tuple[np.ndarray, np.ndarray]:
        """Return heights [m] and rates [m/s] (K, N, 4) under the wheels at the steps to come."""
        road, steps = self.road, round(self.valve_time / self.dt) + self.steps
        times = self.dt * np.arange(steps + 1)
        paths = road.heights_at(road.speed[:, None] * times)  # (N, K + 1, 2)
        # the estimate under the rear wheels themselves is fresher than the history: join them
        fade = np.exp(-times / 0.02)[None, :, None]
        rear = paths + fade * (road.wheel_heights[:, None, 2:] - paths[:, :1])
        front = np.broadcast_to(road.wheel_heights[:, None, :2], rear.shape)
        z = np.concatenate([front, rear], axis=2).transpose(1, 0, 2)
        return z[:-1], np.diff(z, axis=0) / self.dt


def _spring_rates(car: VehicleParameters, mode: str) -> np.ndarray:
    """Return the rates of the struts' springs (4,) [N/m] about their static length."""
    e = SMALL_EXTENSION * np.array([[-1.0, 1.0]] * 4)
    low, high = strut_forces(car, mode, e, np.zeros_like(e)).T
    return (low - high) / (2.0 * SMALL_EXTENSION)


def _state_space(sos: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return F (n, n), G (n,), H (n,) and J of second-order sections in series."""
    F, G, H, J = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    for b_0, b_1, b_2, _, a_1, a_2 in sos:
        # direct form: the section's input is the output of those before
        own = np.array([[-a_1, 1.0], [-a_2, 0.0]])
        gain = np.array([b_1 - a_1 * b_0, b_2 - a_2 * b_0])
        F = np.block([[F, np.zeros((len(G), 2))], [np.outer(gain, H), own]])
        G, H, J = np.r_[G, gain * J], np.r_[b_0 * H, 1.0, 0.0], b_0 * J
    return F, G, H, J


def _pair_model(
    car: VehicleParameters, pair: tuple[str, str], wk: tuple, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the discrete model of a pair of states with the filters of both seat accelerations: A
    (S, S), B (S, 14); outputs y = x C + u D: both weighted accelerations, whose squares sum to the
    mean square over the seats, and the four extensions.
    """
    mode = dict(zip(("front", "rear"), pair, strict=True))
    seats = {"left": SEAT, "right": (SEAT[0], -SEAT[1])}
    model = linearise(car, mode, seats, damping=gaussian_damping(car, mode, EXTENSION_RATE))
    n, plant = N_DOF, build_plant(car, manoeuvres=True).constants[0]
    forces = np.zeros((n, 6))  # of the held oil, and of the specific forces a_x and a_y
    forces[:, :4] = model.strut_rows.T
    forces[THETA, 4], forces[PHI, 5] = -plant["pitch_moment"], plant["roll_moment"]
    B = np.concatenate([model.B, np.r_[np.zeros((n, 6)), forces / model.M[:, None]]], axis=1)
    A_d, B_d, *_ = scipy.signal.cont2discrete((model.A, B, model.C, model.sensor_rows @ B[n:]), dt)
    to_seats = 0.5 * np.array([[1.0, 1.0], [1.0, -1.0]])  # their mean and half their difference
    C, D = to_seats @ model.C, to_seats @ model.sensor_rows @ B[n:]
    F, G, H, J = wk
    k, zero = len(F), np.zeros((len(F), len(F)))
    A = np.block([
        [A_d, np.zeros((2 * n, 2 * k))],
        [np.outer(G, C[0]), F, zero],
        [np.outer(G, C[1]), zero, F],
    ])  # fmt: skip
    rows = np.concatenate([B_d, np.outer(G, D[0]), np.outer(G, D[1])])
    outputs = np.zeros((6, 2 * n + 2 * k))
    outputs[:2, : 2 * n], outputs[2:, :n] = J * C, model.strut_rows
    outputs[0, 2 * n : 2 * n + k] = outputs[1, 2 * n + k :] = H
    return A, rows, outputs.T, np.concatenate([J * D, np.zeros((4, 14))]).T
