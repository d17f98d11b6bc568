"""Fixed-step integrator of the vehicle: a two-stage Rosenbrock method.

The method is the second-order formula of `ode23s`, the paper's integrator (Shampine & Reichelt
1997, "The MATLAB ODE suite", SIAM J. Sci. Comput. 18, eq. 3.1), at a constant step:

    W = I - h d J,   d = 1 / (2 + sqrt 2),   T = df/dt
    W k_1 = F(t, y) + h d T
    W (k_2 - k_1) = F(t + h/2, y + h k_1 / 2) - k_1
    y(t + h) = y + h k_2

It is of order 2 and L-stable. With coordinates q, rates v and generalised forces f, k = (k_q, k_v)
and each stage reduces to the seven rates: k_q = r_q + h d k_v, with

    (M + h d C + (h d)² K) k_v = f + h d df/dt - h d K r_q

where K = -df/dq, C = -df/dv. K and C are sums over struts and tyres, so products with them are
computed force by force. The matrix is never assembled (`block_elimination`).
"""

from collections import namedtuple
from typing import NamedTuple

import numpy as np

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd_arrays import add, get, put, stack_array
from road_envs.roads.surface import height_and_slope
from road_envs.simulation.block_elimination import factorize, solve_factored
from road_envs.simulation.substeps import SUBSTEPS, interpolate, is_steep
from road_envs.vehicle import equations as eq
from road_envs.vehicle import side_motion as sm
from road_envs.vehicle.equations import N_DOF, PHI, THETA, Motion, Plant
from road_envs.vehicle.suspension import advance_valve, strut_force, valves_settled
from road_envs.vehicle.tyres import tyre_force

D = 1.0 / (2.0 + np.sqrt(2.0))

STATE, ACCELERATION, EXTENSION, LOAD = 0, 14, 21, 25
N_SIGNALS = 29
"""Columns of the output: state (14), accelerations (7), strut extensions (4), tyre loads (4)."""

TWIST, N_FLEXIBLE_SIGNALS = 29, 32
"""Further columns of a flexible vehicle: frame twist [rad], its rate and its acceleration."""

SIDE, SIDE_ACCELERATION, N_SIDE_SIGNALS = 32, 40, 44
"""Further columns of a vehicle with side motion: its `side_state` (8), then V', r', w_front' and
w_rear'. Those of the twist are 0 if its frame is rigid."""


def n_signals(plant: Plant) -> int:
    """Return the number of signals of a vehicle."""
    if plant.sideways:
        return N_SIDE_SIGNALS
    return N_FLEXIBLE_SIGNALS if plant.flexible else N_SIGNALS


StepWorkspace = namedtuple("StepWorkspace", "f g r k_q q v F T dF dT k k_t s t blocks body")
"""Scratch of `step`: right-hand sides and stage values (7,), wheel values (4,), factors."""

WORKSPACE_ROWS = 6 * N_DOF + 8 * 4 + 12 + 6  # rows of the buffer behind a StepWorkspace


@kernel
def step_workspace(buffer):
    """Return views of a `buffer` (WORKSPACE_ROWS,) or (..., LANES), fastest on the stack."""
    n, w = N_DOF, 6 * N_DOF
    return StepWorkspace(
        buffer[:n], buffer[n : 2 * n], buffer[2 * n : 3 * n],
        buffer[3 * n : 4 * n], buffer[4 * n : 5 * n], buffer[5 * n : w],
        buffer[w : w + 4], buffer[w + 4 : w + 8], buffer[w + 8 : w + 12], buffer[w + 12 : w + 16],
        buffer[w + 16 : w + 20], buffer[w + 20 : w + 24], buffer[w + 24 : w + 28],
        buffer[w + 28 : w + 32], buffer[w + 32 : w + 44], buffer[w + 44 : WORKSPACE_ROWS],
    )  # fmt: skip


class StepInputs(NamedTuple):
    """Inputs of one step of `h` [s].

    `road` (16,): heights [m] of the road under the four wheels at t, their rates [m/s], and both
    again at t + h/2. `a_xy` (4,): accelerations a_x, a_y [m/s²] of a manoeuvre at t and t + h/2;
    None where it is not read. `v` [m/s]: speed at t + h/2, which side motion alone reads.
    """

    road: np.ndarray
    a_xy: np.ndarray | None
    h: float
    v: float | np.ndarray


