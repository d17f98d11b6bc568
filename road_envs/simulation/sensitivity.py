"""Tangent of the fixed step: sensitivity of a drive to its road and initial state.

`rosenbrock.step` maps the state y = (q, v) and the road's heights and rates at both stage times to
the next state. The derivative is that of the discrete step, exact up to rounding. With symmetric
W = M + h d C + (h d)² K, k and m the solutions of W k = g(y) and W m = f(y, k), and ' a
directional derivative,

    W k' = g' - W' k,        W m' = f' - W' m,        W' = sum over struts and tyres of s' b b'

For a strut, b maps coordinates to its extension and s = h d c + (h d)² k. So s' contains the
change of the stiffness k with the extension (gas spring, bushing, stop) and of the damping c with
its rate (damper, friction). For a tyre, b maps coordinates to the height of the wheel; its
stiffness changes with its compression, which depends on the road as well.

Limits. At a kink (wheel lift-off, limit of the tyre's damper, grid point or end of a table,
shortest gas column) the derivative is that of the branch taken by the step; the small jump of W at
lift-off is neglected. A vehicle exactly at rest is at such a kink, because the friction law has
opposite curvature for opening and closing struts. The strut state follows the commands, but its
derivative is neglected: the dependence of a held extension on the road before the switch is
missing. Side motion is linear but for the product of load and side speed of each axle; its change
by the speed of the drive is neglected.

One row of the tape (TAPE_ROW_SIZE,) holds the derivative of one step. Per strut (4 each): K_1, C_1
and K_2, C_2, stiffness and damping at stages 1 and 2; G_K, G_C and F_K, F_C, minus the derivatives
of the right-hand sides of stages 1 and 2 by e and e_dot at the step's beginning (F_K, F_C without
the contributions of K_2, C_2). Per tyre: TK_1, TC_1, TK_2, TC_2 likewise; G_U, the derivative of
the first right-hand side by the compression u, and F_U, minus that of the second without TK_2.
Then come the factors of W, and with side motion load shares and side speeds at the contacts of both
axles (2 each) at stage 1 and at stage 2.
"""

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd_arrays import add, get, put
from road_envs.simulation.block_elimination import solve_factored
from road_envs.simulation.rosenbrock import EXTENSION, LOAD, SIDE, TWIST, D, any_step
from road_envs.vehicle import equations as eq
from road_envs.vehicle import side_motion as sm
from road_envs.vehicle.equations import N_DOF, PHI, THETA
from road_envs.vehicle.suspension import strut_curvature, strut_force
from road_envs.vehicle.tyres import tyre_curvature, tyre_force

K_1, C_1, K_2, C_2, G_K, G_C, F_K, F_C = range(0, 32, 4)
TK_1, TC_1, TK_2, TC_2, G_U, F_U, BLOCKS, BODY = *range(32, 60, 4), 68
SHARE, SLIP, TAPE_ROW_SIZE = 74, 78, 82


