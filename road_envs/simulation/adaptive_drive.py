"""The vehicle driven by the adaptive Rosenbrock pair, compiled.

A step is `integrator.step`, the same machine code as at a constant step; the third stage of
`rosenbrock` then tells its error. With k = (k_q, k_v) and R the third stage's right-hand side, it
reduces to the seven rates as the other two do, with the same elimination of the matrix:

    (M + h d C + (h d)² K) k_3v = M R_v - h d K R_q,    k_3q = R_q + h d k_3v

df/dt is the road's second derivative, taken as a difference over half the step. Constant speed,
straight ahead, one mode: what changes during a drive is left to `simulate`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from road_envs._numba import kernel
from road_envs.roads.surface import Surface
from road_envs.simulation.drive import DriveSimulator, SimulationError, Trajectory
from road_envs.simulation.ode23s import E_32, dense_output_weights, step_size_factor
from road_envs.simulation.rosenbrock import (
    ACCELERATION,
    EXTENSION,
    LOAD,
    N_SIGNALS,
    D,
    sample_road,
    solve_factored,
    step,
    workspace,
)
from road_envs.vehicle.equations import (
    N_DOF,
    accelerations,
    add_struts,
    add_tyres,
    build_plant,
    extension,
    relative_roll,
    wheel_height,
)
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import DAMPING_HIGH, VALVE_OPEN, tyre_force

MAX_STEP = 0.01
"""Longest step [s] unless another is asked for: 150 mm of road at 54 km/h, seen three times."""


@kernel
def step_error(
    constants, velocity, displacement, strut_state, start_signals, y, road, h, work, k_3
):
    """Write the local error (14,) of the step just taken to `k_3`.

    `start_signals` (29,) are the signals at the step's beginning; `work` holds its stages, as left
    by `step`; `y` (14,) is the state at its end; `road` (24,) are the heights [m] and rates [m/s]
    under the wheels at t, t + h/2 and t + h.
    """
    p, hd = constants[0], h * D
    R_q, R_v = k_3[:N_DOF], k_3[N_DOF:]
    at_middle, at_end = np.empty(N_DOF), np.empty(N_DOF)
    laws = (constants, velocity, displacement, strut_state)
    accelerations(*laws, work.q, work.v, road[8:12], road[12:16], at_middle)
    accelerations(*laws, y[:N_DOF], y[N_DOF:], road[16:20], road[20:24], at_end)
    for j in range(N_DOF):
        k_2q, k_2v = work.k_q[j] + work.r[j] + hd * work.f[j], work.g[j] + work.f[j]
        R_q[j] = (
            y[N_DOF + j]
            - E_32 * (k_2q - work.v[j])
            - 2.0 * (work.k_q[j] - start_signals[N_DOF + j])
        )
        R_v[j] = at_end[j] - E_32 * (k_2v - at_middle[j])
        R_v[j] = p.M[j] * (R_v[j] - 2.0 * (work.g[j] - start_signals[ACCELERATION + j]))
    for w in range(4):
        work.F[w] = -hd * work.k[w] * extension(p, R_q, w)
        # what `step` kept of the tyre's change is by the road and the wheel; df/dt is the road's
        work.T[w] = work.dT[w] + hd * work.k_t[w] * wheel_height(p, start_signals[N_DOF:], w)
        work.T[w] -= hd * work.k_t[w] * wheel_height(p, R_q, w)
    add_struts(p, work.F, hd * relative_roll(R_q, 0), hd * relative_roll(R_q, 1), R_v)
    add_tyres(p, work.T, R_v)
    solve_factored(p, work.blocks, work.body, R_v)
    for j in range(N_DOF):
        k_2q, k_2v = work.k_q[j] + work.r[j] + hd * work.f[j], work.g[j] + work.f[j]
        R_q[j] = h / 6.0 * (work.k_q[j] - 2.0 * k_2q + R_q[j] + hd * R_v[j])
        R_v[j] = h / 6.0 * (work.g[j] - 2.0 * k_2v + R_v[j])


@kernel
def dense_output(start_signals, work, h, x, y):
    """The state (14,) at the share `x` of the step just taken, written to `y`."""
    b_1, b_2 = dense_output_weights(x)
    for j in range(N_DOF):
        k_2q, k_2v = work.k_q[j] + work.r[j] + h * D * work.f[j], work.g[j] + work.f[j]
        y[j] = start_signals[j] + h * (b_1 * work.k_q[j] + b_2 * k_2q)
        y[N_DOF + j] = start_signals[N_DOF + j] + h * (b_1 * work.g[j] + b_2 * k_2v)


@kernel
def write_signals(constants, velocity, displacement, strut_state, y, road, out):
    """Write the signals (29,) of the state `y` (14,) over the road (8,) to `out`."""
    p, q, v = constants[0], y[:N_DOF], y[N_DOF:]
    motion = out[ACCELERATION : ACCELERATION + N_DOF]
    accelerations(constants, velocity, displacement, strut_state, q, v, road[:4], road[4:8], motion)
    for j in range(2 * N_DOF):
        out[j] = y[j]
    for w in range(4):
        u, u_dot = road[w] - wheel_height(p, q, w), road[4 + w] - wheel_height(p, v, w)
        out[EXTENSION + w] = extension(p, q, w)
        out[LOAD + w] = tyre_force(p, w, u, u_dot)[0]


@kernel
def adaptive_kernel(
    constants, velocity, displacement, strut_state, y,
    padded, start, ds, s_0, v, t, tolerance, out,
):  # fmt: skip
    """Drive from time 0 and station `s_0` [m] at `v` [m/s] to the last of the times `t` (N,) [s].

    `y` (14,) ends as the state at the end of the last step; `padded`, `start`, `ds`: a Surface.
    `tolerance` holds rtol, atol and the longest step [s]. `out` (N, 29): the signals at the times.
    Returns the steps taken, those tried in vain, and the time reached: short of the end if no step
    met the tolerance.
    """
    p, work, road, no_manoeuvre = constants[0], workspace(), np.empty(24), np.zeros(4)
    start_signals, error, y_dense = np.empty(N_SIGNALS), np.empty(2 * N_DOF), np.empty(2 * N_DOF)
    laws = (constants, velocity, displacement, strut_state)
    q, rates = y[:N_DOF], y[N_DOF:]
    rtol, atol, max_step = tolerance
    now, h, n_accepted, n_rejected, i = 0.0, max_step, 0, 0, 0
    while i < t.size and h > 1e-12:
        for k in range(3):
            s = s_0 + v * (now + 0.5 * k * h)
            sample_road(p, padded, start, ds, s, v, road[8 * k : 8 * k + 8])
        step(
            p,
            velocity,
            displacement,
            strut_state,
            q,
            rates,
            road[:16],
            no_manoeuvre,
            h,
            work,
            start_signals,
        )
        step_error(*laws, start_signals, y, road, h, work, error)
        max_ratio = 0.0
        for j in range(2 * N_DOF):
            ratio = abs(error[j]) / (atol + rtol * max(abs(start_signals[j]), abs(y[j])))
            if ratio > max_ratio or ratio != ratio:  # a NaN stays
                max_ratio = ratio
        if not max_ratio <= 1.0:
            y[:] = start_signals[: 2 * N_DOF]
            n_rejected += 1
            h *= step_size_factor(max_ratio)
            continue
        while i < t.size and t[i] <= now + h:
            dense_output(start_signals, work, h, (t[i] - now) / h, y_dense)
            sample_road(p, padded, start, ds, s_0 + v * t[i], v, road[:8])
            write_signals(*laws, y_dense, road[:8], out[i])
            i += 1
        n_accepted += 1
        now += h
        h = min(h * step_size_factor(max_ratio), max_step)
    return n_accepted, n_rejected, now


@dataclass(frozen=True)
class AdaptiveResult:
    """A drive at the wanted times, and the steps it took: those accepted, those tried in vain."""

    trajectory: Trajectory
    steps: int
    rejections: int


def integrate_adaptive(
    simulator: DriveSimulator,
    t: np.ndarray,
    rtol: float = 1e-3,
    atol: float = 1e-6,
    max_step: float = MAX_STEP,
) -> AdaptiveResult:
    """Where a drive at constant speed, not yet begun, is at the times `t` (N,) [s], ascending.

    The drive itself does not move on. Raises ValueError on bad input, SimulationError if no step
    meets the tolerance.
    """
    if simulator.steps > 0 or simulator.manoeuvre is not None or len(simulator.speed_profile.v) > 1:
        raise ValueError("an adaptive drive starts at its beginning, straight on at one speed")
    if simulator.plant.flexible:
        raise ValueError("a car with a flexible frame is driven in fixed steps, not adaptive ones")
    if not (rtol > 0 and atol > 0 and max_step > 0):
        raise ValueError("tolerances and the longest step must be positive")
    t = np.array(t, dtype=float)
    if not ((t >= 0.0).all() and (np.diff(t) > 0).all()):
        raise ValueError("times must ascend from 0")
    signals, tolerance = np.empty((t.size, N_SIGNALS)), np.array([rtol, atol, max_step])
    surface, start, speed = simulator.surface, simulator.start, simulator.speed
    road = (surface.padded, surface.start, surface.ds, start, speed)
    strut_state, state = simulator.strut_state.copy(), simulator.state.copy()
    laws = (*simulator.plant.arrays, strut_state)
    n_accepted, n_rejected, t_end = adaptive_kernel(*laws, state, *road, t, tolerance, signals)
    if t.size and t_end < t[-1]:
        raise SimulationError(f"{surface.name}: no step meets the tolerance at {t_end:.6f} s")
    s, v = start + speed * t, np.full(t.size, speed)
    stiff_wheels = strut_state[:, VALVE_OPEN] == 0.0
    wheels = zip(stiff_wheels, strut_state[:, DAMPING_HIGH] == 1.0, strict=True)
    byte = sum((int(stiff) << w) | (int(high) << (4 + w)) for w, (stiff, high) in enumerate(wheels))
    commands = np.full(t.size, byte, dtype=np.uint8)
    return AdaptiveResult(Trajectory(t, s, v, commands, signals), n_accepted, n_rejected)


def simulate_adaptive(
    car: VehicleParameters,
    surface: Surface,
    speed: float,
    mode: str | Mapping[str, str] = "ride",
    rtol: float = 1e-3,
    atol: float = 1e-6,
    step: float = 0.001,
    max_step: float = MAX_STEP,
) -> AdaptiveResult:
    """Drive `car` over the whole `surface` at `speed` [m/s] in one 4S4 mode, with error control.

    `step` [s] separates the instants of the trajectory, not the integrator's steps, none of which
    is longer than `max_step` [s]: a long step can miss a bump. Raises ConfigError on bad input,
    SimulationError if no step meets the tolerance.
    """
    simulator = DriveSimulator(build_plant(car), car, surface, speed, mode, step)
    t = step * np.arange(simulator.steps_left)
    return integrate_adaptive(simulator, t, rtol, atol, max_step)