@kernel
def _stage_1_at_wheel(vehicle, motion, inputs, work, out, twist, w):
    """Write the forces of strut and tyre `w` at t, their stiffness and their part of h d df/dt."""
    (q, v), road, h = motion, inputs.road, inputs.h
    hd, p = h * D, vehicle.constants[0]
    e, rate = eq.extension(p, q, w), eq.extension(p, v, w)
    e_dot = rate
    if twist is not None:
        e = e + eq.twist_extension(p, twist[0], w)
        e_dot = e_dot + eq.twist_extension(p, twist[1], w)
    force, k, c = strut_force(vehicle, w, e, e_dot)
    u = get(road, w) - eq.wheel_height(p, q, w)
    u_dot = get(road, 4 + w) - eq.wheel_height(p, v, w)
    load, k_t, c_t = tyre_force(p, w, u, u_dot)
    # the road is known at t and t + h/2 only: its second derivative is a difference
    w_dot = (get(road, 12 + w) - get(road, 4 + w)) * (2.0 / h)
    put(work.F, w, force)
    put(work.T, w, load)
    put(work.dF, w, -hd * k * rate)
    put(work.dT, w, hd * (k_t * u_dot + c_t * w_dot))
    put(work.k, w, k)
    put(work.k_t, w, k_t)
    put(work.s, w, hd * (c + hd * k))
    put(work.t, w, hd * (c_t + hd * k_t))
    put(out, EXTENSION + w, e)
    put(out, LOAD + w, load)


@kernel
def _stage_2_at_wheel(vehicle, inputs, work, twist, side, w):
    """Write the forces of strut and tyre `w` in stage 2; with side motion also to dF and dT."""
    road, hd, p, r = inputs.road, inputs.h * D, vehicle.constants[0], work.r
    e, e_dot = eq.extension(p, work.q, w), eq.extension(p, work.v, w)
    if twist is not None:
        e = e + eq.twist_extension(p, twist[2], w)
        e_dot = e_dot + eq.twist_extension(p, twist[3], w)
    force, _, _ = strut_force(vehicle, w, e, e_dot)
    put(work.F, w, force - hd * get(work.k, w) * eq.extension(p, r, w))
    u = get(road, 8 + w) - eq.wheel_height(p, work.q, w)
    u_dot = get(road, 12 + w) - eq.wheel_height(p, work.v, w)
    load, _, _ = tyre_force(p, w, u, u_dot)
    put(work.T, w, load - hd * get(work.k_t, w) * eq.wheel_height(p, r, w))
    if side is not None:
        put(work.dF, w, force)
        put(work.dT, w, load)


@kernel
def _loaded_slip(p, roll_rates, state, T):
    """Return l_a u_a [m/s] of both axles under tyre loads `T` (4,)."""
    u, share = sm.contact_speeds(p, roll_rates, state), sm.load_shares(p, T)
    return share[0] * u[0], share[1] * u[1]


