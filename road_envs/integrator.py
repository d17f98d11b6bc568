"""Fixed-step integration of the vehicle over a surface: a two-stage Rosenbrock method.

The method is the second-order formula of Shampine & Reichelt's `ode23s` (1997, "The MATLAB ODE
suite", SIAM J. Sci. Comput. 18, eq. 3.1), the paper's integrator, at a constant step:

    W = I - h d J,   d = 1 / (2 + sqrt 2),   T = df/dt
    W k_1 = F(t, y) + h d T
    W (k_2 - k_1) = F(t + h/2, y + h k_1 / 2) - k_1
    y(t + h) = y + h k_2

It is of order 2 and L-stable. With coordinates q, rates v and generalised forces f, k = (k_q, k_v)
and each stage reduces to the seven rates: k_q = r_q + h d k_v, with

    (M + h d C + (h d)² K) k_v = f + h d df/dt - h d K r_q

where K = -df/dq, C = -df/dv. K and C are sums over struts and tyres, so the products with them are
taken force by force, and the matrix is never assembled: each axle is eliminated as a 2 x 2 block,
which leaves a 3 x 3 system in the body (Schur complement).
"""

from typing import NamedTuple

import numpy as np

from road_envs.dynamics import (
    AXLE,
    N_DOF,
    PHI,
    THETA,
    Z_B,
    accelerations,
    add_lean,
    add_struts,
    add_tyres,
    add_weight,
    extension,
    wheel_height,
)
from road_envs.jit import kernel
from road_envs.roads.surface import height_and_slope
from road_envs.suspension import settled, strut_force, switch, tyre_force
from road_envs.vehicle import GRAVITY

D = 1.0 / (2.0 + np.sqrt(2.0))

STATE, ACCELERATION, EXTENSION, LOAD = 0, 14, 21, 25
SIGNALS = 29
"""Columns of the output: state (14), accelerations (7), strut extensions (4), tyre loads (4)."""


@kernel
def eliminate(p, s, t, hd, blocks, body):
    """Factor M + h d C + (h d)² K: axles to `blocks` (2, 6), the body's LDL' to `body` (6,).

    `s`, `t` (4,) are h d c + (h d)² k of each strut and tyre. A row of `blocks` holds N, the
    inverse of the axle's own block (n00, n01, n11), and S (s0, s1, s2), where -S P is its coupling
    with the body and P takes the body's coordinates to heave and roll at the axle. The body is left
    with M_b + sum P' (S - S N S) P.
    """
    a00, a01, a02, a12 = p.M[Z_B], 0.0, 0.0, 0.0
    a11 = p.M[PHI] - hd * hd * p.roll_moment * GRAVITY
    a22 = p.M[THETA] - hd * hd * p.pitch_moment * GRAVITY
    for i in range(2):
        left, right = 2 * i, 2 * i + 1
        s0, t0 = s[left] + s[right], t[left] + t[right]
        s1, s2 = p.y_s[left] * (s[left] - s[right]), p.y_s[left] ** 2 * s0
        t1, t2 = p.y_t[left] * (t[left] - t[right]), p.y_t[left] ** 2 * t0
        b00, b01, b11 = p.M[AXLE + 2 * i] + s0 + t0, s1 + t1, p.M[AXLE + 2 * i + 1] + s2 + t2
        det = 1.0 / (b00 * b11 - b01 * b01)
        n00, n01, n11 = b11 * det, -b01 * det, b00 * det
        blocks[i, 0], blocks[i, 1], blocks[i, 2] = n00, n01, n11
        blocks[i, 3], blocks[i, 4], blocks[i, 5] = s0, s1, s2
        m00, m01 = n00 * s0 + n01 * s1, n00 * s1 + n01 * s2
        m10, m11 = n01 * s0 + n11 * s1, n01 * s1 + n11 * s2
        r00, r01, r11 = s0 - s0 * m00 - s1 * m10, s1 - s0 * m01 - s1 * m11, s2 - s1 * m01 - s2 * m11
        x = p.x[i]
        a00 += r00
        a01 += r01
        a02 -= x * r00
        a11 += r11
        a12 -= x * r01
        a22 += x * x * r00
    body[0] = 1.0 / a00
    body[1] = a01 * body[0]
    body[2] = a02 * body[0]
    body[3] = 1.0 / (a11 - a01 * body[1])
    low = a12 - a01 * body[2]
    body[4] = low * body[3]
    body[5] = 1.0 / (a22 - a02 * body[2] - low * body[4])