@kernel
def step_with_derivative(vehicle, motion, inputs, work, out, row, flexible=None, side=None):
    """Take `rosenbrock.any_step`; write its derivative to `row` (TAPE_ROW_SIZE,)."""
    road, h = inputs.road, inputs.h
    p, hd, before = vehicle.constants[0], h * D, out[N_DOF : 2 * N_DOF]
    psi_dot = psi_mid = psi_mid_dot = 0.0
    any_step(vehicle, motion, inputs, work, out, flexible, side)
    if flexible is not None:
        psi_dot, moment = out[TWIST + 1], p.frame_inertia * out[TWIST + 2]
        k_v = (moment - hd * p.frame_rate * psi_dot) * _inverse_frame(p, hd)
        psi_mid = out[TWIST] + 0.5 * h * (psi_dot + hd * k_v)
        psi_mid_dot = psi_dot + 0.5 * h * k_v
    for w in range(4):
        e, e_dot = out[EXTENSION + w], eq.extension(p, before, w)
        twist_rate = eq.twist_extension(p, psi_dot, w)
        # `step` leaves k and s = h d c + (h d)² k in its scratch: no second call of strut_force
        k, c = work.k[w], work.s[w] / hd - hd * work.k[w]
        k_slope, c_slope = strut_curvature(vehicle, w, e, e_dot + twist_rate)
        first, second = eq.extension(p, work.g, w), eq.extension(p, work.f, w)
        row[K_1 + w], row[C_1 + w] = k, c
        row[G_K + w] = k + hd * k_slope * (e_dot + hd * first)
        row[G_C + w] = c + hd * k + hd * c_slope * first
        row[F_K + w] = hd * k_slope * (eq.extension(p, work.r, w) + hd * second)
        row[F_C + w] = hd * c_slope * second
        e = eq.extension(p, work.q, w) + eq.twist_extension(p, psi_mid, w)
        e_dot = eq.extension(p, work.v, w) + eq.twist_extension(p, psi_mid_dot, w)
        _, row[K_2 + w], row[C_2 + w] = strut_force(vehicle, w, e, e_dot)
        u, u_dot = road[w] - eq.wheel_height(p, out, w), road[4 + w] - eq.wheel_height(p, before, w)
        _, k, c = tyre_force(p, w, u, u_dot)
        k_slope = tyre_curvature(p, w, u, u_dot)
        first, second = eq.wheel_height(p, work.g, w), eq.wheel_height(p, work.f, w)
        row[TK_1 + w], row[TC_1 + w] = k, c
        row[G_U + w] = k + hd * k_slope * (u_dot - hd * first)
        row[F_U + w] = hd * k_slope * (eq.wheel_height(p, work.r, w) + hd * second)
        u = road[8 + w] - eq.wheel_height(p, work.q, w)
        u_dot = road[12 + w] - eq.wheel_height(p, work.v, w)
        _, row[TK_2 + w], row[TC_2 + w] = tyre_force(p, w, u, u_dot)
    # element by element: an assignment of slices takes as long as the rest of the derivative
    for k in range(BODY - BLOCKS):
        row[BLOCKS + k] = work.blocks[k]
    for k in range(SHARE - BODY):
        row[BODY + k] = work.body[k]
    if side is not None:
        V, r, w_f, w_r = out[SIDE + 4], out[SIDE + 5], out[SIDE + 6], out[SIDE + 7]
        state = out[SIDE], out[SIDE + 1], out[SIDE + 2], out[SIDE + 3], V, r, w_f, w_r
        row[SHARE], row[SHARE + 1] = sm.load_shares(p, out[LOAD : LOAD + 4])
        row[SLIP], row[SLIP + 1] = sm.contact_speeds(p, sm.rolls(before), state)
        a = out[SIDE + 8 : SIDE + 12]  # behind the state
        state = sm.side_middle(state, (0.0, 0.0, 0.0, 0.0, a[0], a[1], a[2], a[3]), h)
        row[SHARE + 2], row[SHARE + 3] = sm.load_shares(p, work.dT)
        row[SLIP + 2], row[SLIP + 3] = sm.contact_speeds(p, sm.rolls(work.v), state)


@kernel
def _slip_change(p, row, stage, roll_rates, state, T):
    """Return the change of l_a u_a of both axles, by those of rates, state and loads `T` (4,)."""
    u, share, k = sm.contact_speeds(p, roll_rates, state), sm.load_shares(p, T), 2 * stage
    front = row[SHARE + k] * u[0] + row[SLIP + k] * share[0]
    return front, row[SHARE + k + 1] * u[1] + row[SLIP + k + 1] * share[1]


@kernel
def _inverse_frame(p, hd):
    """Return the inverse of the frame's share of W."""
    return 1.0 / (p.frame_inertia + hd * (p.frame_damping + hd * p.frame_rate))