@kernel
def step(vehicle, motion, inputs, work, out, twist=None, side=None):
    """Advance the `motion` of one or LANES vehicles by one step of StepInputs, in place.

    The signals at t go to `out` (29,). `twist`, if given: the frame's twist [rad] and its rate at
    t and at t + h/2 (4 numbers). `side`, if given: the vehicle has side motion, whose state is the
    last of `motion`. With LANES vehicles every array has the lanes as its last axis.
    """
    (q, v), a_xy, h = motion, inputs.a_xy, inputs.h
    hd, p = h * D, vehicle.constants[0]
    f, g, r, k_q = work.f, work.g, work.r, work.k_q
    F, T, dF, dT = work.F, work.T, work.dF, work.dT
    # one call for each wheel, since loops are not unrolled and their arrays stay in memory;
    # stage 1: F, T are the forces at t; dF, dT their part of h d (df/dt - K v)
    _stage_1_at_wheel(vehicle, motion, inputs, work, out, twist, 0)
    _stage_1_at_wheel(vehicle, motion, inputs, work, out, twist, 1)
    _stage_1_at_wheel(vehicle, motion, inputs, work, out, twist, 2)
    _stage_1_at_wheel(vehicle, motion, inputs, work, out, twist, 3)
    for j in range(N_DOF):
        put(f, j, 0.0)
    # bushings act on the roll of the body relative to each axle, which the frame's twist changes
    front, rear = eq.relative_roll(q, 0), eq.relative_roll(q, 1)
    if twist is not None:
        front += get(p.twist_share, 0) * twist[0]
        rear += get(p.twist_share, 1) * twist[0]
    eq.add_weight(p, f)
    eq.add_struts(p, F, front, rear, f)
    eq.add_tyres(p, T, f)
    a_x, a_y = get(a_xy, 0), get(a_xy, 1)
    eq.add_manoeuvre_moments(p, get(q, PHI), get(q, THETA), a_x, a_y, f)
    if side is not None:
        state = sm.side_state(q, v)
        slip = _loaded_slip(p, sm.rolls(v), state, T)
        rates = sm.side_rates(p, sm.rolls(q), sm.rolls(f), state, slip, inputs.v, a_y)
        sm.add_rolls(f, rates)
        slopes = sm.side_increments(p, rates, inputs.v, hd)
        middle = sm.side_middle(state, slopes, h)
        sm.put_side(out[SIDE:N_SIDE_SIGNALS], state, rates)
    for j in range(N_DOF):
        put(g, j, get(f, j))
        put(out, STATE + j, get(q, j))
        put(out, STATE + N_DOF + j, get(v, j))
        put(out, ACCELERATION + j, get(f, j) / get(p.M, j))
    eq.add_struts(p, dF, hd * eq.relative_roll(v, 0), hd * eq.relative_roll(v, 1), g)
    eq.add_tyres(p, dT, g)
    x_dot, y_dot = 2.0 * D * (get(a_xy, 2) - a_x), 2.0 * D * (get(a_xy, 3) - a_y)
    eq.add_manoeuvre_moments(p, hd * get(v, PHI), hd * get(v, THETA), x_dot, y_dot, g)
    factorize(p, work.s, work.t, hd, work.blocks, work.body)
    solve_factored(p, work.blocks, work.body, g)
    # stage 2 at (work.q, work.v): r = r_q of k_2 - k_1, f collects its right-hand side
    for j in range(N_DOF):
        rate, kv = get(v, j), get(g, j)
        kq = rate + hd * kv
        put(k_q, j, kq)
        put(work.q, j, get(q, j) + 0.5 * h * kq)
        v_mid = rate + 0.5 * h * kv
        put(work.v, j, v_mid)
        put(r, j, v_mid - kq)
        put(f, j, -get(p.M, j) * kv)
    _stage_2_at_wheel(vehicle, inputs, work, twist, side, 0)
    _stage_2_at_wheel(vehicle, inputs, work, twist, side, 1)
    _stage_2_at_wheel(vehicle, inputs, work, twist, side, 2)
    _stage_2_at_wheel(vehicle, inputs, work, twist, side, 3)
    front = eq.relative_roll(work.q, 0) + hd * eq.relative_roll(r, 0)
    rear = eq.relative_roll(work.q, 1) + hd * eq.relative_roll(r, 1)
    if side is not None:
        own_f, own_r = eq.relative_roll(work.q, 0), eq.relative_roll(work.q, 1)
        if twist is not None:
            own_f += get(p.twist_share, 0) * twist[2]
            own_r += get(p.twist_share, 1) * twist[2]
        moments = eq.roll_moments(p, work.dF, work.dT, own_f, own_r)
        slip = _loaded_slip(p, sm.rolls(work.v), middle, work.dT)
        rates = sm.side_rates(p, sm.rolls(work.q), moments, middle, slip, inputs.v, get(a_xy, 3))
        sm.add_rolls(f, rates)
        sm.advance_side(p, motion, slopes, rates, inputs.v, h, hd)
    if twist is not None:
        front += get(p.twist_share, 0) * twist[2]
        rear += get(p.twist_share, 1) * twist[2]
    eq.add_weight(p, f)
    eq.add_struts(p, F, front, rear, f)
    eq.add_tyres(p, T, f)
    phi, theta = get(work.q, PHI) + hd * get(r, PHI), get(work.q, THETA) + hd * get(r, THETA)
    eq.add_manoeuvre_moments(p, phi, theta, get(a_xy, 2), get(a_xy, 3), f)
    solve_factored(p, work.blocks, work.body, f)
    for j in range(N_DOF):
        add(q, j, h * (get(k_q, j) + get(r, j) + hd * get(f, j)))
        add(v, j, h * (get(g, j) + get(f, j)))


