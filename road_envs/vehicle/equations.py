"""Equations of motion of a 7-DOF ride model with solid axles and a 4S4 or passive suspension.

Independent wheels have the equations of an equivalent axle (`parameters.IndependentWheels`).

Axle a is at x = x_a, its struts at y = ±y_s and its tyres at y = ±y_t, with + for the left side. F
is the force of a strut on the body and T >= 0 the load of a tyre, both positive upwards:

    extension of a strut    e = (z_b - x_a theta ± y_s phi) - (z_a ± y_s phi_a)
    compression of a tyre   u = z_r - (z_a ± y_t phi_a)

    m_b  z_b''   =  sum F - m_b g             m_a z_a''   =  sum T - sum F - m_a g
    I_xx phi''   =  sum ± y_s F               I_a phi_a'' =  sum ± y_t T - sum ± y_s F
    I_yy theta'' = -sum x_a F

In a manoeuvre of accelerations a_x, a_y [m/s²] inertia force and displaced weight add, with the
height l of the centre of mass above the roll or pitch axis,

    m_b l_roll (a_y + g phi)  to roll,      m_b l_pitch (g theta - a_x)  to pitch,

but on a straight drive at constant speed only what `side_motion` says of pitch, as in the paper.

State (14,): z_b [m], phi, theta [rad], z_af [m], phi_af [rad], z_ar, phi_ar, then their rates. At
the origin every strut has its static length and every tyre its static deflection. Small angles.

An anti-roll bar, and bushings of a `parameters.VehicleVariation`, with a roll stiffness k_r exert
the moment k_r (phi - phi_a) between body and axle. A variation can also make the frame flexible:
two halves with half the roll inertia each roll by phi ± psi / 2 (front and rear). The twist psi
[rad] is an eighth coordinate; its rate is the last rate. With M the roll moment of struts, bars and
bushings on each half,

    I_xx / 4 psi'' = (M_front - M_rear) / 2 - k_f psi - c_f psi'

These are equations 2 to 8 of Ngwangwa, Heyns, Breytenbach & Els with z up instead of down and pitch
positive nose down: paper alpha, beta -> phi, -theta; z_uf, theta -> -z_af, phi_af; z_ur, phi ->
-z_ar, phi_ar; b, a -> x of the front and -x of the rear axle; d, c -> y_s, y_t. Corrections: in
eq. 7 the left tyre's heave stiffness must be negative, as in eq. 8 (a symmetric road must not roll
an axle); c_trf and c_tlf in eq. 3 are damping constants; the tyre deflection in equilibrium is
21.5 mm and not the paper's 10 mm, which `tyre_static_deflection: 0.010` restores.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd_arrays import add, get, stack_array, stack_rows
from road_envs.vehicle import suspension
from road_envs.vehicle.parameters import GRAVITY, VehicleParameters
from road_envs.vehicle.side_motion import SIDE_FIELDS, n_side, side_constants
from road_envs.vehicle.suspension import VehicleBuffers, strut_force
from road_envs.vehicle.tyres import tyre_constants, tyre_force

DOF = ("z_b", "phi", "theta", "z_af", "phi_af", "z_ar", "phi_ar")
N_DOF = len(DOF)
Z_B, PHI, THETA, AXLE = 0, 1, 2, 3
"""Indices of the state; axle i has its heave at AXLE + 2 i and its roll at AXLE + 2 i + 1."""

PLANT_DTYPE = np.dtype(
    [
        ("M", "f8", (N_DOF,)),
        *((name, "f8") for name in ("n_p", "x_1", "r_2", "column_min", "equalisation")),
        *((name, "f8") for name in ("roll_moment", "pitch_moment")),
        *((name, "f8") for name in ("frame_inertia", "frame_rate", "frame_damping")),
        *((name, "f8", (2,)) for name in ("x", "delta", "k_roll", "twist_share")),
        *((name, "f8", (4,)) for name in ("y_s", "y_t", "p_A", "k_t", "k_t2", "c_t")),
        *((name, "f8", (4,)) for name in ("velocity_table", "displacement_table")),
        *SIDE_FIELDS,
    ],
    align=True,
)
"""The constants of one vehicle as kernels read them. M: masses and inertias of the degrees of
freedom; y_s, y_t: signed, per wheel; `twist_share`: body roll above each axle per twist of the
frame; `velocity_table`, `displacement_table`: index of each strut's first table of either kind,
with an offset where several vehicles share one array of tables; those of `side_motion`."""


@dataclass(frozen=True, eq=False)
class Plant:
    """One vehicle as kernels read it: its constants and the tables of its force laws."""

    constants: np.ndarray  # (1,) of PLANT_DTYPE
    velocity: np.ndarray  # (K, V_CELLS, 4): damper and friction; `suspension.velocity_tables`
    displacement: np.ndarray  # (K, E_CELLS, 4): bushing and bump stop; `displacement_tables`

    def buffers(self, strut_state: np.ndarray) -> VehicleBuffers:
        """Return what kernels take, with the strut state (4, 3), which they may advance."""
        return VehicleBuffers(self.constants, self.velocity, self.displacement, strut_state)

    @property
    def flexible(self) -> bool:
        """True if the frame is flexible, so that the state is (16,) instead of (14,)."""
        return bool(self.constants["frame_inertia"][0] > 0.0)

    @property
    def sideways(self) -> bool:
        """True if the vehicle has side motion, which adds two deflections and two rates."""
        return n_side(self.constants[0]) > 0

    @property
    def n_dof(self) -> int:
        """Half the number of states: 7, 8 if flexible, and those of `n_side`."""
        return N_DOF + self.flexible + n_side(self.constants[0])

    @property
    def kernel_flags(self) -> tuple[bool | None, ...]:
        """Last arguments of kernels, `flexible` and `side`: without either they compile without."""
        flexible = True if self.flexible else None
        return (flexible, True) if self.sideways else (True,) if flexible else ()

    @property
    def inertias(self) -> np.ndarray:
        """Masses [kg] and inertias [kg m²] of the coordinates: (7,), or (8,) if flexible."""
        M, torsion = self.constants["M"][0], self.constants["frame_inertia"]
        return np.concatenate([M, torsion]) if self.flexible else M


class Motion(NamedTuple):
    """Coordinates `q` and rates `v` of a vehicle: (7,), (8,) with a flexible frame, then those of
    `side_motion`. With LANES vehicles the lanes are the last axis.
    """

    q: np.ndarray
    v: np.ndarray


def build_plant(car: VehicleParameters, manoeuvres: bool = False) -> Plant:
    """Build the plant of a vehicle, with its variation; with `manoeuvres` the body rolls in turns
    and pitches when braking. Raises ValueError if the progression of the tyres would make their
    stiffness negative at first contact.
    """
    axles, sides = car.axles, (1.0, -1.0)
    quasi_static = manoeuvres and car.side is None  # else the side forces make the moment
    velocity, velocity_indices = suspension.velocity_tables(car)
    displacement, displacement_indices = suspension.displacement_tables(car)
    values = {
        "M": [car.m_b, car.I_xx, car.pitch_inertia, *(v for a in axles for v in (a.m, a.I_xx))],
        "roll_moment": car.m_b * (car.h_cg - car.roll_centre) * quasi_static,
        "pitch_moment": car.m_b * (car.h_cg - car.pitch_centre if manoeuvres else car.pitch_lever),
        "equalisation": car.valve.equalisation,
        "x": [a.x for a in axles],
        "delta": car.tyre_deflections,
        "k_roll": [a.k_roll + k for a, k in zip(axles, car.variation.roll_stiffness, strict=True)],
        "y_s": [side * a.y_s for a in axles for side in sides],
        "y_t": [side * a.y_t for a in axles for side in sides],
        "c_t": [a.c_t for a in axles for _ in sides],
        "velocity_table": velocity_indices,
        "displacement_table": displacement_indices,
        **suspension.gas_constants(car),
        **tyre_constants(car),
        **_frame_constants(car),
        **side_constants(car),
    }
    constants = np.zeros(1, dtype=PLANT_DTYPE)
    for name, value in values.items():
        constants[name] = value
    return Plant(constants, velocity, displacement)


def _frame_constants(car: VehicleParameters) -> dict[str, object]:
    if (frame := car.variation.frame) is None:
        return {}
    inertia, omega = 0.25 * car.I_xx, 2.0 * np.pi * frame.f
    return {
        "frame_inertia": inertia,
        "frame_rate": inertia * omega**2,
        "frame_damping": 2.0 * frame.zeta * inertia * omega,
        "twist_share": (0.5, -0.5),
    }


@kernel
def extension(p, q, w):
    """Return the extension [m] of strut `w` for coordinates `q`, or its rate for their rates."""
    a = AXLE + 2 * (w // 2)
    heave = get(q, Z_B) - get(p.x, w // 2) * get(q, THETA) - get(q, a)
    return heave + get(p.y_s, w) * (get(q, PHI) - get(q, a + 1))


@kernel
def wheel_height(p, q, w):
    """Return the height [m] of wheel `w` for coordinates `q`, or its rate for their rates."""
    a = AXLE + 2 * (w // 2)
    return get(q, a) + get(p.y_t, w) * get(q, a + 1)


@kernel
def relative_roll(q, i):
    """Return body roll minus roll of axle `i` [rad] for coordinates `q`, or its rate for rates."""
    return get(q, PHI) - get(q, AXLE + 2 * i + 1)


@kernel
def twist_extension(p, psi, w):
    """Return what a frame twist `psi` [rad] adds to the extension of strut `w` [m]."""
    return get(p.y_s, w) * (get(p.twist_share, w // 2) * psi)


@kernel
def _axle_roll_moment(p, F, i, roll):
    """Return the body's roll moment [N m] over axle `i`, at the relative `roll` [rad] to it."""
    # left minus right first: equal forces give a moment of exactly 0
    return get(p.y_s, 2 * i) * (get(F, 2 * i) - get(F, 2 * i + 1)) - get(p.k_roll, i) * roll