@kernel
def solve(p, blocks, body, g):
    """Solve for the rates (7,) in place of the right-hand side `g` (7,)."""
    for i in range(2):
        a = AXLE + 2 * i
        n00, n01, n11, s0, s1, s2 = blocks[i]
        h0, h1 = n00 * g[a] + n01 * g[a + 1], n01 * g[a] + n11 * g[a + 1]
        g[a], g[a + 1] = h0, h1
        push = s0 * h0 + s1 * h1
        g[Z_B] += push
        g[PHI] += s1 * h0 + s2 * h1
        g[THETA] -= p.x[i] * push
    g[PHI] -= body[1] * g[Z_B]
    g[THETA] -= body[2] * g[Z_B] + body[4] * g[PHI]
    g[THETA] *= body[5]
    g[PHI] = g[PHI] * body[3] - body[4] * g[THETA]
    g[Z_B] = g[Z_B] * body[0] - body[1] * g[PHI] - body[2] * g[THETA]
    for i in range(2):
        a = AXLE + 2 * i
        n00, n01, n11, s0, s1, s2 = blocks[i]
        heave, roll = g[Z_B] - p.x[i] * g[THETA], g[PHI]
        f0, f1 = s0 * heave + s1 * roll, s1 * heave + s2 * roll
        g[a] += n00 * f0 + n01 * f1
        g[a + 1] += n01 * f0 + n11 * f1


class Work(NamedTuple):
    """Scratch of one vehicle: right-hand sides (7,), stage values (7,), wheels (4,), factors."""

    f: np.ndarray
    g: np.ndarray
    r: np.ndarray
    k_q: np.ndarray
    q: np.ndarray
    v: np.ndarray
    F: np.ndarray
    T: np.ndarray
    dF: np.ndarray
    dT: np.ndarray
    k: np.ndarray
    k_t: np.ndarray
    s: np.ndarray
    t: np.ndarray
    blocks: np.ndarray
    body: np.ndarray


@kernel
def workspace():
    """Scratch for `step`."""
    a, b = np.empty((6, N_DOF)), np.empty((8, 4))
    stages = (a[0], a[1], a[2], a[3], a[4], a[5])
    wheels = (b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7])
    return Work(*stages, *wheels, np.empty((2, 6)), np.empty(6))