@kernel
def _flexible_step(vehicle, motion, inputs, work, out, side=None):
    """`step` of a vehicle with a flexible frame: the twist follows the seven coordinates.

    The matrix W is block diagonal here: it omits the coupling of the seven rigid coordinates and
    the twist. The formula keeps order 2 with any matrix in place of the Jacobian, since
    k_2 = F(t + h/2, y + h k_1 / 2) + O(h²) still holds, and the omitted coupling is not stiff.
    """
    (q, v), h = motion, inputs.h
    hd, p = h * D, vehicle.constants[0]
    inertia, rate, damping = get(p.frame_inertia), get(p.frame_rate), get(p.frame_damping)
    inverse = 1.0 / (inertia + hd * (damping + hd * rate))
    psi, psi_dot = get(q, N_DOF), get(v, N_DOF)
    for w in range(4):
        e = eq.extension(p, q, w) + eq.twist_extension(p, psi, w)
        e_dot = eq.extension(p, v, w) + eq.twist_extension(p, psi_dot, w)
        put(work.F, w, strut_force(vehicle, w, e, e_dot)[0])
    front = eq.relative_roll(q, 0) + get(p.twist_share, 0) * psi
    rear = eq.relative_roll(q, 1) + get(p.twist_share, 1) * psi
    moment = eq.twist_moment(p, work.F, front, rear) - rate * psi - damping * psi_dot
    put(out, TWIST, psi)
    put(out, TWIST + 1, psi_dot)
    put(out, TWIST + 2, moment / inertia)
    k_v = (moment - hd * rate * psi_dot) * inverse
    k_q = psi_dot + hd * k_v
    psi_mid, psi_mid_dot = psi + 0.5 * h * k_q, psi_dot + 0.5 * h * k_v
    step(vehicle, motion, inputs, work, out, (psi, psi_dot, psi_mid, psi_mid_dot), side)
    for w in range(4):
        e = eq.extension(p, work.q, w) + eq.twist_extension(p, psi_mid, w)
        e_dot = eq.extension(p, work.v, w) + eq.twist_extension(p, psi_mid_dot, w)
        put(work.F, w, strut_force(vehicle, w, e, e_dot)[0])
    front = eq.relative_roll(work.q, 0) + get(p.twist_share, 0) * psi_mid
    rear = eq.relative_roll(work.q, 1) + get(p.twist_share, 1) * psi_mid
    r = psi_mid_dot - k_q
    moment = eq.twist_moment(p, work.F, front, rear)
    moment = moment - rate * (psi_mid + hd * r) - damping * psi_mid_dot
    m_v = (moment - inertia * k_v) * inverse
    put(q, N_DOF, psi + h * (k_q + r + hd * m_v))
    put(v, N_DOF, psi_dot + h * (k_v + m_v))


@kernel
def any_step(vehicle, motion, inputs, work, out, flexible, side):
    """Take the step of a `flexible` frame or of a rigid one, with side motion or without."""
    if flexible is None:
        step(vehicle, motion, inputs, work, out, None, side)
    else:
        _flexible_step(vehicle, motion, inputs, work, out, side)


@kernel
def sample_road(p, surface, s, v, road):
    """Write heights [m] and rates [m/s] under the wheels to `road` (8,), front axle at `s` [m]."""
    for w in range(4):
        behind = p.x[0] - p.x[w // 2]
        z, slope = height_and_slope(surface, w % 2, s - behind)
        road[w], road[4 + w] = z, slope * v


@kernel
def update_valves(p, strut_state, q, command, alpha, h):
    """Advance the `strut_state` (4, 3) of all struts by one step `h` [s] under a `command` byte.

    `alpha`: see `suspension.advance_valve`; `q` as of `equations.Motion`. Returns whether all
    valves had settled before.
    """
    settled = True
    has_twist = (q.shape[0] - N_DOF) % 2 == 1  # side motion has two coordinates more, or four
    for w in range(4):
        setting = (command >> w) & 1, (command >> (4 + w)) & 1
        if not valves_settled(strut_state, w, setting):
            e = eq.extension(p, q, w)
            if has_twist:
                e += eq.twist_extension(p, q[N_DOF], w)
            advance_valve(p, strut_state, w, e, setting, alpha, h)
            settled = False
    return settled


@kernel(count_references=False)
def integrate(vehicle, y, surface, inputs, lag, out, flexible=None, side=None):
    """Integrate `drive.DriveInputs`; the state `y` (14,) and the strut state change in place.

    `surface`: SurfaceBuffers; `lag` [s]: time constant of the valves. `out` (N, 29): the signals at
    the beginning of each step. Of a `flexible` vehicle `y` is (16,) and `out` (N, 32); with `side`
    motion they are those of `n_signals`. A step on a steep road is divided (`substeps`).
    """
    (s, v, a_xy, commands, h), p = inputs, vehicle.constants[0]
    work, road = step_workspace(stack_array(WORKSPACE_ROWS)), stack_array(16)
    motion, unused = Motion(y[: y.size // 2], y[y.size // 2 :]), stack_array(N_SIDE_SIGNALS)
    alpha = 1.0 - np.exp(-h / lag)
    for n in range(commands.size):
        sample_road(p, surface, s[2 * n], v[2 * n], road[:8])
        sample_road(p, surface, s[2 * n + 1], v[2 * n + 1], road[8:])
        update_valves(p, vehicle.strut_state, motion.q, commands[n], alpha, h)
        parts = SUBSTEPS if is_steep(road) else 1
        for i in range(parts):
            for half in range(2 if parts > 1 else 0):
                station = interpolate(s[2 * n : 2 * n + 3], i, half)
                speed = interpolate(v[2 * n : 2 * n + 3], i, half)
                sample_road(p, surface, station, speed, road[8 * half : 8 * half + 8])
            first = 4 * n + 2 * (2 * i // parts)  # a manoeuvre hardly changes in half a step
            step_inputs = StepInputs(road, a_xy[first : first + 4], h / parts, v[2 * n + 1])
            row = out[n] if i == 0 else unused
            any_step(vehicle, motion, step_inputs, work, row, flexible, side)