def sensor_row(x: float, y: float, axle: int | None = None) -> np.ndarray:
    """Return the height of a point at (x, y) [m], of the body, whose halves meet at x = 0, or of
    the front (0) or rear (1) `axle`, per unit of each coordinate and of psi (8,).
    """
    row = np.zeros(N_DOF + 1)
    if axle is not None:
        row[[AXLE + 2 * axle, AXLE + 2 * axle + 1]] = 1.0, y
    else:
        row[[Z_B, PHI, THETA]] = 1.0, y, -x
        row[N_DOF] = 0.5 * np.sign(x) * y
    return row


@kernel
def add_struts(p, F, front, rear, out):
    """Add the generalised forces (7,) of strut forces `F` (4,) and bushings to `out`. `front`,
    `rear` [rad]: roll of the body relative to each axle.
    """
    for i in range(2):
        push = get(F, 2 * i) + get(F, 2 * i + 1)
        twist = _axle_roll_moment(p, F, i, front if i == 0 else rear)
        add(out, Z_B, push)
        add(out, PHI, twist)
        add(out, THETA, -get(p.x, i) * push)
        add(out, AXLE + 2 * i, -push)
        add(out, AXLE + 2 * i + 1, -twist)


@kernel
def add_tyres(p, T, out):
    """Add the generalised forces (7,) of tyre loads `T` (4,) to `out`."""
    for i in range(2):
        left, right = get(T, 2 * i), get(T, 2 * i + 1)
        add(out, AXLE + 2 * i, left + right)
        add(out, AXLE + 2 * i + 1, get(p.y_t, 2 * i) * (left - right))


