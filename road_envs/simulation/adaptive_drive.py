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
from road_envs.simulation.drive import Drive, SimulationError, Trajectory
from road_envs.simulation.ode23s import E_32, blend, resize
from road_envs.simulation.rosenbrock import (
    ACCELERATION,
    EXTENSION,
    LOAD,
    SIGNALS,
    D,
    look_at_road,
    solve,
    step,
    workspace,
)
from road_envs.vehicle.equations import (
    N_DOF,
    accelerations,
    add_struts,
    add_tyres,
    extension,
    plant,
    roll_over,
    wheel_height,
)
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import HIGH, OPEN, tyre_force

LONGEST = 0.01
"""Longest step [s] unless another is asked for: 150 mm of road at 54 km/h, seen three times."""


@kernel
def step_error(numbers, velocity, displacement, memory, before, y, road, h, work, k_3):
    """Distance (14,) of the step just taken to the formula of order 3, written to `k_3`.

    `before` (29,) are the signals at its beginning and `work` its stages, as `step` left them; `y`
    (14,) is the state at its end; `road` (24,) what lay under the wheels at t, t + h/2 and t + h.
    """
    p, hd = numbers[0], h * D
    R_q, R_v = k_3[:N_DOF], k_3[N_DOF:]
    at_middle, at_end = np.empty(N_DOF), np.empty(N_DOF)
    laws = (numbers, velocity, displacement, memory)
    accelerations(*laws, work.q, work.v, road[8:12], road[12:16], at_middle)
    accelerations(*laws, y[:N_DOF], y[N_DOF:], road[16:20], road[20:24], at_end)
    for j in range(N_DOF):
        k_2q, k_2v = work.k_q[j] + work.r[j] + hd * work.f[j], work.g[j] + work.f[j]
        R_q[j] = y[N_DOF + j] - E_32 * (k_2q - work.v[j]) - 2.0 * (work.k_q[j] - before[N_DOF + j])
        R_v[j] = at_end[j] - E_32 * (k_2v - at_middle[j])
        R_v[j] = p.M[j] * (R_v[j] - 2.0 * (work.g[j] - before[ACCELERATION + j]))
    for w in range(4):
        work.F[w] = -hd * work.k[w] * extension(p, R_q, w)
        # what `step` kept of the tyre's change is by the road and the wheel; df/dt is the road's
        work.T[w] = work.dT[w] + hd * work.k_t[w] * wheel_height(p, before[N_DOF:], w)
        work.T[w] -= hd * work.k_t[w] * wheel_height(p, R_q, w)
    add_struts(p, work.F, hd * roll_over(R_q, 0), hd * roll_over(R_q, 1), R_v)
    add_tyres(p, work.T, R_v)
    solve(p, work.blocks, work.body, R_v)
    for j in range(N_DOF):
        k_2q, k_2v = work.k_q[j] + work.r[j] + hd * work.f[j], work.g[j] + work.f[j]
        R_q[j] = h / 6.0 * (work.k_q[j] - 2.0 * k_2q + R_q[j] + hd * R_v[j])
        R_v[j] = h / 6.0 * (work.g[j] - 2.0 * k_2v + R_v[j])


@kernel
def state_within(before, work, h, x, y):
    """The state (14,) at the share `x` of the step just taken, written to `y`."""
    b_1, b_2 = blend(x)
    for j in range(N_DOF):
        k_2q, k_2v = work.k_q[j] + work.r[j] + h * D * work.f[j], work.g[j] + work.f[j]
        y[j] = before[j] + h * (b_1 * work.k_q[j] + b_2 * k_2q)
        y[N_DOF + j] = before[N_DOF + j] + h * (b_1 * work.g[j] + b_2 * k_2v)


@kernel
def observe(numbers, velocity, displacement, memory, y, road, out):
    """Write the signals (29,) of the state `y` (14,) over the road (8,) to `out`."""
    p, q, v = numbers[0], y[:N_DOF], y[N_DOF:]
    motion = out[ACCELERATION : ACCELERATION + N_DOF]
    accelerations(numbers, velocity, displacement, memory, q, v, road[:4], road[4:8], motion)
    for j in range(2 * N_DOF):
        out[j] = y[j]
    for w in range(4):
        u, u_dot = road[w] - wheel_height(p, q, w), road[4 + w] - wheel_height(p, v, w)
        out[EXTENSION + w] = extension(p, q, w)
        out[LOAD + w] = tyre_force(p, w, u, u_dot)[0]


