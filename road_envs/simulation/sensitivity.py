"""Tangent and adjoint of the fixed step: sensitivity of a drive to its road and initial state.

`rosenbrock.step` maps the state y = (q, v) and the road's heights and rates at both stage times to
the next state. The derivative is that of the discrete step, exact up to rounding. With symmetric
W = M + h d C + (h d)² K, k and m the solutions of W k = g(y) and W m = f(y, k), and ' a
directional derivative,

    W k' = g' - W' k,        W m' = f' - W' m,        W' = sum over struts and tyres of s' b b'

For a strut, b maps coordinates to its extension and s = h d c + (h d)² k. So s' contains the
change of the stiffness k with the extension (gas spring, bushing, stop) and of the damping c with
its rate (damper, friction). For a tyre, b maps coordinates to the height of the wheel; its
stiffness changes with its compression, which depends on the road as well. The adjoint is the
transposed chain in reverse order; since W is symmetric, it uses the same solver (Giles & Pierce
2000, doi:10.1023/A:1011430410075, section 2).

Limits. At a kink (wheel lift-off, limit of the tyre's damper, grid point or end of a table,
shortest gas column) the derivative is that of the branch taken by the step; the small jump of W at
lift-off is neglected. A vehicle exactly at rest is at such a kink, because the friction law has
opposite curvature for opening and closing struts. The strut state follows the commands, but its
derivative is neglected: the dependence of a held extension on the road before the switch is
missing. The adjoint does not support a flexible frame.

One row of the tape (TAPE_ROW_SIZE,) holds the derivative of one step. Per strut (4 each): K_1, C_1
and K_2, C_2, stiffness and damping at stages 1 and 2; G_K, G_C and F_K, F_C, minus the derivatives
of the right-hand sides of stages 1 and 2 by e and e_dot at the step's beginning (F_K, F_C without
the contributions of K_2, C_2). Per tyre: TK_1, TC_1, TK_2, TC_2 likewise; G_U, the derivative of
the first right-hand side by the compression u, and F_U, minus that of the second without TK_2.
Last come the factors of W.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from road_envs._numba import kernel
from road_envs.simulation.rosenbrock import (
    ACCELERATION,
    EXTENSION,
    TWIST,
    D,
    StepInputs,
    flexible_step,
    n_signals,
    solve_factored,
    step,
    update_valves,
    workspace,
)
from road_envs.simulation.simd import add, get, put
from road_envs.vehicle.equations import (
    N_DOF,
    PHI,
    THETA,
    Motion,
    Plant,
    add_manoeuvre_moments,
    add_struts,
    add_tyres,
    extension,
    relative_roll,
    twist_extension,
    twist_moment,
    wheel_height,
)
from road_envs.vehicle.suspension import strut_curvature, strut_force, tyre_curvature, tyre_force

K_1, C_1, K_2, C_2, G_K, G_C, F_K, F_C = range(0, 32, 4)
TK_1, TC_1, TK_2, TC_2, G_U, F_U, BLOCKS, BODY = *range(32, 60, 4), 68
TAPE_ROW_SIZE = 74


@kernel
def step_with_derivative(vehicle, motion, inputs, h, work, out, row, flexible=None):
    """Take `rosenbrock.step`, same arguments; write its derivative to `row` (TAPE_ROW_SIZE,).

    Of a `flexible` vehicle, `rosenbrock.flexible_step`.
    """
    p, road, hd, before = vehicle.constants[0], inputs.road, h * D, out[N_DOF : 2 * N_DOF]
    psi_dot = psi_mid = psi_mid_dot = 0.0
    if flexible is None:
        step(vehicle, motion, inputs, h, work, out)
    else:
        flexible_step(vehicle, motion, inputs, h, work, out)
        psi_dot, moment = out[TWIST + 1], p.frame_inertia * out[TWIST + 2]
        k_v = (moment - hd * p.frame_rate * psi_dot) * _inverse_frame(p, hd)
        psi_mid = out[TWIST] + 0.5 * h * (psi_dot + hd * k_v)
        psi_mid_dot = psi_dot + 0.5 * h * k_v
    for w in range(4):
        e, e_dot = out[EXTENSION + w], extension(p, before, w)
        twist_rate = twist_extension(p, psi_dot, w)
        # `step` leaves k and s = h d c + (h d)² k in its scratch: no second call of strut_force
        k, c = work.k[w], work.s[w] / hd - hd * work.k[w]
        k_slope, c_slope = strut_curvature(vehicle, w, e, e_dot + twist_rate)
        first, second = extension(p, work.g, w), extension(p, work.f, w)
        row[K_1 + w], row[C_1 + w] = k, c
        row[G_K + w] = k + hd * k_slope * (e_dot + hd * first)
        row[G_C + w] = c + hd * k + hd * c_slope * first
        row[F_K + w] = hd * k_slope * (extension(p, work.r, w) + hd * second)
        row[F_C + w] = hd * c_slope * second
        e = extension(p, work.q, w) + twist_extension(p, psi_mid, w)
        e_dot = extension(p, work.v, w) + twist_extension(p, psi_mid_dot, w)
        _, row[K_2 + w], row[C_2 + w] = strut_force(vehicle, w, e, e_dot)
        u, u_dot = road[w] - wheel_height(p, out, w), road[4 + w] - wheel_height(p, before, w)
        _, k, c = tyre_force(p, w, u, u_dot)
        k_slope = tyre_curvature(p, w, u, u_dot)
        first, second = wheel_height(p, work.g, w), wheel_height(p, work.f, w)
        row[TK_1 + w], row[TC_1 + w] = k, c
        row[G_U + w] = k + hd * k_slope * (u_dot - hd * first)
        row[F_U + w] = hd * k_slope * (wheel_height(p, work.r, w) + hd * second)
        u, u_dot = (
            road[8 + w] - wheel_height(p, work.q, w),
            road[12 + w] - wheel_height(p, work.v, w),
        )
        _, row[TK_2 + w], row[TC_2 + w] = tyre_force(p, w, u, u_dot)
    row[BLOCKS:BODY] = work.blocks
    row[BODY:TAPE_ROW_SIZE] = work.body


@kernel
def _inverse_frame(p, hd):
    """Return the inverse of the frame's share of W."""
    return 1.0 / (p.frame_inertia + hd * (p.frame_damping + hd * p.frame_rate))