@kernel
def twist_moment(p, F, front, rear):
    """Return the generalised force [N m] on the frame's twist; arguments as of `add_struts`."""
    moment = get(p.twist_share, 0) * _axle_roll_moment(p, F, 0, front)
    return moment + get(p.twist_share, 1) * _axle_roll_moment(p, F, 1, rear)


@kernel
def roll_moments(p, F, T, front, rear):
    """Return the roll moments of `add_struts` and `add_tyres` on body, front and rear axle."""
    f, r = _axle_roll_moment(p, F, 0, front), _axle_roll_moment(p, F, 1, rear)
    t_f = get(p.y_t, 0) * (get(T, 0) - get(T, 1))
    return f + r, t_f - f, get(p.y_t, 2) * (get(T, 2) - get(T, 3)) - r


@kernel
def add_weight(p, out):
    """Add the weights of body and axles to `out` (7,)."""
    for j in (Z_B, AXLE, AXLE + 2):
        add(out, j, -GRAVITY * get(p.M, j))


@kernel
def add_manoeuvre_moments(p, phi, theta, a_x, a_y, out):
    """Add the roll and pitch moments of accelerations `a_x`, `a_y` [m/s²] to `out` (7,)."""
    add(out, PHI, get(p.roll_moment) * (a_y + GRAVITY * phi))
    add(out, THETA, get(p.pitch_moment) * (GRAVITY * theta - a_x))


