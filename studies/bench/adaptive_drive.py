"""Simulation of the vehicle with error control: `ode23s`, the integrator of the paper.

A Rosenbrock pair of orders 2 and 3, after Shampine & Reichelt (1997), "The MATLAB ODE suite", SIAM
J. Sci. Comput. 18, section 3.1, doi 10.1137/S1064827594276424. A step is `rosenbrock.step`, the
same code as at a constant step, from F_0 to y_1 by the stages k_1 and k_2; F_1 is the rate at the
second. The third stage,

    W k_3 = R = F(t + h, y_1) - e_32 (k_2 - F_1) - 2 (k_1 - F_0) + h d df/dt,    e_32 = 6 + sqrt 2

gives the difference to a formula of order 3, h (k_1 - 2 k_2 + k_3) / 6, which is the estimate of
the error. With k = (k_q, k_v) it reduces to the seven rates like the other two stages, with the
same factorization:

    (M + h d C + (h d)² K) k_3v = M R_v - h d K R_q,    k_3q = R_q + h d k_3v

Within a step the motion is the quadratic of the same source (its section on free interpolants),

    y(t + x h) = y + h (x (1 - x) k_1 + x (x - 2 d) k_2) / (1 - 2 d),   0 <= x <= 1

df/dt needs the road's second derivative, a finite difference over half the step. Only drives
straight ahead, at constant speed and in one mode are supported; use `drive` for all others.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd_arrays import stack_array
from road_envs.roads.surface import Surface
from road_envs.simulation.block_elimination import solve_factored
from road_envs.simulation.drive import DriveSimulator, SimulationError, Trajectory
from road_envs.simulation.rosenbrock import (
    ACCELERATION,
    EXTENSION,
    LOAD,
    N_SIGNALS,
    WORKSPACE_ROWS,
    D,
    StepInputs,
    sample_road,
    step,
    step_workspace,
)
from road_envs.vehicle.equations import (
    N_DOF,
    Motion,
    accelerations,
    add_struts,
    add_tyres,
    build_plant,
    extension,
    relative_roll,
    wheel_height,
)
from road_envs.vehicle.parameters import DEFAULT_STEP, VehicleParameters
from road_envs.vehicle.suspension import DAMPING_HIGH, VALVE_OPEN
from road_envs.vehicle.tyres import tyre_force

E_32 = 6.0 + np.sqrt(2.0)

MAX_STEP = 0.01
"""Default longest step [s]: 150 mm of road at 54 km/h, sampled at three points."""


@kernel(count_references=False)
def state_rate(vehicle, surface, s, v, y, out):
    """Write the rate (14,) of the state `y` with the front axle at station `s` [m] to `out`.

    This is the right-hand side for other integrators; the strut state stays constant. Of a
    flexible vehicle `y` and `out` are (16,).
    """
    road, n = stack_array(8), y.size // 2
    sample_road(vehicle.constants[0], surface, s, v, road)
    for i in range(n):  # Numba 0.61 counts references in the assignment of a slice
        out[i] = y[n + i]
    accelerations(vehicle, Motion(y[:n], y[n:]), road[:4], road[4:], out[n:])


@kernel
def step_size_factor(error):
    """Return the factor from this step to the next, for an `error` in units of the tolerance.

    The error is of order h³, hence the cube root. 0.8 is a safety factor, and the result is limited
    to 0.2 ... 5. A NaN gives the smallest factor.
    """
    if error > 0.0:
        return min(max(0.8 * error ** (-1.0 / 3.0), 0.2), 5.0)
    return 5.0 if error == 0.0 else 0.2


@kernel
def step_error(vehicle, signals_0, y, road, h, work, k_3):
    """Write the local error (14,) of the step just taken to `k_3`.

    `signals_0` (29,) are the signals at the step's beginning; `work` holds its stages, as left
    by `step`; `y` (14,) is the state at its end; `road` (24,) are the heights [m] and rates [m/s]
    under the wheels at t, t + h/2 and t + h.
    """
    p, hd = vehicle.constants[0], h * D
    R_q, R_v = k_3[:N_DOF], k_3[N_DOF:]
    at_middle, at_end = np.empty(N_DOF), np.empty(N_DOF)
    accelerations(vehicle, Motion(work.q, work.v), road[8:12], road[12:16], at_middle)
    accelerations(vehicle, Motion(y[:N_DOF], y[N_DOF:]), road[16:20], road[20:24], at_end)
    for j in range(N_DOF):
        k_2q, k_2v = work.k_q[j] + work.r[j] + hd * work.f[j], work.g[j] + work.f[j]
        R_q[j] = (
            y[N_DOF + j] - E_32 * (k_2q - work.v[j]) - 2.0 * (work.k_q[j] - signals_0[N_DOF + j])
        )
        R_v[j] = at_end[j] - E_32 * (k_2v - at_middle[j])
        R_v[j] = p.M[j] * (R_v[j] - 2.0 * (work.g[j] - signals_0[ACCELERATION + j]))
    for w in range(4):
        work.F[w] = -hd * work.k[w] * extension(p, R_q, w)
        # dT of `step` is due to the road and the wheel; df/dt has the road's part only
        work.T[w] = work.dT[w] + hd * work.k_t[w] * wheel_height(p, signals_0[N_DOF:], w)
        work.T[w] -= hd * work.k_t[w] * wheel_height(p, R_q, w)
    add_struts(p, work.F, hd * relative_roll(R_q, 0), hd * relative_roll(R_q, 1), R_v)
    add_tyres(p, work.T, R_v)
    solve_factored(p, work.blocks, work.body, R_v)
    for j in range(N_DOF):
        k_2q, k_2v = work.k_q[j] + work.r[j] + hd * work.f[j], work.g[j] + work.f[j]
        R_q[j] = h / 6.0 * (work.k_q[j] - 2.0 * k_2q + R_q[j] + hd * R_v[j])
        R_v[j] = h / 6.0 * (work.g[j] - 2.0 * k_2v + R_v[j])


@kernel
def dense_output(signals_0, work, h, x, y):
    """Write the state (14,) at the fraction `x` of the step just taken to `y`."""
    b_1, b_2 = x * (1.0 - x) / (1.0 - 2.0 * D), x * (x - 2.0 * D) / (1.0 - 2.0 * D)
    for j in range(N_DOF):
        k_2q, k_2v = work.k_q[j] + work.r[j] + h * D * work.f[j], work.g[j] + work.f[j]
        y[j] = signals_0[j] + h * (b_1 * work.k_q[j] + b_2 * k_2q)
        y[N_DOF + j] = signals_0[N_DOF + j] + h * (b_1 * work.g[j] + b_2 * k_2v)


@kernel
def write_signals(vehicle, y, road, out):
    """Write the signals (29,) of the state `y` (14,) over the road (8,) to `out`."""
    p, q, v = vehicle.constants[0], y[:N_DOF], y[N_DOF:]
    a = out[ACCELERATION : ACCELERATION + N_DOF]
    accelerations(vehicle, Motion(q, v), road[:4], road[4:8], a)
    for j in range(2 * N_DOF):
        out[j] = y[j]
    for w in range(4):
        u, u_dot = road[w] - wheel_height(p, q, w), road[4 + w] - wheel_height(p, v, w)
        out[EXTENSION + w] = extension(p, q, w)
        out[LOAD + w] = tyre_force(p, w, u, u_dot)[0]


class AdaptiveInputs(NamedTuple):
    """A drive from t = 0 at station `s_0` [m] and speed `v` [m/s] to the last of `t` (N,) [s].

    The tolerance is `rtol`, `atol` and the longest step `max_step` [s].
    """

    s_0: float
    v: float
    t: np.ndarray
    rtol: float
    atol: float
    max_step: float


@kernel
def adaptive_kernel(vehicle, y, surface, inputs, out):
    """Integrate the drive of AdaptiveInputs over SurfaceBuffers; `y` (14,) is advanced in place.

    The signals at the times `t` go to `out` (N, 29). Returns the numbers of accepted and of
    rejected steps, and the time reached, which is before the end if no step meets the tolerance.
    """
    p, work = vehicle.constants[0], step_workspace(stack_array(WORKSPACE_ROWS))
    road, a_xy = np.empty(24), np.zeros(4)
    signals_0, error, y_dense = np.empty(N_SIGNALS), np.empty(2 * N_DOF), np.empty(2 * N_DOF)
    motion = Motion(y[:N_DOF], y[N_DOF:])
    s_0, v, t, rtol, atol, max_step = inputs
    now, h, n_accepted, n_rejected, i = 0.0, max_step, 0, 0, 0
    while i < t.size and h > 1e-12:
        for k in range(3):
            s = s_0 + v * (now + 0.5 * k * h)
            sample_road(p, surface, s, v, road[8 * k : 8 * k + 8])
        step(vehicle, motion, StepInputs(road[:16], a_xy, h, v), work, signals_0)
        step_error(vehicle, signals_0, y, road, h, work, error)
        max_ratio = 0.0
        for j in range(2 * N_DOF):
            ratio = abs(error[j]) / (atol + rtol * max(abs(signals_0[j]), abs(y[j])))
            if ratio > max_ratio or ratio != ratio:  # a NaN must reject the step
                max_ratio = ratio
        if not max_ratio <= 1.0:
            for j in range(2 * N_DOF):  # a slice would compile the error of unequal lengths
                y[j] = signals_0[j]
            n_rejected += 1
            h *= step_size_factor(max_ratio)
            continue
        while i < t.size and t[i] <= now + h:
            dense_output(signals_0, work, h, (t[i] - now) / h, y_dense)
            sample_road(p, surface, s_0 + v * t[i], v, road[:8])
            write_signals(vehicle, y_dense, road[:8], out[i])
            i += 1
        n_accepted += 1
        now += h
        h = min(h * step_size_factor(max_ratio), max_step)
    return n_accepted, n_rejected, now


@dataclass(frozen=True)
class AdaptiveResult:
    """A drive at the requested times, with the numbers of accepted and of rejected steps."""

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
    """Simulate a drive at constant speed up to the ascending times `t` (N,) [s].

    `simulator` must not have been advanced and is left unchanged. Raises ValueError on bad input,
    SimulationError if no step meets the tolerance.
    """
    at_start = simulator.steps == 0 and simulator.manoeuvre is None
    if not (at_start and simulator.speed_profile.is_constant):
        raise ValueError(
            "the simulator must be at its start, without a manoeuvre and at one speed; use "
            "DriveSimulator.advance for other drives"
        )
    if simulator.plant.kernel_flags:
        raise ValueError(
            "adaptive steps support neither a flexible frame nor side motion; use "
            "DriveSimulator.advance"
        )
    if not (rtol > 0 and atol > 0 and max_step > 0):
        raise ValueError(
            f"rtol, atol and max_step must be positive, got {rtol}, {atol} and {max_step}"
        )
    t = np.array(t, dtype=float)
    if not ((t >= 0.0).all() and (np.diff(t) > 0).all()):
        raise ValueError("times t must be ascending and not negative")
    surface, start, speed = simulator.surface, simulator.start, simulator.speed
    inputs = AdaptiveInputs(start, speed, t, float(rtol), float(atol), float(max_step))
    strut_state, signals = simulator.strut_state.copy(), np.empty((t.size, N_SIGNALS))
    vehicle, state = simulator.plant.buffers(strut_state), simulator.state.copy()
    n_accepted, n_rejected, t_end = adaptive_kernel(
        vehicle, state, surface.buffers, inputs, signals
    )
    if t.size and t_end < t[-1]:
        raise SimulationError(
            f"{surface.name}: no step meets the tolerance at {t_end:.6f} s; loosen rtol and atol"
        )
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
    mode: str | Mapping[str, str] | None = None,
    *,
    rtol: float = 1e-3,
    atol: float = 1e-6,
    step: float = DEFAULT_STEP,
    max_step: float = MAX_STEP,
) -> AdaptiveResult:
    """Simulate `car` over the whole `surface` at `speed` [m/s] in one mode, with error control.

    `step` [s] is the sample time of the trajectory. The integrator chooses its own steps, none
    longer than `max_step` [s], since a long step can miss a bump. Raises ConfigError on bad input,
    SimulationError if no step meets the tolerance.
    """
    simulator = DriveSimulator(build_plant(car), car, surface, speed, mode, step)
    t = step * np.arange(simulator.steps_left)
    return integrate_adaptive(simulator, t, rtol, atol, max_step)
