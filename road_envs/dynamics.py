"""Equations of motion of a 7-DOF ride model with solid axles and a 4S4 suspension.

Axle a stands at x_a; its struts at y = ±y_s, its tyres at ±y_t; + is left. With F the force of a
strut on the body and T >= 0 the load of a tyre, both upward,

    extension of a strut    e = (z_b - x_a theta ± y_s phi) - (z_a ± y_s phi_a)
    compression of a tyre   u = z_r - (z_a ± y_t phi_a)

    m_b  z_b''   =  sum F - m_b g             m_a z_a''   =  sum T - sum F - m_a g
    I_xx phi''   =  sum ± y_s F               I_a phi_a'' =  sum ± y_t T - sum ± y_s F
    I_yy theta'' = -sum x_a F

In a manoeuvre, accelerations a_x, a_y [m/s²] of the body's centre of mass, which lies l above the
axis it rolls or pitches about, add the moments of inertia force and displaced weight,

    m_b l_roll (a_y + g phi)  to roll,      m_b l_pitch (g theta - a_x)  to pitch;

on a straight drive at constant speed these are left out, as in the paper.

State (14,): z_b [m], phi, theta [rad], z_af [m], phi_af [rad], z_ar, phi_ar, then their rates. The
origin has every strut at its static length and every tyre at its static deflection. Small angles.

These are equations 2 to 8 of Ngwangwa, Heyns, Breytenbach & Els with z up instead of down and pitch
positive nose down: paper alpha, beta -> phi, -theta; z_uf, theta -> -z_af, phi_af; z_ur, phi ->
-z_ar, phi_ar; b, a -> x of the front and -x of the rear axle; d, c -> y_s, y_t. Corrections: in
eq. 7 the left tyre's heave stiffness must be negative, as in eq. 8 (a symmetric road must not roll
an axle); c_trf and c_tlf in eq. 3 are damping constants; the 10 mm of tyre deflection is not the
equilibrium, which is 21.5 mm, and stays available as `tyre_static_deflection: 0.010`.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.jit import kernel
from road_envs.suspension import (
    displacement_tables,
    strut_force,
    tyre_force,
    velocity_tables,
)
from road_envs.vector import add, get
from road_envs.vehicle import GRAVITY, VehicleParameters

DOF = ("z_b", "phi", "theta", "z_af", "phi_af", "z_ar", "phi_ar")
N_DOF = len(DOF)
Z_B, PHI, THETA, AXLE = 0, 1, 2, 3
"""Indices of the state; axle i has its heave at AXLE + 2 i and its roll behind that."""

NUMBERS = np.dtype(
    [
        ("M", "f8", (N_DOF,)),
        *((name, "f8") for name in ("p_A", "n_p", "x_1", "r_2", "column_min", "equalisation")),
        *((name, "f8") for name in ("roll_moment", "pitch_moment", "table")),
        *((name, "f8", (2,)) for name in ("x", "k_t", "c_t", "delta")),
        *((name, "f8", (4,)) for name in ("y_s", "y_t")),
    ],
    align=True,
)
"""A vehicle's numbers as kernels read them: M are the inertias of the degrees of freedom; y_s and
y_t are signed, wheel by wheel; `table` is the first of the vehicle's two tables of each kind, where
several vehicles keep theirs together."""


@dataclass(frozen=True, eq=False)
class Plant:
    """What the kernels need of one vehicle: its numbers (1,) and its tables."""

    numbers: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The three arrays in the order of every kernel's arguments."""
        return self.numbers, self.velocity, self.displacement


