"""The vehicle for small motions: state space, modes, frequency response.

About a state y_0 on wheel heights z_0 the equations of motion are, in deviations,

    x' = A x + B u,      a = C x + D u

x (14,) coordinates and rates, u (8,) road heights [m] and their rates [m/s] under the four wheels,
a vertical accelerations [m/s²] of points (x_i, y_i) of the body, heave - x_i pitch + y_i roll. With
both wheel paths as inputs, the rear wheels a wheelbase L behind the front ones,

    H_side(f) = H_front(f) + exp(-2 pi j f L / v) H_rear(f),   H_wheel = H_z + 2 pi j f H_w

so that, with equal suspension in front and behind, the difference of the paths rolls nobody at
n = f / v = (2 k + 1) / (2 L).

Friction is a steep damper near standstill: the slope of the curves at rest, 14 kN s/m a strut for
the Defender in ride mode, holds below 0.01 m/s only. `gaussian_damping` is what the same curves do
on a road (statistical linearisation: Roberts & Spanos 1990, "Random Vibration and Statistical
Linearization", section 5.2), and can stand in its place.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import linear_sum_assignment

from road_envs._numba import kernel
from road_envs.vehicle.equations import (
    DOF,
    N_DOF,
    PHI,
    THETA,
    Z_B,
    Plant,
    build_plant,
    equilibrium,
    extension,
    jacobian,
    twist_extension,
    wheel_height,
)
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import (
    WHEELS,
    encode_command,
    settled_strut_state,
    strut_force,
    tyre_force,
)

COORDINATE_UNITS = ("m", "rad", "rad", "m", "rad", "m", "rad")
NATURAL_MODE_NAMES = (
    *("bounce", "roll", "pitch"),
    *("front axle hop", "front axle roll", "rear axle hop", "rear axle roll"),
)
"""Names of the modes, each after the coordinate of `dynamics.DOF` that carries it."""

FRAME_TORSION_MODE = "frame torsion"
"""That of the twist psi of a flexible frame, a coordinate behind the others."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """x' = A x + B u, a = C x + D u for S sensors, with the names of all that these are.

    A (14, 14), B (14, 8), C (S, 14), D (S, 8); `M` (7,): masses [kg] and inertias [kg m²] of the
    coordinates; `wheelbase` [m]. Levers over the coordinates: `struts` (4, 7) of the extension of
    a strut, `body` (S, 7) of the place of a sensor. Units are those of the names at the same place.
    With a flexible frame there are eight coordinates, so 16 states.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    M: np.ndarray
    strut_rows: np.ndarray
    sensor_rows: np.ndarray
    wheelbase: float
    sensors: tuple[str, ...]
    states: tuple[str, ...] = (*DOF, *(f"{name}_dot" for name in DOF))
    state_units: tuple[str, ...] = (*COORDINATE_UNITS, *(f"{unit}/s" for unit in COORDINATE_UNITS))
    inputs: tuple[str, ...] = (*(f"z_{w}" for w in WHEELS), *(f"w_{w}" for w in WHEELS))
    input_units: tuple[str, ...] = (*("m",) * 4, *("m/s",) * 4)
    output_unit: str = "m/s²"

    @property
    def poles(self) -> np.ndarray:
        """Eigenvalues (14,) of A [rad/s]."""
        return np.linalg.eigvals(self.A)


@dataclass(frozen=True, eq=False)
class NaturalModes:
    """The seven natural modes, slowest first.

    `f` (7,): undamped natural frequencies [Hz]. `zeta` (7,): damping ratios, the mode's own share
    of the damping matrix; the modes of a lightly damped car decay with it. `shapes` (7, 7): a
    column each over `dynamics.DOF` of unit modal mass (phi' M phi = 1), positive where it is
    named.
    """

    names: tuple[str, ...]
    f: np.ndarray
    zeta: np.ndarray
    shapes: np.ndarray


