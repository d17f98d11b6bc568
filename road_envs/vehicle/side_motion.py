"""Side motion: the tyres hold the axles, and the axles' roll centres hold the body.

Without it (no `axles.SideMotion`) a body rolls about its centre of mass, as if the tyres could
slide sideways. With it, V is the side speed of the body's centre of mass and r the yaw rate, both
in axes that go with the vehicle at the speed v. With h_cg, h_a and R the heights of the centre of
mass, of the roll centre of axle a and of its wheels' centres, the contacts of axle a move sideways
at

    u_a = V + x_a r + (h_cg - h_a) phi' + h_a phi_a'

and its centre at u_a - R g_a', with g_a the camber of its wheels. That of a solid axle is its roll,
g_a = phi_a; independent wheels swing about centres at the distance l_a of the wheel, so that with
k_a = y_t / l_a

    g_a = (1 - k_a) phi + k_a phi_a

(Milliken & Milliken, "Race Car Vehicle Dynamics", 1995, chapter 17). The tyres deflect sideways by
d_a, which a relaxation length sigma of rolling undoes, and their force follows the deflection
(Pacejka, "Tire and Vehicle Dynamics", 2012, section 5.4, the linear contact line as a spring of
rate 2 C_alpha / sigma). C_alpha is the cornering stiffness under the static load, and grows with
the load (its ratio to the load, the cornering coefficient, is about constant: Gillespie,
"Fundamentals of Vehicle Dynamics", 1992, chapter 6), so that with l_a the load of the axle's tyres
over the static one

    d_a' = -l_a u_a - (v / sigma) d_a,      F_a = (2 C_alpha / sigma) d_a

It acts on V, r, phi and phi_a with the levers of u_a. At v = 0 the tyres are springs. The masses
m_a of the axles move with their centres, so that the accelerations of

    w = (phi, phi_front, phi_rear, V, r)

are M^-1 of the generalised forces, with one constant matrix M (5, 5). The static loads W_a of the
struts and of the tyres, which a body held at its roll centres leans over, add the moments

    sum W_a (h_cg - h_a) phi  to the body,      (W_a h_a + m_a g R k_a²) phi_a  to axle a

(k_a = 1 of a solid axle).

The joints that hold an axle in the body may give way: then it is at y_a beside its place, with the
rate w_a, which adds to u_a and to the speed of its wheels' centres, and is a sixth and a seventh
rate in M. The joints' force on it is -K_a y_a - c_a w_a; that the weight then stands beside the
axle is neglected.

Links keep the wheels below the body, so that they go fore and aft as it pitches (`fore_and_aft`).
Their masses add m_a (h_cg - R)² each to its pitch inertia, and its weight, which they stand under
no longer, the moment m_b g (h_cg - R) theta.

In a manoeuvre the vehicle's axes accelerate sideways by a_y, and the moments about the roll axis of
`equations` are left out: the tyres' forces make them. Yaw of a car that is steered is not modelled.

The state has d_front, d_rear behind the coordinates and V, r behind the rates; with joints that
give way y_front, y_rear and w_front, w_rear follow. In a step of `rosenbrock` the deflections are
implicit in their relaxation; all else of the side motion is explicit, the moments of inertia M^-1
too: the matrix W has those of the roll alone, which are smaller. The formula keeps order 2 with any
matrix in place of the Jacobian.
"""

import numpy as np

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd_arrays import add, get, put
from road_envs.vehicle.axles import IndependentWheels
from road_envs.vehicle.parameters import GRAVITY, VehicleParameters

ROLLS = (1, 4, 6)  # coordinates of the roll of the body, of the front and of the rear axle
RIGID_COORDINATES = 7  # coordinates of `equations`, without the twist of a frame
SIDE_FIELDS = [
    *((name, "f8", (2,)) for name in ("side_lever", "side_height", "side_rate", "relaxation")),
    ("load_share", "f8", (2,)),
    ("side_gravity", "f8", (3,)),
    ("side_inverse", "f8", (49,)),
    *((name, "f8", (2,)) for name in ("joint_stiffness", "joint_damping")),
]
"""Constants: h_cg - h_a, h_a, 2 C_alpha / sigma, sigma (0 without side motion), 1 over the static
load of an axle's tyres, the moments of the static loads per angle, M^-1 with zeros for joints that
are rigid, K_a and c_a."""


