"""Tangent and adjoint of the fixed step: what a small change of road and start does to a drive.

`integrator.step` is a map of the state y = (q, v) and of the road's heights and rates at both stage
times. Its derivative is taken exactly, as the step is computed and not as the motion would be. With
W = M + h d C + (h d)² K symmetric, k and m the two solutions W k = g(y), W m = f(y, k), and ' a
derivative along a direction,

    W k' = g' - W' k,        W m' = f' - W' m,        W' = sum over struts and tyres of s' b b'

b takes coordinates to the strut's extension and s = h d c + (h d)² k, so s' needs the change of the
strut's stiffness k with its extension (gas spring, bushing, stop) and of its damping c with the
rate (damper, friction). For a tyre b takes them to the height of the wheel, and its stiffness
changes with its compression, on which the road acts as well. The adjoint is the same chain
backwards; as W is symmetric it needs no solver of its own (Giles & Pierce 2000,
doi:10.1023/A:1011430410075, section 2).

At a kink (a wheel that lifts off, a tyre whose damper gives all it may, a grid point or an end of a
table, the shortest gas column) the derivative is that of the branch the step took; the small jump
of W where a tyre lifts off has no derivative and is left out. A car exactly at rest stands on such
a kink: friction bends one way for a strut that opens and the other way for one that closes. The
struts' memory goes on with the drive as its commands ask, and its derivative is left out: a switch
freezes an extension in, and that this one depends on the road before the switch is neglected. Nor
does the frame twist: a flexible car is refused.

One row of the tape (ROW,) is all that both need of one step. Per strut (4 each): K_1, C_1 and K_2,
C_2, its stiffness and damping at the first and the second stage; G_K, G_C and F_K, F_C, what the
first and the second right-hand side lose by a change of e and of e_dot at the step's beginning
(of F_K, F_C without K_2, C_2). Per tyre: TK_1, TC_1 and TK_2, TC_2, the same; G_U, what the first
gains by a change of the compression u, and F_U, what the second loses by it without TK_2. Then the
factors of W.
"""

from dataclasses import dataclass

import numpy as np

from road_envs._numba import kernel
from road_envs.simulation.rosenbrock import (
    ACCELERATION,
    EXTENSION,
    N_SIGNALS,
    D,
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
    Plant,
    add_manoeuvre_moments,
    add_struts,
    add_tyres,
    extension,
    relative_roll,
    wheel_height,
)
from road_envs.vehicle.suspension import strut_curvature, strut_force, tyre_curvature, tyre_force

K_1, C_1, K_2, C_2, G_K, G_C, F_K, F_C = range(0, 32, 4)
TK_1, TC_1, TK_2, TC_2, G_U, F_U, BLOCKS, BODY = *range(32, 60, 4), 68
TAPE_ROW_SIZE = 74