@kernel
def tangent_step(p, row, motion, inputs, work, a, flexible=None, side=None):
    """Propagate changes `motion` of coordinates and rates through one step, in place.

    `inputs`: changes of the StepInputs' road; `a_xy` is not read. The change of the accelerations
    (7,) at the step's beginning goes to `a`; a `flexible` vehicle has (8,), `side` motion two more.
    For LANES directions at once all arrays but `p` and `row` have the lanes as their last axis.
    """
    (q, v), road, h = motion, inputs.road, inputs.h
    hd = h * D
    f, g, r, k_q, F, T, dF, dT = work.f, work.g, work.r, work.k_q, work.F, work.T, work.dF, work.dT
    blocks, body = row[BLOCKS:BODY], row[BODY:SHARE]
    # stage 1: F, T give f'; dF, dT give g' - W' k; s, t keep what stage 2 needs of the state at t
    for w in range(4):
        e, e_dot = eq.extension(p, q, w), eq.extension(p, v, w)
        held = 0.0 * e
        if flexible is not None:
            twist_rate = eq.twist_extension(p, get(v, N_DOF), w)
            e, e_dot = e + eq.twist_extension(p, get(q, N_DOF), w), e_dot + twist_rate
            held = hd * row[K_1 + w] * twist_rate  # W leaves out the twist
        put(F, w, -row[K_1 + w] * e - row[C_1 + w] * e_dot)
        put(dF, w, held - row[G_K + w] * e - row[G_C + w] * e_dot)
        put(work.s, w, row[F_K + w] * e + row[F_C + w] * e_dot)
        k_t, c_t = row[TK_1 + w], row[TC_1 + w]
        u = get(road, w) - eq.wheel_height(p, q, w)
        u_dot = get(road, 4 + w) - eq.wheel_height(p, v, w)
        rise = (2.0 * D * c_t) * (get(road, 12 + w) - get(road, 4 + w))
        put(T, w, k_t * u + c_t * u_dot)
        put(dT, w, row[G_U + w] * u + (c_t + hd * k_t) * u_dot + rise)
        put(work.t, w, row[F_U + w] * u)
    for j in range(N_DOF):
        put(f, j, 0.0)
        put(g, j, 0.0)
    front, rear = eq.relative_roll(q, 0), eq.relative_roll(q, 1)
    if flexible is not None:
        psi, psi_dot = get(q, N_DOF), get(v, N_DOF)
        front, rear = front + p.twist_share[0] * psi, rear + p.twist_share[1] * psi
        moment = eq.twist_moment(p, F, front, rear) - p.frame_rate * psi - p.frame_damping * psi_dot
        put(a, N_DOF, moment / p.frame_inertia)
        t_v = (moment - hd * p.frame_rate * psi_dot) * _inverse_frame(p, hd)
        t_q = psi_dot + hd * t_v
        psi_mid, psi_mid_dot = psi + 0.5 * h * t_q, psi_dot + 0.5 * h * t_v
    eq.add_struts(p, F, front, rear, f)
    eq.add_tyres(p, T, f)
    eq.add_manoeuvre_moments(p, get(q, PHI), get(q, THETA), 0.0, 0.0, f)
    eq.add_struts(p, dF, front + hd * eq.relative_roll(v, 0), rear + hd * eq.relative_roll(v, 1), g)
    eq.add_tyres(p, dT, g)
    phi, theta = get(q, PHI) + hd * get(v, PHI), get(q, THETA) + hd * get(v, THETA)
    eq.add_manoeuvre_moments(p, phi, theta, 0.0, 0.0, g)
    if side is not None:  # f and g hold the moments alone, g those of W' k as well
        state = sm.side_state(q, v)
        slip = _slip_change(p, row, 0, sm.rolls(v), state, T)
        rates = sm.side_rates(p, sm.rolls(q), sm.rolls(f), state, slip, inputs.v, 0.0)
        sm.add_rolls(f, rates)
        sm.add_rolls(g, rates)
        slopes = sm.side_increments(p, rates, inputs.v, hd)
        middle = sm.side_middle(state, slopes, h)
        n = q.shape[0] - sm.side_size(q)
        put(a, n, rates[7])
        put(a, n + 1, rates[8])
        if sm.side_size(q) > 2:
            put(a, n + 2, rates[9])
            put(a, n + 3, rates[10])
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
        e, e_dot = eq.extension(p, work.q, w), eq.extension(p, work.v, w)
        if flexible is not None:
            e = e + eq.twist_extension(p, psi_mid, w)
            e_dot = e_dot + eq.twist_extension(p, psi_mid_dot, w)
        force = -row[K_2 + w] * e - row[C_2 + w] * e_dot
        put(dF, w, force)
        put(F, w, force - hd * row[K_1 + w] * eq.extension(p, r, w) - get(work.s, w))
        u = get(road, 8 + w) - eq.wheel_height(p, work.q, w)
        u_dot = get(road, 12 + w) - eq.wheel_height(p, work.v, w)
        load = row[TK_2 + w] * u + row[TC_2 + w] * u_dot
        put(T, w, load - hd * row[TK_1 + w] * eq.wheel_height(p, r, w) - get(work.t, w))
        if side is not None:
            put(dT, w, load)
    front, rear = eq.relative_roll(work.q, 0), eq.relative_roll(work.q, 1)
    if flexible is not None:
        front, rear = front + p.twist_share[0] * psi_mid, rear + p.twist_share[1] * psi_mid
        t_r = psi_mid_dot - t_q
        spring = p.frame_rate * (psi_mid + hd * t_r) + p.frame_damping * psi_mid_dot
        t_m = eq.twist_moment(p, dF, front, rear) - spring - p.frame_inertia * t_v
        t_m = t_m * _inverse_frame(p, hd)
        add(q, N_DOF, h * (t_q + t_r + hd * t_m))
        add(v, N_DOF, h * (t_v + t_m))
    if side is not None:
        moments = eq.roll_moments(p, dF, dT, front, rear)
        slip = _slip_change(p, row, 1, sm.rolls(work.v), middle, dT)
        rates = sm.side_rates(p, sm.rolls(work.q), moments, middle, slip, inputs.v, 0.0)
        sm.add_rolls(f, rates)
        sm.advance_side(p, motion, slopes, rates, inputs.v, h, hd)
    front, rear = front + hd * eq.relative_roll(r, 0), rear + hd * eq.relative_roll(r, 1)
    eq.add_struts(p, F, front, rear, f)
    eq.add_tyres(p, T, f)
    phi, theta = get(work.q, PHI) + hd * get(r, PHI), get(work.q, THETA) + hd * get(r, THETA)
    eq.add_manoeuvre_moments(p, phi, theta, 0.0, 0.0, f)
    solve_factored(p, blocks, body, f)
    for j in range(N_DOF):
        add(q, j, h * (get(k_q, j) + get(r, j) + hd * get(f, j)))
        add(v, j, h * (get(g, j) + get(f, j)))