def plant(car: VehicleParameters, manoeuvres: bool = False) -> Plant:
    """The kernel's view of a vehicle; with `manoeuvres` its body leans in turns and on brakes."""
    axles, strut = car.axles, car.strut
    sides = (1.0, -1.0)
    values = {
        "M": [car.m_b, car.I_xx, car.I_yy, *(v for a in axles for v in (a.m, a.I_xx))],
        "p_A": strut.p_stat * strut.A,
        "n_p": strut.n_p,
        "x_1": strut.x_1,
        "r_2": strut.x_2 / (strut.x_1 + strut.x_2),
        "roll_moment": car.m_b * (car.h_cg - car.roll_centre) if manoeuvres else 0.0,
        "pitch_moment": car.m_b * (car.h_cg - car.pitch_centre) if manoeuvres else 0.0,
        "table": 0.0,
        "column_min": strut.column_min,
        "equalisation": car.valve.equalisation,
        "x": [a.x for a in axles],
        "k_t": [a.k_t for a in axles],
        "c_t": [a.c_t for a in axles],
        "delta": car.tyre_deflections,
        "y_s": [side * a.y_s for a in axles for side in sides],
        "y_t": [side * a.y_t for a in axles for side in sides],
    }
    numbers = np.zeros(1, dtype=NUMBERS)
    for name in NUMBERS.names or ():
        numbers[name] = values[name]
    return Plant(numbers, velocity_tables(car), displacement_tables(car))