@kernel
def step_with_derivative(
    p, velocity, displacement, strut_state, q, v, road, a_xy, h, work, out, row
):
    """Take `integrator.step`, with its arguments, and write its derivative to `row` (ROW,)."""
    step(p, velocity, displacement, strut_state, q, v, road, a_xy, h, work, out)
    hd, before = h * D, out[N_DOF : 2 * N_DOF]
    for w in range(4):
        e, e_dot = out[EXTENSION + w], extension(p, before, w)
        k, c = work.k[w], work.s[w] / hd - hd * work.k[w]  # as the step has left them
        k_slope, c_slope = strut_curvature(p, velocity, displacement, strut_state, w, e, e_dot)
        first, second = extension(p, work.g, w), extension(p, work.f, w)
        row[K_1 + w], row[C_1 + w] = k, c
        row[G_K + w] = k + hd * k_slope * (e_dot + hd * first)
        row[G_C + w] = c + hd * k + hd * c_slope * first
        row[F_K + w] = hd * k_slope * (extension(p, work.r, w) + hd * second)
        row[F_C + w] = hd * c_slope * second
        e, e_dot = extension(p, work.q, w), extension(p, work.v, w)
        _, row[K_2 + w], row[C_2 + w] = strut_force(
            p, velocity, displacement, strut_state, w, e, e_dot
        )
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
def tangent_step(p, row, q, v, road, h, work, a):
    """Carry changes `q`, `v` (7,) of coordinates and rates through one step, in place.

    `road` (16,): changes of the heights [m] and rates [m/s] as `integrator.step` has them. Writes
    the change of the accelerations (7,) at the step's beginning to `a`. LANES changes at once have
    lanes as the last axis of all but `p` and `row`.
    """
    hd = h * D
    f, g, r, k_q, F, T, dF, dT = work.f, work.g, work.r, work.k_q, work.F, work.T, work.dF, work.dT
    blocks, body = row[BLOCKS:BODY], row[BODY:TAPE_ROW_SIZE]
    for w in range(4):
        e, e_dot = extension(p, q, w), extension(p, v, w)
        put(F, w, -row[K_1 + w] * e - row[C_1 + w] * e_dot)
        put(dF, w, -row[G_K + w] * e - row[G_C + w] * e_dot)
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
        force = -row[K_2 + w] * e - row[C_2 + w] * e_dot
        put(F, w, force - hd * row[K_1 + w] * extension(p, r, w) - get(work.s, w))
        u = get(road, 8 + w) - wheel_height(p, work.q, w)
        u_dot = get(road, 12 + w) - wheel_height(p, work.v, w)
        load = row[TK_2 + w] * u + row[TC_2 + w] * u_dot
        put(T, w, load - hd * row[TK_1 + w] * wheel_height(p, r, w) - get(work.t, w))
    front = relative_roll(work.q, 0) + hd * relative_roll(r, 0)
    rear = relative_roll(work.q, 1) + hd * relative_roll(r, 1)
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
    """The second stage backwards, from the adjoint `work.f` (7,) of m'.

    Completes the adjoints `work.g`, `work.k_q` of the first stage, which hold the end's share, as
    does `work.r`; writes those of the stage's coordinates and rates to `work.q` and `work.v`, of
    extensions and their rates at the beginning to `work.dF` and `work.dT`, and of `road` the second
    stage's half, with the heights' share in it before that.
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
def adjoint_step(p, row, a, h, work, q, v, road):
    """The transpose of `tangent_step`: adjoints `q`, `v` (7,) of the state, a step back in place.

    `a` (7,): the adjoint of the accelerations at the step's beginning. Writes the adjoint of the
    road's heights and rates, laid out as there, to `road` (16,).
    """
    hd = h * D
    f, g, F, T = work.f, work.g, work.F, work.T
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
        first, at_once = extension(p, g, w), extension(p, f, w)
        work.dF[w] -= row[G_K + w] * first + row[K_1 + w] * at_once
        work.dT[w] -= row[G_C + w] * first + row[C_1 + w] * at_once
        first, at_once = wheel_height(p, g, w), wheel_height(p, f, w)
        z = row[G_U + w] * first + k_t * at_once + road[w]
        z_dot = c_t * (first + at_once) + hd * k_t * first
        difference = 2.0 * D * c_t * first
        road[w], road[4 + w] = z, z_dot - difference
        road[12 + w] += difference
        F[w], T[w] = -z, -z_dot
    front, rear = relative_roll(g, 0), relative_roll(g, 1)
    add_struts(p, work.dF, front + relative_roll(f, 0), rear + relative_roll(f, 1), q)
    add_tyres(p, F, q)
    add_struts(p, work.dT, hd * front, hd * rear, v)
    add_tyres(p, T, v)


@kernel
def integrate_with_derivative(
    constants, velocity, displacement, strut_state, y, road, a_xy, commands, lag, h, out, rows
):
    """Take one step per row of `rows` (N, TAPE_ROW_SIZE); `y` (14,), `strut_state` change in place.

    `road` (N, 16), `a_xy` (N, 4): what `integrator.step` reads in each step; `commands` (N,), or
    (0,) for none, and `lag` as `integrator.drive` has them.
    """
    p, work, q, v = constants[0], workspace(), y[:N_DOF], y[N_DOF:]
    alpha = 1.0 - np.exp(-h / lag)
    for n in range(rows.shape[0]):
        if commands.size > 0:
            update_valves(p, strut_state, q, commands[n], alpha, h)
        step_with_derivative(
            *(p, velocity, displacement, strut_state, q, v),
            *(road[n], a_xy[n], h, work, out[n], rows[n]),
        )


@kernel
def propagate_tangent(constants, rows, y, road, h, a):
    """`tangent_step` from the first row to the last; changes of accelerations to `a` (N, 7)."""
    p, work, q, v = constants[0], workspace(), y[:N_DOF], y[N_DOF:]
    for n in range(rows.shape[0]):
        tangent_step(p, rows[n], q, v, road[n], h, work, a[n])


@kernel
def propagate_adjoint(constants, rows, a, h, y, road):
    """`adjoint_step` from the last row to the first; adjoint of the road to `road` (N, 16)."""
    p, work, q, v = constants[0], workspace(), y[:N_DOF], y[N_DOF:]
    for n in range(rows.shape[0] - 1, -1, -1):
        adjoint_step(p, rows[n], a[n], h, work, q, v, road[n])


def _checked_copy(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A fresh copy of `value`; kernels believe in shapes, so a wrong one ends here."""
    copy = np.array(value, dtype=float)
    if copy.shape != shape:
        raise ValueError(f"{name} must be of shape {shape}, got {copy.shape}")
    return copy