@kernel
def drive(numbers, velocity, displacement, memory, y, padded, start, ds, s_0, v, t, tolerance, out):
    """Drive from time 0 and station `s_0` [m] at `v` [m/s] to the last of the times `t` (N,) [s].

    `y` (14,) ends as the state at the end of the last step; `padded`, `start`, `ds`: a Surface.
    `tolerance` holds rtol, atol and the longest step [s]. `out` (N, 29): the signals at the times.
    Returns the steps taken, those tried in vain, and the time reached: short of the end if no step
    met the tolerance.
    """
    p, work, road, straight = numbers[0], workspace(), np.empty(24), np.zeros(4)
    before, error, between = np.empty(SIGNALS), np.empty(2 * N_DOF), np.empty(2 * N_DOF)
    laws = (numbers, velocity, displacement, memory)
    q, rates = y[:N_DOF], y[N_DOF:]
    rtol, atol, longest = tolerance
    now, h, taken, rejected, i = 0.0, longest, 0, 0, 0
    while i < t.size and h > 1e-12:
        for k in range(3):
            s = s_0 + v * (now + 0.5 * k * h)
            look_at_road(p, padded, start, ds, s, v, road[8 * k : 8 * k + 8])
        step(p, velocity, displacement, memory, q, rates, road[:16], straight, h, work, before)
        step_error(*laws, before, y, road, h, work, error)
        worst = 0.0
        for j in range(2 * N_DOF):
            share = abs(error[j]) / (atol + rtol * max(abs(before[j]), abs(y[j])))
            if share > worst or share != share:  # a NaN stays
                worst = share
        if not worst <= 1.0:
            y[:] = before[: 2 * N_DOF]
            rejected += 1
            h *= resize(worst)
            continue
        while i < t.size and t[i] <= now + h:
            state_within(before, work, h, (t[i] - now) / h, between)
            look_at_road(p, padded, start, ds, s_0 + v * t[i], v, road[:8])
            observe(*laws, between, road[:8], out[i])
            i += 1
        taken += 1
        now += h
        h = min(h * resize(worst), longest)
    return taken, rejected, now


@dataclass(frozen=True)
class AdaptiveDrive:
    """A drive at the wanted times, and the steps it took: those accepted, those tried in vain."""

    trajectory: Trajectory
    steps: int
    rejections: int


def follow(
    one: Drive, t: np.ndarray, rtol: float = 1e-3, atol: float = 1e-6, max_step: float = LONGEST
) -> AdaptiveDrive:
    """Where a drive at constant speed, not yet begun, is at the times `t` (N,) [s], ascending.

    The drive itself does not move on. Raises ValueError on bad input, SimulationError if no step
    meets the tolerance.
    """
    if one.steps > 0 or one.manoeuvre is not None or len(one.profile.v) > 1:
        raise ValueError("an adaptive drive starts at its beginning, straight on at one speed")
    if one.plant.flexible:
        raise ValueError("a car with a flexible frame is driven in fixed steps, not adaptive ones")
    if not (rtol > 0 and atol > 0 and max_step > 0):
        raise ValueError("tolerances and the longest step must be positive")
    t = np.array(t, dtype=float)
    if not ((t >= 0.0).all() and (np.diff(t) > 0).all()):
        raise ValueError("times must ascend from 0")
    signals, tolerance = np.empty((t.size, SIGNALS)), np.array([rtol, atol, max_step])
    road = (one.surface.padded, one.surface.start, one.surface.ds, one.start, one.speed)
    memory, state = one.memory.copy(), one.state.copy()
    taken, rejected, reached = drive(*one.plant.arrays, memory, state, *road, t, tolerance, signals)
    if t.size and reached < t[-1]:
        raise SimulationError(f"{one.surface.name}: no step meets the tolerance at {reached:.6f} s")
    s, v = one.start + one.speed * t, np.full(t.size, one.speed)
    wheels = zip(one.memory[:, OPEN] == 0.0, one.memory[:, HIGH] == 1.0, strict=True)
    byte = sum((int(stiff) << w) | (int(high) << (4 + w)) for w, (stiff, high) in enumerate(wheels))
    commands = np.full(t.size, byte, dtype=np.uint8)
    return AdaptiveDrive(Trajectory(t, s, v, commands, signals), taken, rejected)


def simulate_adaptive(
    car: VehicleParameters,
    surface: Surface,
    speed: float,
    mode: str | Mapping[str, str] = "ride",
    rtol: float = 1e-3,
    atol: float = 1e-6,
    step: float = 0.001,
    max_step: float = LONGEST,
) -> AdaptiveDrive:
    """Drive `car` over the whole `surface` at `speed` [m/s] in one 4S4 mode, with error control.

    `step` [s] separates the instants of the trajectory, not the integrator's steps, none of which
    is longer than `max_step` [s]: a long step can miss a bump. Raises ConfigError on bad input,
    SimulationError if no step meets the tolerance.
    """
    one = Drive(plant(car), car, surface, speed, mode, step)
    return follow(one, step * np.arange(one.steps_left), rtol, atol, max_step)