@kernel
def tangent_step(p, row, motion, road, h, work, a, flexible=None):
    """Propagate changes `motion` of coordinates and rates through one step, in place.

    `road` (16,): changes of the road's heights [m] and rates [m/s], in the layout of
    `rosenbrock.step`. Writes the change of the accelerations (7,) at the step's beginning to `a`.
    For LANES directions at once, all arrays but `p` and `row` have the lanes as their last axis.
    Of a `flexible` vehicle, coordinates, rates and accelerations are (8,).
    """
    hd, (q, v) = h * D, motion
    f, g, r, k_q, F, T, dF, dT = work.f, work.g, work.r, work.k_q, work.F, work.T, work.dF, work.dT
    blocks, body = row[BLOCKS:BODY], row[BODY:TAPE_ROW_SIZE]
    # stage 1: F, T give f'; dF, dT give g' - W' k; s, t keep what stage 2 needs of the state at t
    for w in range(4):
        e, e_dot = extension(p, q, w), extension(p, v, w)
        held = 0.0 * e
        if flexible is not None:
            twist_rate = twist_extension(p, get(v, N_DOF), w)
            e, e_dot = e + twist_extension(p, get(q, N_DOF), w), e_dot + twist_rate
            held = hd * row[K_1 + w] * twist_rate  # W leaves out the twist
        put(F, w, -row[K_1 + w] * e - row[C_1 + w] * e_dot)
        put(dF, w, held - row[G_K + w] * e - row[G_C + w] * e_dot)
        put(work.s, w, row[F_K + w] * e + row[F_C + w] * e_dot)
        k_t, c_t = row[TK_1 + w], row[TC_1 + w]
        u = get(road, w) - wheel_height(p, q, w)
        u_dot = get(road, 4 + w) - wheel_height(p, v, w)
        rise = (2.0 * D * c_t) * (get(road, 12 + w) - get(road, 4 + w))
        put(T, w, k_t * u + c_t * u_dot)
        put(dT, w, row[G_U + w] * u + (c_t + hd * k_t) * u_dot + rise)
        put(work.t, w, row[F_U + w] * u)
    for j in range(N_DOF):
        put(f, j, 0.0)
        put(g, j, 0.0)
    front, rear = relative_roll(q, 0), relative_roll(q, 1)
    if flexible is not None:
        psi, psi_dot = get(q, N_DOF), get(v, N_DOF)
        front, rear = front + p.twist_share[0] * psi, rear + p.twist_share[1] * psi
        moment = twist_moment(p, F, front, rear) - p.frame_rate * psi - p.frame_damping * psi_dot
        put(a, N_DOF, moment / p.frame_inertia)
        t_v = (moment - hd * p.frame_rate * psi_dot) * _inverse_frame(p, hd)
        t_q = psi_dot + hd * t_v
        psi_mid, psi_mid_dot = psi + 0.5 * h * t_q, psi_dot + 0.5 * h * t_v
    add_struts(p, F, front, rear, f)
    add_tyres(p, T, f)
    add_manoeuvre_moments(p, get(q, PHI), get(q, THETA), 0.0, 0.0, f)
    add_struts(p, dF, front + hd * relative_roll(v, 0), rear + hd * relative_roll(v, 1), g)
    add_tyres(p, dT, g)
    phi, theta = get(q, PHI) + hd * get(v, PHI), get(q, THETA) + hd * get(v, THETA)
    add_manoeuvre_moments(p, phi, theta, 0.0, 0.0, g)
    solve_factored(p, blocks, body, g)
    for j in range(N_DOF):
        rate, k_v = get(v, j), get(g, j)
        put(a, j, get(f, j) / get(p.M, j))
        put(k_q, j, rate + hd * k_v)
        put(work.q, j, get(q, j) + 0.5 * h * get(k_q, j))
        put(work.v, j, rate + 0.5 * h * k_v)
        put(r, j, get(work.v, j) - get(k_q, j))
        put(f, j, -get(p.M, j) * k_v)
    for w in range(4):
        e, e_dot = extension(p, work.q, w), extension(p, work.v, w)
        if flexible is not None:
            e = e + twist_extension(p, psi_mid, w)
            e_dot = e_dot + twist_extension(p, psi_mid_dot, w)
        force = -row[K_2 + w] * e - row[C_2 + w] * e_dot
        put(dF, w, force)
        put(F, w, force - hd * row[K_1 + w] * extension(p, r, w) - get(work.s, w))
        u = get(road, 8 + w) - wheel_height(p, work.q, w)
        u_dot = get(road, 12 + w) - wheel_height(p, work.v, w)
        load = row[TK_2 + w] * u + row[TC_2 + w] * u_dot
        put(T, w, load - hd * row[TK_1 + w] * wheel_height(p, r, w) - get(work.t, w))
    front, rear = relative_roll(work.q, 0), relative_roll(work.q, 1)
    if flexible is not None:
        front, rear = front + p.twist_share[0] * psi_mid, rear + p.twist_share[1] * psi_mid
        t_r = psi_mid_dot - t_q
        spring = p.frame_rate * (psi_mid + hd * t_r) + p.frame_damping * psi_mid_dot
        t_m = twist_moment(p, dF, front, rear) - spring - p.frame_inertia * t_v
        t_m = t_m * _inverse_frame(p, hd)
        add(q, N_DOF, h * (t_q + t_r + hd * t_m))
        add(v, N_DOF, h * (t_v + t_m))
    front, rear = front + hd * relative_roll(r, 0), rear + hd * relative_roll(r, 1)
    add_struts(p, F, front, rear, f)
    add_tyres(p, T, f)
    phi, theta = get(work.q, PHI) + hd * get(r, PHI), get(work.q, THETA) + hd * get(r, THETA)
    add_manoeuvre_moments(p, phi, theta, 0.0, 0.0, f)
    solve_factored(p, blocks, body, f)
    for j in range(N_DOF):
        add(q, j, h * (get(k_q, j) + get(r, j) + hd * get(f, j)))
        add(v, j, h * (get(g, j) + get(f, j)))