def side_constants(car: VehicleParameters) -> dict[str, object]:
    """Return the constants of a vehicle's side motion, which are 0 if it has none."""
    if car.side is None:
        return {}
    # wheels' centres move sideways with phi, phi_a, V and r, and add their mass to all four
    side, height = car.side, np.array(car.side.roll_centre)
    lever, x = car.h_cg - height, np.array([axle.x for axle in car.axles])
    m, arms = np.array([axle.m for axle in car.axles]), zip(car.axles, side.swing_arm, strict=True)
    # camber of the wheels per roll of the axle; the rest, 1 - k, is that per roll of the body
    k = np.array([a.y_t / arm if isinstance(a, IndependentWheels) else 1.0 for a, arm in arms])
    M = np.diag([car.I_xx, car.front.I_xx, car.rear.I_xx, car.m_b, side.I_zz, 0.0, 0.0])
    for a in range(2):
        centre = np.zeros(7)
        centre[[0, 3, 4]] = lever[a] - side.wheel_radius * (1.0 - k[a]), 1.0, x[a]
        centre[1 + a] = height[a] - side.wheel_radius * k[a]
        centre[5 + a] = 1.0
        M += m[a] * np.outer(centre, centre)
    moving, inverse = 7 if side.has_joints else 5, np.zeros((7, 7))
    inverse[:moving, :moving] = np.linalg.inv(M[:moving, :moving])
    load = 2.0 * np.array(car.strut_loads)
    leaning = load * height + m * GRAVITY * side.wheel_radius * k**2
    sigma = np.array(side.relaxation)
    return {
        "side_lever": lever,
        "side_height": height,
        "side_rate": 2.0 * np.array(side.C_alpha) / sigma,
        "relaxation": sigma,
        "load_share": 0.5 / np.array(car.tyre_loads),
        "side_gravity": [float(load @ lever), *leaning],
        "side_inverse": inverse.ravel(),
        "joint_stiffness": side.joint_stiffness,
        "joint_damping": side.joint_damping,
    }


@kernel
def rolls(q):
    """Return the entries of `q` (7,) for the roll of the body, the front and the rear axle."""
    return get(q, 1), get(q, 4), get(q, 6)


@kernel
def add_rolls(out, rates):
    """Add the first three of `rates`, roll moments, to `out` (7,)."""
    add(out, 1, rates[0])
    add(out, 4, rates[1])
    add(out, 6, rates[2])