@kernel(count_references=False)
def accelerations(vehicle, motion, z_r, w_r, out, a_x=0.0, a_y=0.0):
    """Write the accelerations (7,) of a `motion` to `out`; (8,) with a flexible frame. `z_r`, `w_r`
    (4,): road height [m] and its rate [m/s] under each wheel; `a_x`, `a_y` [m/s²].
    """
    p, F, T = vehicle.constants[0], stack_array(4), stack_array(4)
    q, v = motion
    flexible = q.size > N_DOF
    psi, psi_dot = (q[N_DOF], v[N_DOF]) if flexible else (0.0, 0.0)
    for w in range(4):
        e = extension(p, q, w) + twist_extension(p, psi, w)
        e_dot = extension(p, v, w) + twist_extension(p, psi_dot, w)
        F[w] = strut_force(vehicle, w, e, e_dot)[0]
        u, u_dot = z_r[w] - wheel_height(p, q, w), w_r[w] - wheel_height(p, v, w)
        T[w] = tyre_force(p, w, u, u_dot)[0]
    front = relative_roll(q, 0) + p.twist_share[0] * psi
    rear = relative_roll(q, 1) + p.twist_share[1] * psi
    for j in range(N_DOF):
        out[j] = 0.0
    add_weight(p, out)
    add_struts(p, F, front, rear, out)
    add_tyres(p, T, out)
    add_manoeuvre_moments(p, q[PHI], q[THETA], a_x, a_y, out)
    for j in range(N_DOF):
        out[j] /= p.M[j]
    if flexible:
        moment = twist_moment(p, F, front, rear) - p.frame_rate * psi - p.frame_damping * psi_dot
        out[N_DOF] = moment / p.frame_inertia


@kernel(count_references=False)
def stiffness_and_damping(vehicle, motion, z_r, w_r, K, C):
    """Write -df/dq to `K` and -df/dv to `C` (7, 7), (8, 8) if flexible; f: generalised forces."""
    p, struts, tyres = vehicle.constants[0], stack_rows(2), stack_rows(2)
    q, v = motion
    flexible = q.size > N_DOF
    psi, psi_dot = (q[N_DOF], v[N_DOF]) if flexible else (0.0, 0.0)
    for w in range(4):
        e = extension(p, q, w) + twist_extension(p, psi, w)
        e_dot = extension(p, v, w) + twist_extension(p, psi_dot, w)
        _, struts[0, w], struts[1, w] = strut_force(vehicle, w, e, e_dot)
        u, u_dot = z_r[w] - wheel_height(p, q, w), w_r[w] - wheel_height(p, v, w)
        _, tyres[0, w], tyres[1, w] = tyre_force(p, w, u, u_dot)
    F, T, unit, column = stack_array(4), stack_array(4), stack_array(8), stack_array(N_DOF)
    for j in range(unit.size):
        unit[j] = 0.0
    for j in range(q.size):  # column j: forces of the linear elements under a unit coordinate
        unit[j] = 1.0
        front = relative_roll(unit, 0) + p.twist_share[0] * unit[N_DOF]
        rear = relative_roll(unit, 1) + p.twist_share[1] * unit[N_DOF]
        for rate in range(2):
            for w in range(4):
                e = extension(p, unit, w) + twist_extension(p, unit[N_DOF], w)
                F[w], T[w] = struts[rate, w] * e, tyres[rate, w] * wheel_height(p, unit, w)
            if rate == 1:  # bushings do not damp
                front = rear = 0.0
            for i in range(N_DOF):
                column[i] = 0.0
            add_struts(p, F, -front, -rear, column)
            add_tyres(p, T, column)
            matrix = K if rate == 0 else C
            for i in range(N_DOF):
                matrix[i, j] = column[i]
            if flexible:
                frame = p.frame_rate if rate == 0 else p.frame_damping
                matrix[N_DOF, j] = twist_moment(p, F, -front, -rear) + frame * unit[N_DOF]
        unit[j] = 0.0
    K[PHI, PHI] -= p.roll_moment * GRAVITY
    K[THETA, THETA] -= p.pitch_moment * GRAVITY