@kernel
def reverse_second_stage(p, row, h, work, road):
    """Reverse the second stage, from the adjoint `work.f` (7,) of m'.

    On entry `work.g`, `work.k_q` and `work.r` hold the contributions of the end state to the
    adjoints of the first stage; they are completed here. Writes the adjoints of the stage's
    coordinates and rates to `work.q` and `work.v`, those of extensions and their rates at the
    beginning to `work.dF` and `work.dT`, and the contributions to the adjoint of the road to
    `road`, except `road[4:8]`.
    """
    hd = h * D
    f, r, F, T, q, v = work.f, work.r, work.F, work.T, work.q, work.v
    solve_factored(p, row[BLOCKS:BODY], row[BODY:TAPE_ROW_SIZE], f)
    q[:], v[:] = 0.0, 0.0
    add_manoeuvre_moments(p, f[PHI], f[THETA], 0.0, 0.0, q)
    add_manoeuvre_moments(p, hd * f[PHI], hd * f[THETA], 0.0, 0.0, r)
    for w in range(4):
        push, lift = extension(p, f, w), wheel_height(p, f, w)
        work.dF[w], work.dT[w] = -row[F_K + w] * push, -row[F_C + w] * push
        road[w] = -row[F_U + w] * lift
        work.k[w], work.s[w] = -row[K_2 + w] * push, -row[C_2 + w] * push
        road[8 + w], road[12 + w] = row[TK_2 + w] * lift, row[TC_2 + w] * lift
        work.k_t[w], work.t[w] = -road[8 + w], -road[12 + w]
        F[w], T[w] = -hd * row[K_1 + w] * push, -hd * row[TK_1 + w] * lift
    front, rear = relative_roll(f, 0), relative_roll(f, 1)
    add_struts(p, work.k, front, rear, q)
    add_tyres(p, work.k_t, q)
    add_struts(p, work.s, 0.0, 0.0, v)
    add_tyres(p, work.t, v)
    add_struts(p, F, hd * front, hd * rear, r)
    add_tyres(p, T, r)
    for j in range(N_DOF):
        v[j] += r[j]
        work.k_q[j] += 0.5 * h * q[j] - r[j]
        work.g[j] += 0.5 * h * v[j] + hd * work.k_q[j] - p.M[j] * f[j]