def linearise(
    car: Plant | VehicleParameters,
    mode: str | Mapping[str, str] | np.ndarray,
    sensors: Mapping[str, tuple[float, float]],
    state: np.ndarray | None = None,
    z_r: np.ndarray | None = None,
    w_r: np.ndarray | None = None,
    damping: np.ndarray | None = None,
) -> LinearModel:
    """Linearise the vehicle about a `state` (14,), by default its static equilibrium.

    `mode` as in `suspension.encode_command`, or a strut state (4, 3), which is held constant.
    `sensors`: name -> (x, y) [m], ahead and to the left of the body's centre of mass. `z_r`, `w_r`
    (4,): road heights [m] and rates [m/s] under the wheels, 0 by default. `damping` (4,) [N s/m]
    replaces the slopes of the struts' force curves. About a state that is not an equilibrium, the
    model describes deviations from the motion as long as the slopes are constant. Raises ValueError
    on a wrong shape and ArithmeticError if there is no static equilibrium.
    """
    one = car if isinstance(car, Plant) else build_plant(car)
    strut_state = (
        mode if isinstance(mode, np.ndarray) else settled_strut_state(encode_command(mode))
    )
    z, w = (np.zeros(4) if v is None else np.array(v, dtype=float) for v in (z_r, w_r))
    y = equilibrium(one, strut_state, z) if state is None else np.array(state, dtype=float)
    n = one.inertias.size
    shapes = [
        ("state", y, (2 * n,)),
        ("z_r", z, (4,)),
        ("w_r", w, (4,)),
        ("memory", strut_state, (4, 3)),
    ]
    for name, value, shape in shapes:
        if value.shape != shape:
            raise ValueError(f"{name} must be of shape {shape}, got {value.shape}")
    A, B = jacobian(one, strut_state, y, z, w), _road_input_matrix(one, y, z, w)
    if damping is not None:
        A[n:, n:] += _damping_correction(one, strut_state, y, np.asarray(damping, dtype=float))
    body = np.array([_sensor_row(x, y, n) for x, y in sensors.values()]).reshape(-1, n)
    axles = one.constants[0]["x"]
    C, D = body @ A[n:], body @ B[n:]
    struts, wheelbase = _as_matrix(extension, one), float(axles[0] - axles[1])
    names, units = (*DOF, "psi")[:n], (*COORDINATE_UNITS, "rad")[:n]
    return LinearModel(
        *(A, B, C, D, one.inertias.copy(), struts, body, wheelbase, tuple(sensors)),
        states=(*names, *(f"{name}_dot" for name in names)),
        state_units=(*units, *(f"{unit}/s" for unit in units)),
    )


def _sensor_row(x: float, y: float, n: int) -> np.ndarray:
    row = np.zeros(N_DOF + 1)
    row[[Z_B, PHI, THETA, N_DOF]] = 1.0, y, -x, 0.5 * np.sign(x) * y
    return row[:n]


def _as_matrix(law, one: Plant) -> np.ndarray:
    """A linear law of the coordinates and the wheel as a matrix (4, n)."""
    p, unit = one.constants[0], np.eye(N_DOF)
    rows = np.array([[law(p, unit[j], w) for j in range(N_DOF)] for w in range(4)])
    if not one.flexible:
        return rows
    twist = [twist_extension(p, 1.0, w) if law is extension else 0.0 for w in range(4)]
    return np.column_stack([rows, twist])