@kernel
def step(numbers, velocity, displacement, memory, y, road, turn, h, work, out):
    """Advance the state `y` (14,) by `h` [s]; write the signals at its beginning to `out` (29,).

    `road` (2, 2, 4): heights [m] and their rates [m/s] under the wheels at t and at t + h/2.
    `turn` (2, 2): accelerations a_x, a_y [m/s²] of a manoeuvre at these two instants.
    """
    p, hd = numbers[0], h * D
    f, g, r, k_q = work.f, work.g, work.r, work.k_q
    q, v = y[:N_DOF], y[N_DOF:]
    F, T, dF, dT = work.F, work.T, work.dF, work.dT
    for w in range(4):
        e, e_dot = extension(p, q, w), extension(p, v, w)
        F[w], k, c = strut_force(p, velocity, displacement, memory, w, e, e_dot)
        u = road[0, 0, w] - wheel_height(p, q, w)
        u_dot = road[0, 1, w] - wheel_height(p, v, w)
        T[w], k_t, c_t = tyre_force(p, w // 2, u, u_dot)
        w_dot = (road[1, 1, w] - road[0, 1, w]) / (0.5 * h)
        dF[w], dT[w] = -hd * k * e_dot, hd * (k_t * u_dot + c_t * w_dot)
        work.k[w], work.k_t[w] = k, k_t
        work.s[w], work.t[w] = hd * (c + hd * k), hd * (c_t + hd * k_t)
        out[EXTENSION + w], out[LOAD + w] = e, T[w]
    f[:] = 0.0
    add_weight(p, f)
    add_struts(p, F, f)
    add_tyres(p, T, f)
    add_lean(p, q[PHI], q[THETA], turn[0, 0], turn[0, 1], f)
    for j in range(N_DOF):
        g[j] = f[j]
    add_struts(p, dF, g)
    add_tyres(p, dT, g)
    x_dot, y_dot = (turn[1, 0] - turn[0, 0]) / (0.5 * h), (turn[1, 1] - turn[0, 1]) / (0.5 * h)
    add_lean(p, hd * v[PHI], hd * v[THETA], hd * x_dot, hd * y_dot, g)
    for j in range(N_DOF):
        out[STATE + j], out[STATE + N_DOF + j] = q[j], v[j]
        out[ACCELERATION + j] = f[j] / p.M[j]

    eliminate(p, work.s, work.t, hd, work.blocks, work.body)
    solve(p, work.blocks, work.body, g)
    for j in range(N_DOF):
        k_q[j] = v[j] + hd * g[j]
        work.q[j] = q[j] + 0.5 * h * k_q[j]
        work.v[j] = v[j] + 0.5 * h * g[j]
        r[j] = work.v[j] - k_q[j]
        f[j] = -p.M[j] * g[j]
    for w in range(4):
        e, e_dot = extension(p, work.q, w), extension(p, work.v, w)
        F[w] = strut_force(p, velocity, displacement, memory, w, e, e_dot)[0]
        F[w] -= hd * work.k[w] * extension(p, r, w)
        u = road[1, 0, w] - wheel_height(p, work.q, w)
        u_dot = road[1, 1, w] - wheel_height(p, work.v, w)
        T[w] = tyre_force(p, w // 2, u, u_dot)[0]
        T[w] -= hd * work.k_t[w] * wheel_height(p, r, w)
    add_weight(p, f)
    add_struts(p, F, f)
    add_tyres(p, T, f)
    phi, theta = work.q[PHI] + hd * r[PHI], work.q[THETA] + hd * r[THETA]
    add_lean(p, phi, theta, turn[1, 0], turn[1, 1], f)
    solve(p, work.blocks, work.body, f)
    for j in range(N_DOF):
        q[j] += h * (k_q[j] + r[j] + hd * f[j])
        v[j] += h * (g[j] + f[j])


@kernel
def look_at_road(p, padded, start, ds, s, v, road):
    """Heights and their rates (2, 4) under the wheels with the front axle at `s` [m]."""
    for w in range(4):
        behind = p.x[0] - p.x[w // 2]
        z, slope = height_and_slope(padded, w % 2, s - behind, start, ds)
        road[0, w], road[1, w] = z, slope * v


@kernel
def state_rate(numbers, velocity, displacement, memory, padded, start, ds, s, v, y, out):
    """Rate (14,) of the state `y` with the front axle at `s` [m], struts as `memory` holds them.

    The right-hand side for other integrators; it writes to `out`.
    """
    road = np.empty((2, 4))
    look_at_road(numbers[0], padded, start, ds, s, v, road)
    q, rates = y[:N_DOF], y[N_DOF:]
    out[:N_DOF] = rates
    accelerations(numbers, velocity, displacement, memory, q, rates, road[0], road[1], out[N_DOF:])


@kernel
def drive(
    numbers, velocity, displacement, memory, y, padded, start, ds, s, v, turn, commands, lag, h, out
):
    """Drive len(commands) steps of `h` [s]; `y` (14,) and `memory` (4, 3) end as they stand then.

    `padded`, `start`, `ds`: a Surface. At every half step: `s`, `v` (2 N + 1,), station of the
    front axle [m] and speed [m/s]; `turn` (2 N + 1, 2), a_x and a_y [m/s²] of a manoeuvre.
    `commands` (N,): bytes as they reach the valves, whose time constant is `lag` [s]. `out`
    (N, 29): the signals at the beginning of each step.
    """
    p, work, road = numbers[0], workspace(), np.empty((2, 2, 4))
    alpha = 1.0 - np.exp(-h / lag)
    for n in range(commands.size):
        look_at_road(p, padded, start, ds, s[2 * n], v[2 * n], road[0])
        look_at_road(p, padded, start, ds, s[2 * n + 1], v[2 * n + 1], road[1])
        for w in range(4):
            stiff, high = (commands[n] >> w) & 1, (commands[n] >> (4 + w)) & 1
            if not settled(memory, w, stiff, high):
                switch(p, memory, w, extension(p, y, w), stiff, high, alpha, h)
        between = turn[2 * n : 2 * n + 2]
        step(numbers, velocity, displacement, memory, y, road, between, h, work, out[n])