@kernel
def adjoint_step(p, row, a, h, work, motion, road):
    """Apply the transpose of `tangent_step`: take the adjoints `motion` one step back.

    `a` (7,) is the adjoint of the accelerations at the step's beginning. Writes the adjoint of the
    road's heights and rates to `road` (16,), in the same layout.
    """
    hd, (q, v) = h * D, motion
    f, g, F, T = work.f, work.g, work.F, work.T
    # the update of q and v in `step`, transposed
    for j in range(N_DOF):
        work.k_q[j] = work.r[j] = h * q[j]
        g[j] = h * v[j]
        f[j] = hd * work.r[j] + g[j]
    reverse_second_stage(p, row, h, work, road)
    solve_factored(p, row[BLOCKS:BODY], row[BODY:TAPE_ROW_SIZE], g)
    for j in range(N_DOF):
        q[j] += work.q[j]
        v[j] += work.v[j] + work.k_q[j]
        f[j] = a[j] / p.M[j]
    add_manoeuvre_moments(p, f[PHI] + g[PHI], f[THETA] + g[THETA], 0.0, 0.0, q)
    add_manoeuvre_moments(p, hd * g[PHI], hd * g[THETA], 0.0, 0.0, v)
    for w in range(4):
        k_t, c_t = row[TK_1 + w], row[TC_1 + w]
        first, direct = extension(p, g, w), extension(p, f, w)
        work.dF[w] -= row[G_K + w] * first + row[K_1 + w] * direct
        work.dT[w] -= row[G_C + w] * first + row[C_1 + w] * direct
        first, direct = wheel_height(p, g, w), wheel_height(p, f, w)
        z = row[G_U + w] * first + k_t * direct + road[w]
        z_dot = c_t * (first + direct) + hd * k_t * first
        difference = 2.0 * D * c_t * first
        road[w], road[4 + w] = z, z_dot - difference
        road[12 + w] += difference
        F[w], T[w] = -z, -z_dot
    front, rear = relative_roll(g, 0), relative_roll(g, 1)
    add_struts(p, work.dF, front + relative_roll(f, 0), rear + relative_roll(f, 1), q)
    add_tyres(p, F, q)
    add_struts(p, work.dT, hd * front, hd * rear, v)
    add_tyres(p, T, v)