@dataclass(frozen=True, eq=False)
class Tape:
    """A drive of N steps and its derivative: 592 bytes a step, however often it is applied.

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
        return self.signals[:, ACCELERATION : ACCELERATION + N_DOF]

    def tangent(self, start: np.ndarray, road: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the accelerations (N, 7) and of the end (14,) to first order.

        `start` (14,): change of the first state; `road` (2 N, 2, 4): change of the heights [m] and
        of their rates [m/s] under the wheels at the beginning and the middle of each step.
        """
        y, steps = _checked_copy("start", start, (2 * N_DOF,)), self.rows.shape[0]
        z = _checked_copy("road", road, (2 * steps, 2, 4)).reshape(steps, 16)
        a = np.empty((steps, N_DOF))
        propagate_tangent(self.plant.constants, self.rows, y, z, self.h, a)
        return a, y

    def adjoint(self, acceleration: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A cost's gradients by the start (14,) and by the road (2 N, 2, 4): the transpose.

        `acceleration` (N, 7), `end` (14,): its gradients by what `tangent` returns.
        """
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
    commands: np.ndarray | None = None,
    lag: float = 0.01,
) -> Tape:
    """Drive from the state `start` (14,) in steps of `h` [s] and tape the derivative.

    `strut_state` (4, 3) of the struts at the start; `road` (2 N, 2, 4): heights [m] and their rates
    [m/s] under the wheels at the beginning and the middle of each step; `a_xy` (2 N, 2), if given,
    a_x and a_y [m/s²] of a manoeuvre at the same instants; `commands` (N,), if given, the bytes
    that reach the valves, of time constant `lag` [s]: without them the memory stands still. Raises
    ValueError on a wrong shape and on a flexible car, ArithmeticError if the motion is no longer
    finite.
    """
    if plant.flexible:
        raise ValueError(
            "a car with a flexible frame has no tape: its twist has no derivative here"
        )
    road = np.asarray(road, dtype=float)
    steps = len(road) // 2
    z, y = (
        _checked_copy("road", road, (2 * steps, 2, 4)),
        _checked_copy("start", start, (2 * N_DOF,)),
    )
    a_xy_steps = _checked_copy(
        "a_xy", np.zeros((2 * steps, 2)) if a_xy is None else a_xy, (2 * steps, 2)
    )
    strut_state_end = _checked_copy("strut_state", strut_state, (4, 3))
    signals, rows = np.empty((steps, N_SIGNALS)), np.empty((steps, TAPE_ROW_SIZE))
    bytes_ = np.zeros(0) if commands is None else _checked_copy("commands", commands, (steps,))
    valves = bytes_.astype(np.uint8), float(lag)
    course = z.reshape(steps, 16), a_xy_steps.reshape(steps, 4)
    integrate_with_derivative(
        *plant.arrays, strut_state_end, y, *course, *valves, float(h), signals, rows
    )
    if not np.isfinite(y).all():
        raise ArithmeticError("the motion is no longer finite, so it has no derivative")
    return Tape(plant, float(h), signals, y, strut_state_end, rows)