def _road_input_matrix(one: Plant, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """B (14, 8) at the state `y`: what a tyre in touch makes of the road."""
    rows = _as_matrix(wheel_height, one)
    n = rows.shape[1]
    u, u_dot = z - rows @ y[:n], w - rows @ y[n:]
    slopes = [tyre_force(one.constants[0], i, u[i], u_dot[i])[1:] for i in range(4)]
    k_t, c_t = np.array(slopes).T
    B = np.zeros((2 * n, 8))
    B[n:] = np.hstack([rows.T * k_t, rows.T * c_t]) / one.inertias[:, None]
    return B


def _damping_correction(one: Plant, strut_state, y: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """What replacing the struts' slopes by `wanted` (4,) adds to the rates' block of A (n, n)."""
    rows = _as_matrix(extension, one)
    e, e_dot = rows @ y[: rows.shape[1]], rows @ y[rows.shape[1] :]
    now = [
        strut_force(one.constants[0], *one.arrays[1:], strut_state, w, e[w], e_dot[w])[2]
        for w in range(4)
    ]
    return rows.T @ ((np.array(now) - wanted)[:, None] * rows) / one.inertias[:, None]


def gaussian_damping(
    car: Plant | VehicleParameters, mode: str | Mapping[str, str], rate: float | np.ndarray
) -> np.ndarray:
    """The struts' equivalent dampers (4,) [N s/m] in random motion.

    `rate` [m/s], a number or (4,): standard deviation of the rate of extension. The damper that
    errs least in the mean square, c = E[F(e_dot) e_dot] / E[e_dot²] for a normal e_dot.
    """
    one = car if isinstance(car, Plant) else build_plant(car)
    rate = np.broadcast_to(np.asarray(rate, dtype=float), (4,))
    if not (np.isfinite(rate) & (rate > 0)).all():
        raise ValueError(
            f"a standard deviation of a rate must be positive, got {rate.tolist()} m/s"
        )
    x = np.linspace(-6.0, 6.0, 1201)
    weight = x * np.exp(-0.5 * x**2)
    weight /= weight @ x
    F = strut_forces(one, mode, np.zeros((4, x.size)), rate[:, None] * x)
    return -(F @ weight) / rate  # the spring's part is even, the weight is odd


def strut_forces(
    car: Plant | VehicleParameters,
    mode: str | Mapping[str, str],
    e: np.ndarray,
    e_dot: np.ndarray,
) -> np.ndarray:
    """Forces (4, K) [N] that the struts, long in a mode, exert upwards on the body at extensions
    `e` (4, K) [m] and rates of extension `e_dot` (4, K) [m/s].
    """
    one = car if isinstance(car, Plant) else build_plant(car)
    found = np.empty(e.shape)
    tables = (one.velocity, one.displacement, settled_strut_state(encode_command(mode)))
    _strut_forces(one.constants[0], *tables, e, e_dot, found)
    return found


@kernel
def _strut_forces(p, velocity, displacement, strut_state, e, e_dot, out):
    for w in range(4):
        for k in range(e.shape[1]):
            at = e[w, k], e_dot[w, k]
            out[w, k] = strut_force(p, velocity, displacement, strut_state, w, at[0], at[1])[0]


def natural_modes(model: LinearModel) -> NaturalModes:
    """Natural modes of M q'' + C q' + K q = 0, named after the coordinate that carries them.

    M phi_j² is a mode's share of kinetic energy in each coordinate; a name goes to the mode that
    has most of it, all names together making the most of it. Raises ArithmeticError if the state
    is not a stable one (all wheels in the air, or a body that falls over).
    """
    M, n = model.M, model.M.size
    K, C = (-M[:, None] * model.A[n:, part] for part in (slice(n), slice(n, None)))
    square, shapes = eigh(0.5 * (K + K.T), np.diag(M))
    if not square[0] > 1e-9 * square[-1]:
        raise ArithmeticError("no natural modes: at this state the car does not stand")
    _, place = linear_sum_assignment(M[:, None] * shapes**2, maximize=True)
    names = [""] * n
    for name, column in zip((*NATURAL_MODE_NAMES, FRAME_TORSION_MODE)[:n], place, strict=True):
        names[column] = name
    shapes[:, place] *= np.sign(shapes[np.arange(n), place])
    omega = np.sqrt(square)
    zeta = np.einsum("ji,jk,ki->i", shapes, C, shapes) / (2.0 * omega)
    return NaturalModes(tuple(names), omega / (2.0 * np.pi), zeta, shapes)


def wheel_response(model: LinearModel, f: np.ndarray) -> np.ndarray:
    """Complex responses (F, S, 4) [m/s² per m] at `f` (F,) [Hz] to each wheel's road height."""
    s, inside = _state_response(model, f, model.B)
    inputs = model.C @ inside + model.D
    return inputs[:, :, :4] + s * inputs[:, :, 4:]


def strut_rate_response(model: LinearModel, f: np.ndarray) -> np.ndarray:
    """Complex responses (F, 4, 4) [m/s per m] of the struts' rates of extension at `f` (F,) [Hz]
    to each wheel's road height.
    """
    s, inside = _state_response(model, f, model.B)
    inputs = model.strut_rows @ inside[:, model.M.size :]
    return inputs[:, :, :4] + s * inputs[:, :, 4:]


def force_response(model: LinearModel, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Complex responses at `f` (F,) [Hz] to a force in each strut beside its own, which pushes the
    body up and the axle down: of the sensors (F, S, 4) [m/s² per N], and of the struts' rates of
    extension (F, 4, 4) [m/s per N].
    """
    force = model.strut_rows.T / model.M[:, None]
    _, inside = _state_response(model, f, np.vstack([np.zeros_like(force), force]))
    return model.C @ inside + model.sensor_rows @ force, model.strut_rows @ inside[:, N_DOF:]


def _state_response(model: LinearModel, f: np.ndarray, inputs: np.ndarray):
    """The variable s = 2 pi j f (F, 1, 1), and the state's responses (F, 14, inputs) there."""
    s = 2j * np.pi * np.atleast_1d(np.asarray(f, dtype=float))[:, None, None]
    return s, np.linalg.solve(s * np.eye(len(model.A)) - model.A, inputs)


def frequency_response(
    model: LinearModel, v: float, *, f: np.ndarray | None = None, n: np.ndarray | None = None
) -> np.ndarray:
    """Complex responses (F, S, 2) [m/s² per m] to the left and the right wheel path.

    At the speed `v` [m/s] and at frequencies `f` (F,) [Hz] or `n` (F,) [cycles/m], whichever is
    given. Phases are those of the road under the front axle. Raises ValueError.
    """
    if not (np.isfinite(v) and v > 0):
        raise ValueError(f"the speed must be positive, got {v} m/s")
    if (f is None) == (n is None):
        raise ValueError("frequencies are wanted as f [Hz] or as n [cycles/m], one of them")
    at = np.atleast_1d(np.asarray(f if n is None else v * np.asarray(n), dtype=float))
    return combine_wheel_paths(model, v, at, wheel_response(model, at))


def combine_wheel_paths(
    model: LinearModel, v: float, f: np.ndarray, wheels: np.ndarray
) -> np.ndarray:
    """Responses (F, K, 4) to the wheels' heights at `f` (F,) [Hz] as responses (F, K, 2) to the
    left and the right wheel path, driven at `v` [m/s].
    """
    delay = np.exp(-2j * np.pi * f * model.wheelbase / v)[:, None, None]
    return wheels[:, :, :2] + delay * wheels[:, :, 2:]