class TapeInputs(NamedTuple):
    """Inputs of N steps of `h` [s]: `road` (N, 16) and `a_xy` (N, 4) as in `rosenbrock.StepInputs`.

    `commands` (N,), or (0,) for a constant strut state, and `lag` as in `rosenbrock.integrate`.
    """

    road: np.ndarray
    a_xy: np.ndarray
    commands: np.ndarray
    lag: float
    h: float


@kernel
def integrate_with_derivative(vehicle, y, inputs, out, rows, flexible=None):
    """Take the steps of TapeInputs; the state `y` (14,) and the strut state change in place.

    Signals go to `out` (N, 29), the derivative to `rows` (N, TAPE_ROW_SIZE).
    """
    n_dof, h = y.size // 2, inputs.h
    work, motion = workspace(), Motion(y[:n_dof], y[n_dof:])
    alpha = 1.0 - np.exp(-h / inputs.lag)
    for n in range(rows.shape[0]):
        if inputs.commands.size > 0:
            update_valves(
                vehicle.constants[0], vehicle.strut_state, motion.q, inputs.commands[n], alpha, h
            )
        step_inputs = StepInputs(inputs.road[n], inputs.a_xy[n])
        step_with_derivative(vehicle, motion, step_inputs, h, work, out[n], rows[n], flexible)


@kernel
def propagate_tangent(constants, rows, y, road, h, a, flexible=None):
    """Apply `tangent_step` row by row; write changes of accelerations to `a` (N, 7)."""
    n_dof, p, work = y.size // 2, constants[0], workspace()
    motion = Motion(y[:n_dof], y[n_dof:])
    for n in range(rows.shape[0]):
        tangent_step(p, rows[n], motion, road[n], h, work, a[n], flexible)


@kernel
def propagate_adjoint(constants, rows, a, h, y, road):
    """Apply `adjoint_step` in reverse order; write the adjoint of the road to `road` (N, 16)."""
    p, work, motion = constants[0], workspace(), Motion(y[:N_DOF], y[N_DOF:])
    for n in range(rows.shape[0] - 1, -1, -1):
        adjoint_step(p, rows[n], a[n], h, work, motion, road[n])