@kernel
def extension(p, q, w):
    """Extension [m] of strut `w` for coordinates `q`; for their rates, its rate."""
    a = AXLE + 2 * (w // 2)
    heave = get(q, Z_B) - get(p.x, w // 2) * get(q, THETA) - get(q, a)
    return heave + get(p.y_s, w) * (get(q, PHI) - get(q, a + 1))


@kernel
def wheel_height(p, q, w):
    """Height [m] of the wheel above tyre `w` for coordinates `q`; for their rates, its rate."""
    a = AXLE + 2 * (w // 2)
    return get(q, a) + get(p.y_t, w) * get(q, a + 1)


@kernel
def add_struts(p, F, out):
    """Add the generalised forces (7,) of the struts' forces `F` (4,) to `out`.

    Left and right are subtracted before they meet a lever: equal forces roll nothing, to the bit.
    """
    for i in range(2):
        left, right = get(F, 2 * i), get(F, 2 * i + 1)
        push, twist = left + right, get(p.y_s, 2 * i) * (left - right)
        add(out, Z_B, push)
        add(out, PHI, twist)
        add(out, THETA, -get(p.x, i) * push)
        add(out, AXLE + 2 * i, -push)
        add(out, AXLE + 2 * i + 1, -twist)


@kernel
def add_tyres(p, T, out):
    """Add the generalised forces (7,) of the tyres' loads `T` (4,) to `out`."""
    for i in range(2):
        left, right = get(T, 2 * i), get(T, 2 * i + 1)
        add(out, AXLE + 2 * i, left + right)
        add(out, AXLE + 2 * i + 1, get(p.y_t, 2 * i) * (left - right))


@kernel
def add_weight(p, out):
    """Add the weights of body and axles to `out` (7,)."""
    for j in (Z_B, AXLE, AXLE + 2):
        add(out, j, -GRAVITY * get(p.M, j))


@kernel
def add_lean(p, phi, theta, a_x, a_y, out):
    """Add the moments of a manoeuvre with accelerations `a_x`, `a_y` [m/s²] to `out` (7,)."""
    add(out, PHI, get(p.roll_moment) * (a_y + GRAVITY * phi))
    add(out, THETA, get(p.pitch_moment) * (GRAVITY * theta - a_x))


@kernel
def accelerations(numbers, velocity, displacement, memory, q, v, z_r, w_r, out, a_x=0.0, a_y=0.0):
    """Write the accelerations (7,) for coordinates `q` (7,), rates `v` (7,) to `out`.

    `z_r`, `w_r` (4,) are the road's height [m] and its rate [m/s] under each wheel; `a_x`, `a_y`
    [m/s²] those of a manoeuvre.
    """
    p, F, T = numbers[0], np.empty(4), np.empty(4)
    for w in range(4):
        e, e_dot = extension(p, q, w), extension(p, v, w)
        F[w] = strut_force(p, velocity, displacement, memory, w, e, e_dot)[0]
        u, u_dot = z_r[w] - wheel_height(p, q, w), w_r[w] - wheel_height(p, v, w)
        T[w] = tyre_force(p, w // 2, u, u_dot)[0]
    out[:] = 0.0
    add_weight(p, out)
    add_struts(p, F, out)
    add_tyres(p, T, out)
    add_lean(p, q[PHI], q[THETA], a_x, a_y, out)
    for j in range(N_DOF):
        out[j] /= p.M[j]


@kernel
def stiffness_and_damping(numbers, velocity, displacement, memory, q, v, z_r, w_r, K, C):
    """Write -df/dq to `K` and -df/dv to `C` (7, 7), f being the generalised forces."""
    p, k, c, k_t, c_t = numbers[0], np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for w in range(4):
        e, e_dot = extension(p, q, w), extension(p, v, w)
        _, k[w], c[w] = strut_force(p, velocity, displacement, memory, w, e, e_dot)
        u, u_dot = z_r[w] - wheel_height(p, q, w), w_r[w] - wheel_height(p, v, w)
        _, k_t[w], c_t[w] = tyre_force(p, w // 2, u, u_dot)
    K[:] = 0.0
    C[:] = 0.0
    e, height = np.empty(4), np.empty(4)
    for j in range(N_DOF):
        unit = np.zeros(N_DOF)
        unit[j] = 1.0
        for w in range(4):
            e[w], height[w] = extension(p, unit, w), wheel_height(p, unit, w)
        add_struts(p, k * e, K[:, j])
        add_tyres(p, k_t * height, K[:, j])
        add_struts(p, c * e, C[:, j])
        add_tyres(p, c_t * height, C[:, j])
    K[PHI, PHI] -= p.roll_moment * GRAVITY
    K[THETA, THETA] -= p.pitch_moment * GRAVITY


def jacobian(plant: Plant, memory: np.ndarray, state: np.ndarray, z_r: np.ndarray, w_r: np.ndarray):
    """Jacobian (14, 14) of the rate of the state (14,) by the state."""
    K, C = np.empty((N_DOF, N_DOF)), np.empty((N_DOF, N_DOF))
    stiffness_and_damping(*plant.arrays, memory, state[:N_DOF], state[N_DOF:], z_r, w_r, K, C)
    M = plant.numbers[0]["M"][:, None]
    return np.block([[np.zeros((N_DOF, N_DOF)), np.eye(N_DOF)], [-K / M, -C / M]])


def _on_the_ground(plant: Plant, z_r: np.ndarray) -> np.ndarray:
    """Coordinates (7,) of a car lifted onto wheel heights (4,): no tyre changes its deflection."""
    x, y_t = plant.numbers[0]["x"], plant.numbers[0]["y_t"]
    left, right = z_r[0::2], z_r[1::2]
    heave, roll = 0.5 * (left + right), (left - right) / (y_t[0::2] - y_t[1::2])
    theta = (heave[1] - heave[0]) / (x[0] - x[1])
    z_b, phi = heave[0] + x[0] * theta, roll.mean()
    return np.array([z_b, phi, theta, heave[0], roll[0], heave[1], roll[1]])


def equilibrium(plant: Plant, memory: np.ndarray, z_r: np.ndarray) -> np.ndarray:
    """State (14,) at rest on wheels at heights `z_r` (4,) [m], found by Newton's method.

    Raises ArithmeticError if there is none within reach (a wheel off the ground, say).
    """
    q, rest = _on_the_ground(plant, z_r), np.zeros(N_DOF)
    K, C, a, flat = np.empty((N_DOF, N_DOF)), np.empty((N_DOF, N_DOF)), np.empty(N_DOF), np.zeros(4)
    for _ in range(50):
        accelerations(*plant.arrays, memory, q, rest, z_r, flat, a)
        if np.abs(a).max() < 1e-10 * (1.0 + np.abs(z_r).max()):
            return np.concatenate([q, rest])
        stiffness_and_damping(*plant.arrays, memory, q, rest, z_r, flat, K, C)
        try:
            q = q + np.linalg.solve(K, plant.numbers[0]["M"] * a)
        except np.linalg.LinAlgError:  # all wheels off the ground
            break
    raise ArithmeticError(f"no static equilibrium on wheel heights {z_r.tolist()}")