@kernel
def side_size(q):
    """Return how many of the coordinates `q` are those of the side motion, 2 or 4."""
    return 2 * ((q.shape[0] - RIGID_COORDINATES) // 2)


@kernel
def side_state(q, v):
    """Return d_front, d_rear, y_front, y_rear, V, r, w_front, w_rear, the last of `q` and `v`."""
    n, zero = q.shape[0] - side_size(q), 0.0 * get(q, 0)
    y_f, y_r, w_f, w_r = zero, zero, zero, zero
    if side_size(q) > 2:
        y_f, y_r, w_f, w_r = get(q, n + 2), get(q, n + 3), get(v, n + 2), get(v, n + 3)
    return get(q, n), get(q, n + 1), y_f, y_r, get(v, n), get(v, n + 1), w_f, w_r


@kernel
def load_shares(p, T):
    """Return the tyre loads `T` (4,) [N] of each axle, or their changes, over the static ones."""
    front = get(p.load_share, 0) * (get(T, 0) + get(T, 1))
    return front, get(p.load_share, 1) * (get(T, 2) + get(T, 3))


@kernel
def contact_speeds(p, angle_rates, state):
    """Return u_front and u_rear [m/s] by the rates of `rolls` and the `side_state`."""
    _, _, _, _, V, r, w_f, w_r = state
    front = V + get(p.x, 0) * r + get(p.side_lever, 0) * angle_rates[0] + w_f
    rear = V + get(p.x, 1) * r + get(p.side_lever, 1) * angle_rates[0] + w_r
    front = front + get(p.side_height, 0) * angle_rates[1]
    return front, rear + get(p.side_height, 1) * angle_rates[2]


@kernel
def side_rates(p, angles, moments, state, slip, v, a_y):
    """Return what the side motion adds to the roll `moments` (3), and the rates of its `state`.
    `angles` [rad] are `rolls`, `slip` (2) [m/s] is l_a u_a. The added moments give the diagonal
    masses of `equations` the accelerations that M gives all forces. Linear in all but `v`.
    """
    d_f, d_r, y_f, y_r, _, r, w_f, w_r = state
    F_f, F_r = get(p.side_rate, 0) * d_f, get(p.side_rate, 1) * d_r
    held = get(p.side_lever, 0) * F_f + get(p.side_lever, 1) * F_r
    body = moments[0] + held + get(p.side_gravity, 0) * angles[0]
    front = moments[1] + get(p.side_height, 0) * F_f + get(p.side_gravity, 1) * angles[1]
    rear = moments[2] + get(p.side_height, 1) * F_r + get(p.side_gravity, 2) * angles[2]
    side, yaw = F_f + F_r, get(p.x, 0) * F_f + get(p.x, 1) * F_r
    at_front = F_f - (get(p.joint_stiffness, 0) * y_f + get(p.joint_damping, 0) * w_f)
    at_rear = F_r - (get(p.joint_stiffness, 1) * y_r + get(p.joint_damping, 1) * w_r)
    forces = body, front, rear, side, yaw, at_front, at_rear
    return (
        get(p.M, 1) * _accelerated(p, 0, forces) - moments[0],
        get(p.M, 4) * _accelerated(p, 1, forces) - moments[1],
        get(p.M, 6) * _accelerated(p, 2, forces) - moments[2],
        -slip[0] - v / get(p.relaxation, 0) * d_f,
        -slip[1] - v / get(p.relaxation, 1) * d_r,
        w_f,
        w_r,
        _accelerated(p, 3, forces) - (v * r + a_y),
        _accelerated(p, 4, forces),
        _accelerated(p, 5, forces),
        _accelerated(p, 6, forces),
    )


@kernel
def _accelerated(p, row, forces):
    """Return one of the seven accelerations by the generalised `forces`."""
    k = 7 * row
    a = get(p.side_inverse, k) * forces[0] + get(p.side_inverse, k + 1) * forces[1]
    a = a + get(p.side_inverse, k + 2) * forces[2] + get(p.side_inverse, k + 3) * forces[3]
    a = a + get(p.side_inverse, k + 4) * forces[4] + get(p.side_inverse, k + 5) * forces[5]
    return a + get(p.side_inverse, k + 6) * forces[6]


@kernel
def put_side(out, state, rates):
    """Write the state (8) and the accelerations (4) of `side_rates` to `out` (12,)."""
    # not in a loop: an index that is not constant puts the numbers into memory
    put(out, 0, state[0])
    put(out, 1, state[1])
    put(out, 2, state[2])
    put(out, 3, state[3])
    put(out, 4, state[4])
    put(out, 5, state[5])
    put(out, 6, state[6])
    put(out, 7, state[7])
    put(out, 8, rates[7])
    put(out, 9, rates[8])
    put(out, 10, rates[9])
    put(out, 11, rates[10])


@kernel
def side_increments(p, rates, v, hd):
    """Return the slopes of the state (8) of the first stage of a step; `hd` [s] is h d."""
    f, r = 1.0 + hd * v / get(p.relaxation, 0), 1.0 + hd * v / get(p.relaxation, 1)
    y_f, y_r, V, yaw, w_f, w_r = rates[5:]
    return rates[3] / f, rates[4] / r, y_f, y_r, V, yaw, w_f, w_r


@kernel
def side_middle(state, k, h):
    """Return the state half a step `h` [s] later by the slopes `k`."""
    a = 0.5 * h
    d_f, d_r, y_f, y_r, V, r, w_f, w_r = state
    d_f, d_r, y_f, y_r = d_f + a * k[0], d_r + a * k[1], y_f + a * k[2], y_r + a * k[3]
    return d_f, d_r, y_f, y_r, V + a * k[4], r + a * k[5], w_f + a * k[6], w_r + a * k[7]


@kernel
def advance_side(p, motion, k, rates, v, h, hd):
    """Add the step of the second stage, of slopes `k` at the first and `rates` at the middle."""
    q, rate = motion
    n = q.shape[0] - side_size(q)
    f, r = 1.0 + hd * v / get(p.relaxation, 0), 1.0 + hd * v / get(p.relaxation, 1)
    add(q, n, h * (k[0] + (rates[3] - k[0]) / f))
    add(q, n + 1, h * (k[1] + (rates[4] - k[1]) / r))
    add(rate, n, h * rates[7])
    add(rate, n + 1, h * rates[8])
    if side_size(q) > 2:
        add(q, n + 2, h * rates[5])
        add(q, n + 3, h * rates[6])
        add(rate, n + 2, h * rates[9])
        add(rate, n + 3, h * rates[10])


def n_side(p) -> int:
    """Return the number of coordinates of the side motion by its constants: 0, 2 or 4."""
    return 2 * int(p["relaxation"][0] > 0.0) + 2 * int(p["joint_stiffness"][0] > 0.0)


def _contact_rows(p, n: int) -> np.ndarray:
    """Return u_a (2, N) by the rates of the n coordinates and those of the side motion."""
    rows = np.zeros((2, n + n_side(p)))
    for a in range(2):
        rows[a, [1, 4 + 2 * a, n, n + 1]] = p["side_lever"][a], p["side_height"][a], 1.0, p["x"][a]
    if n_side(p) > 2:
        rows[[0, 1], [n + 2, n + 3]] = 1.0
    return rows


def inverse_inertia(p, M: np.ndarray) -> np.ndarray:
    """Return the accelerations (N, N) of coordinates and side motion by generalised forces. `M`
    (n,): masses and inertias of the coordinates.
    """
    n, m = M.size, n_side(p)
    inverse, at = np.diag(np.append(1.0 / M, np.zeros(m))), [*ROLLS, *range(n, n + m)]
    inverse[np.ix_(at, at)] = p["side_inverse"].reshape(7, 7)[: 3 + m, : 3 + m]
    return inverse


def side_jacobian(p, M: np.ndarray, K: np.ndarray, C: np.ndarray, v: float) -> np.ndarray:
    """Return the Jacobian (2 N, 2 N) of the state's rate by the state, at speed `v` [m/s]. `K`, `C`
    (n, n): stiffness and damping of the coordinates.
    """
    n, N, rows = M.size, M.size + n_side(p), _contact_rows(p, M.size)
    stiffness, damping = np.zeros((N, N)), np.zeros((N, N))
    stiffness[:n, :n], damping[:n, :n] = K, C
    stiffness[ROLLS, ROLLS] -= p["side_gravity"]
    stiffness[:, [n, n + 1]] = -rows.T * p["side_rate"]
    for a, j in enumerate(range(n + 2, N)):
        stiffness[j, j], damping[j, j] = p["joint_stiffness"][a], p["joint_damping"][a]
    inverse = inverse_inertia(p, M)
    relaxing, moving = np.zeros((N, N)), np.eye(N)
    relaxing[[n, n + 1], [n, n + 1]] = -v / p["relaxation"]
    moving[[n, n + 1]] = -rows
    rates = -inverse @ damping
    rates[n, n + 1] -= v
    return np.block([[relaxing, moving], [-inverse @ stiffness, rates]])