def _checked_copy(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of `value` as float. Raises ValueError unless it has the `shape`."""
    copy = np.array(value, dtype=float)
    if copy.shape != shape:
        # kernels do not check bounds
        raise ValueError(f"{name} must be of shape {shape}, got {copy.shape}")
    return copy


@dataclass(frozen=True, eq=False)
class Tape:
    """A drive of N steps and its derivative, 592 bytes per step; it can be applied repeatedly.

    `signals` (N, 29) at the beginning of each step, laid out as in `rosenbrock`; `end` (14,) and
    `strut_state` (4, 3) after the last step; `rows` (N, TAPE_ROW_SIZE), the derivative of each
    step of `h` [s].
    """

    plant: Plant
    h: float
    signals: np.ndarray
    end: np.ndarray
    strut_state: np.ndarray
    rows: np.ndarray

    @property
    def acceleration(self) -> np.ndarray:
        """Accelerations (N, 7) of the degrees of freedom at the beginning of each step."""
        rigid = self.signals[:, ACCELERATION : ACCELERATION + N_DOF]
        if not self.plant.flexible:
            return rigid
        return np.column_stack([rigid, self.signals[:, TWIST + 2]])

    def tangent(self, start: np.ndarray, road: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return first-order changes of the accelerations (N, 7) and of the final state (14,).

        `start` (14,): change of the initial state; `road` (2 N, 2, 4): change of the heights [m]
        and rates [m/s] under the wheels at the beginning and the middle of each step. Raises
        ValueError on a wrong shape.
        """
        y, steps = _checked_copy("start", start, self.end.shape), self.rows.shape[0]
        z = _checked_copy("road", road, (2 * steps, 2, 4)).reshape(steps, 16)
        a, flexible = np.empty((steps, y.size // 2)), (True,) if self.plant.flexible else ()
        propagate_tangent(self.plant.constants, self.rows, y, z, self.h, a, *flexible)
        return a, y

    def adjoint(self, acceleration: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a cost's gradients by the initial state (14,) and by the road (2 N, 2, 4).

        This is the transpose of `tangent`: `acceleration` (N, 7) and `end` (14,) are the cost's
        gradients by the outputs of `tangent`. Raises ValueError on a wrong shape and on a flexible
        frame.
        """
        if self.plant.flexible:
            raise ValueError("the adjoint does not support a flexible frame")
        y, steps = _checked_copy("end", end, (2 * N_DOF,)), self.rows.shape[0]
        a, road = _checked_copy("acceleration", acceleration, (steps, N_DOF)), np.empty((steps, 16))
        propagate_adjoint(self.plant.constants, self.rows, a, self.h, y, road)
        return y, road.reshape(2 * steps, 2, 4)


def linearize_drive(
    plant: Plant,
    strut_state: np.ndarray,
    start: np.ndarray,
    road: np.ndarray,
    h: float,
    a_xy: np.ndarray | None = None,
    *,
    commands: np.ndarray | None = None,
    lag: float = 0.01,
) -> Tape:
    """Simulate N steps of `h` [s] from the state `start` (14,) and record the derivative.

    `strut_state` (4, 3) at the start; `road` (2 N, 2, 4): heights [m] and rates [m/s] under the
    wheels at the beginning and the middle of each step; `a_xy` (2 N, 2), if given, a_x and a_y
    [m/s²] of a manoeuvre at the same times; `commands` (N,), if given, the bytes that reach the
    valves, of time constant `lag` [s]. Without commands the strut state stays constant. Raises
    ValueError on a wrong shape, ArithmeticError if the motion diverges.
    """
    road = np.asarray(road, dtype=float)
    steps = len(road) // 2
    z, y = (
        _checked_copy("road", road, (2 * steps, 2, 4)),
        _checked_copy("start", start, (2 * plant.inertias.size,)),
    )
    a_xy_steps = _checked_copy(
        "a_xy", np.zeros((2 * steps, 2)) if a_xy is None else a_xy, (2 * steps, 2)
    )
    strut_state_end = _checked_copy("strut_state", strut_state, (4, 3))
    signals, rows = np.empty((steps, n_signals(plant))), np.empty((steps, TAPE_ROW_SIZE))
    bytes_ = np.zeros(0) if commands is None else _checked_copy("commands", commands, (steps,))
    course = z.reshape(steps, 16), a_xy_steps.reshape(steps, 4)
    inputs = TapeInputs(*course, bytes_.astype(np.uint8), float(lag), float(h))
    # no argument for a rigid frame: its kernel then compiles without flexible_step
    flexible = (True,) if plant.flexible else ()
    buffers = plant.buffers(strut_state_end)
    integrate_with_derivative(buffers, y, inputs, signals, rows, *flexible)
    if not np.isfinite(y).all():
        raise ArithmeticError("the motion diverged (no longer finite); check the road and start")
    return Tape(plant, float(h), signals, y, strut_state_end, rows)
