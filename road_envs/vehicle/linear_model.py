"""Linearised vehicle: state space, natural modes, frequency response.

About a state y_0 on road heights z_0, deviations follow

    x' = A x + B u,      a = C x + D u

with x (14,) the coordinates and their rates, u (8,) the road heights [m] and their rates [m/s]
under the four wheels, and a the vertical accelerations [m/s²] of points (x_i, y_i) of the body,
heave - x_i pitch + y_i roll, or of the axles, heave + y_i roll. The rear wheels follow the front
ones at the wheelbase L, so the responses to the two wheel paths are

    H_side(f) = H_front(f) + exp(-2 pi j f L / v) H_rear(f),   H_wheel = H_z + 2 pi j f H_w

If front and rear suspension are equal, the height difference of the paths does not excite body
roll at n = f / v = (2 k + 1) / (2 L).

Friction is a steep damper near standstill: its slope at rest, 14 kN s/m per strut for the Defender
in ride mode, is valid below 0.01 m/s only. On a road, `gaussian_damping` gives the equivalent
damper of the same curves (statistical linearisation: Roberts & Spanos 1990, "Random Vibration and
Statistical Linearization", section 5.2), to be passed to `linearise`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from road_envs.kernels._numba import kernel
from road_envs.vehicle import equations
from road_envs.vehicle.equations import DOF, N_DOF, Motion, Plant, build_plant, extension
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.side_motion import inverse_inertia, side_jacobian
from road_envs.vehicle.suspension import WHEELS, encode_command, settled_strut_state, strut_force
from road_envs.vehicle.tyres import tyre_force


@dataclass(frozen=True, eq=False)
class LinearModel:
    """State-space model x' = A x + B u, a = C x + D u with S sensors, and names.

    Of heights [m], angles [rad], their rates [1/s] and accelerations [m/s²]. A flexible frame adds
    an eighth coordinate, so that there are 16 states; side motion two deflections and two rates or
    twice these.
    """

    A: np.ndarray  # (14, 14)
    B: np.ndarray  # (14, 8)
    C: np.ndarray  # (S, 14)
    D: np.ndarray  # (S, 8)
    M: np.ndarray  # (7,): masses [kg] and inertias [kg m²] of the coordinates
    strut_rows: np.ndarray  # (4, 7): extensions of the struts by the coordinates
    sensor_rows: np.ndarray  # (S, 7): heights of the sensors by the coordinates
    wheelbase: float  # [m]
    sensors: tuple[str, ...]
    inverse_inertia: np.ndarray | None = None
    speed: float | None = None  # [m/s] of the model; None without side motion
    states: tuple[str, ...] = (*DOF, *(f"{name}_dot" for name in DOF))
    inputs: tuple[str, ...] = (*(f"z_{w}" for w in WHEELS), *(f"w_{w}" for w in WHEELS))


def linearise(
    car: Plant | VehicleParameters,
    mode: str | Mapping[str, str] | np.ndarray,
    sensors: Mapping[str, tuple[Any, ...]],
    state: np.ndarray | None = None,
    z_r: np.ndarray | None = None,
    w_r: np.ndarray | None = None,
    damping: np.ndarray | None = None,
    *,
    speed: float = 0.0,
) -> LinearModel:
    """Linearise the vehicle about a `state` (14,), by default its static equilibrium.

    `mode` as in `suspension.encode_command`, or a strut state (4, 3), which is held constant.
    `sensors`: name -> (x, y) [m], ahead and to the left of the body's centre of mass, and the axle
    (0 or 1) if it is mounted there, as in `equations.sensor_row`. `z_r`, `w_r`
    (4,): road heights [m] and rates [m/s] under the wheels, 0 by default. `damping` (4,) [N s/m]
    replaces the slopes of the struts' force curves. `speed` [m/s]: that of a vehicle with side
    motion, on which its tyres' forces depend; others do not read it. About a state that is not an
    equilibrium, the model describes deviations from the motion as long as the slopes are constant.
    Raises ValueError on a wrong shape and ArithmeticError if there is no static equilibrium.
    """
    plant = car if isinstance(car, Plant) else build_plant(car)
    strut_state = mode if isinstance(mode, np.ndarray) else _settled(car, mode)
    z, w = (np.zeros(4) if v is None else np.array(v, dtype=float) for v in (z_r, w_r))
    y = equilibrium(plant, strut_state, z) if state is None else np.array(state, dtype=float)
    n = plant.n_dof
    given = {"state": y, "z_r": z, "w_r": w, "strut state": strut_state}
    for (name, value), shape in zip(given.items(), [(2 * n,), (4,), (4,), (4, 3)], strict=True):
        if value.shape != shape:
            raise ValueError(f"{name} must be of shape {shape}, got {value.shape}")
    A, B = jacobian(plant, strut_state, y, z, w, speed), _road_input_matrix(plant, y, z, w)
    if damping is not None:
        A[n:, n:] += _damping_correction(plant, strut_state, y, np.asarray(damping, dtype=float))
    own, heights = plant.inertias.size, point_rows(plant, sensors.values())
    axles = plant.constants[0]["x"]
    C, D = heights @ A[n:], heights @ B[n:]
    struts, wheelbase = _as_matrix(extension, plant), float(axles[0] - axles[1])
    names, side = (*DOF, "psi")[:own], plant.n_dof - own
    coordinates = (*names, *("d_f", "d_r", "y_f", "y_r")[:side])
    rates = (*(f"{name}_dot" for name in names), *("V", "r", "w_f", "w_r")[:side])
    return LinearModel(
        *(A, B, C, D, plant.inertias.copy(), struts, heights, wheelbase, tuple(sensors)),
        inverse_inertia=inverse_inertia(plant.constants[0], plant.inertias) if side else None,
        speed=float(speed) if side else None,
        states=(*coordinates, *rates),
    )


def jacobian(
    plant: Plant,
    strut_state: np.ndarray,
    state: np.ndarray,
    z_r: np.ndarray,
    w_r: np.ndarray,
    speed: float = 0.0,
):
    """Return the Jacobian (14, 14) of the state's rate by the state; (16, 16) if flexible. With
    side motion there are four more states or eight, and it depends on the `speed` [m/s].
    """
    M, n = plant.inertias[:, None], plant.inertias.size
    K, C = np.empty((n, n)), np.empty((n, n))
    motion = Motion(state[:n].copy(), state[plant.n_dof : plant.n_dof + n].copy())
    equations.stiffness_and_damping(plant.buffers(strut_state), motion, z_r, w_r, K, C)
    if plant.sideways:
        return side_jacobian(plant.constants[0], plant.inertias, K, C, speed)
    return np.block([[np.zeros((n, n)), np.eye(n)], [-K / M, -C / M]])


def point_rows(plant: Plant, places: Iterable[tuple[Any, ...]]) -> np.ndarray:
    """Return the heights (S, n) of points by the coordinates; `places` as of `sensor_row`."""
    own = plant.inertias.size
    rows = np.array([equations.sensor_row(*place)[:own] for place in places]).reshape(-1, own)
    return np.pad(rows, ((0, 0), (0, plant.n_dof - own)))


def _as_matrix(law, plant: Plant) -> np.ndarray:
    """Return a linear function of coordinates and wheel as a matrix (4, n)."""
    p, unit = plant.constants[0], np.eye(N_DOF)
    rows = np.array([[law(p, unit[j], w) for j in range(N_DOF)] for w in range(4)])
    if plant.flexible:
        twist = [equations.twist_extension(p, 1.0, w) for w in range(4)]
        rows = np.column_stack([rows, twist if law is extension else np.zeros(4)])
    return np.pad(rows, ((0, 0), (0, plant.n_dof - rows.shape[1])))


def _accelerations(plant: Plant, forces: np.ndarray) -> np.ndarray:
    """Return the accelerations (n, k) of the rates by generalised `forces` (n, k) on them."""
    if plant.sideways:
        return inverse_inertia(plant.constants[0], plant.inertias) @ forces
    return forces / plant.inertias[:, None]


def _road_input_matrix(plant: Plant, y: np.ndarray, z: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return B (14, 8) at the state `y`; a tyre without ground contact transmits nothing."""
    rows = _as_matrix(equations.wheel_height, plant)
    n = rows.shape[1]
    u, u_dot = z - rows @ y[:n], w - rows @ y[n:]
    slopes = [tyre_force(plant.constants[0], i, u[i], u_dot[i])[1:] for i in range(4)]
    k_t, c_t = np.array(slopes).T
    B = np.zeros((2 * n, 8))
    B[n:] = _accelerations(plant, np.hstack([rows.T * k_t, rows.T * c_t]))
    return B


def _damping_correction(plant: Plant, strut_state, y: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the change of the rate block (n, n) of A if strut damping becomes `target` (4,)."""
    rows = _as_matrix(extension, plant)
    e, e_dot = rows @ y[: rows.shape[1]], rows @ y[rows.shape[1] :]
    vehicle = plant.buffers(strut_state)
    current = [strut_force(vehicle, w, e[w], e_dot[w])[2] for w in range(4)]
    return _accelerations(plant, rows.T @ ((np.array(current) - target)[:, None] * rows))


def gaussian_damping(
    car: Plant | VehicleParameters, mode: str | Mapping[str, str], rate: float | np.ndarray
) -> np.ndarray:
    """Return the equivalent dampers (4,) [N s/m] of the struts in Gaussian motion. `rate` [m/s],
    scalar or (4,): standard deviation of the rate of extension. The damper has the least
    mean-square force error: c = E[F(e_dot) e_dot] / E[e_dot²]. Raises ValueError.
    """
    plant = car if isinstance(car, Plant) else build_plant(car)
    rate = np.broadcast_to(np.asarray(rate, dtype=float), (4,))
    if not (np.isfinite(rate) & (rate > 0)).all():
        raise ValueError(
            f"rate, a standard deviation, must be positive and finite, got {rate.tolist()} m/s"
        )
    x = np.linspace(-6.0, 6.0, 1201)
    weight = x * np.exp(-0.5 * x**2)
    weight /= weight @ x
    F = strut_forces(plant, mode, np.zeros((4, x.size)), rate[:, None] * x)
    return -(F @ weight) / rate  # the constant spring force cancels: the weight is odd


def strut_forces(
    car: Plant | VehicleParameters, mode: str | Mapping[str, str], e: np.ndarray, e_dot: np.ndarray
) -> np.ndarray:
    """Return the upward forces (4, K) [N] of struts with settled valves on the body, at extensions
    `e` [m] and their rates `e_dot` [m/s], both (4, K).
    """
    plant = car if isinstance(car, Plant) else build_plant(car)
    forces = np.empty(e.shape)
    _strut_forces(plant.buffers(_settled(car, mode)), e, e_dot, forces)
    return forces


def _settled(car: Plant | VehicleParameters, mode: str | Mapping[str, str]) -> np.ndarray:
    """Return the strut state (4, 3) of a mode, which must be one of the car's if that is known."""
    known = car if isinstance(car, VehicleParameters) else None
    return settled_strut_state(encode_command(mode, known))


@kernel
def _strut_forces(vehicle, e, e_dot, out):
    for w in range(4):
        for k in range(e.shape[1]):
            out[w, k] = strut_force(vehicle, w, e[w, k], e_dot[w, k])[0]


def _wheel_response(model: LinearModel, f: np.ndarray) -> np.ndarray:
    """Return the complex responses (F, S, 4) [m/s² per m] to the road height under each wheel."""
    s, states = _road_response(model, f)
    return s**2 * (model.sensor_rows @ states[:, : len(model.A) // 2])


def strut_rate_response(model: LinearModel, f: np.ndarray) -> np.ndarray:
    """Return the responses (F, 4, 4) [m/s per m] of the rates of extension to the road height under
    each wheel, complex, at `f` (F,) [Hz].
    """
    s, states = _road_response(model, f)
    return s * (model.strut_rows @ states[:, : len(model.A) // 2])


def force_response(model: LinearModel, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the complex responses at `f` (F,) [Hz] to an additional force in each strut. A
    positive force pushes the body up and the axle down. Responses of the sensors (F, S, 4) [m/s²
    per N] and of the struts' rates of extension (F, 4, 4) [m/s per N].
    """
    s, forces, inverse = _laplace_variable(f), model.strut_rows.T, model.inverse_inertia
    push = forces / model.M[:, None] if inverse is None else inverse @ forces
    q = _states(model, s, push)[:, : len(model.A) // 2]
    return s**2 * (model.sensor_rows @ q), s * (model.strut_rows @ q)


def _road_response(model: LinearModel, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return s (F, 1, 1), and the states (F, 2 n, 4) by the road height under each wheel."""
    s = _laplace_variable(f)
    of_height, of_rate = np.split(model.B[len(model.A) // 2 :], 2, axis=1)
    return s, _states(model, s, of_height + s * of_rate)


def _laplace_variable(f: np.ndarray) -> np.ndarray:
    """Return s = 2 pi j f (F, 1, 1)."""
    return 2j * np.pi * np.atleast_1d(np.asarray(f, dtype=float))[:, None, None]


def _states(
    model: LinearModel, s: np.ndarray, rates: np.ndarray, coordinates: np.ndarray | None = None
) -> np.ndarray:
    """Return the states (F, 2 n, I) under additional rates of change of the rates, and with side
    motion of the coordinates, (n, I) or (F, n, I), at `s` (F, 1, 1).
    """
    n = len(model.A) // 2
    upper, lower = np.split(model.A, 2)
    (relaxing, moving), (stiffness, damping) = np.hsplit(upper, 2), np.hsplit(lower, 2)
    if model.speed is None:
        system = s * -damping - stiffness
        system[:, range(n), range(n)] += s[:, 0] ** 2
        q = np.linalg.solve(system, rates)
        return np.concatenate([q, s * q], axis=1)
    # the coordinates follow the rates by a diagonal block: 0, or the tyres' relaxation
    follow = 1.0 / (s - np.diag(relaxing)[:, None])  # (F, n, 1)
    right = rates
    if coordinates is not None:
        right = right + stiffness @ (follow * coordinates)
    v = np.linalg.solve(s * np.eye(n) - damping - stiffness @ (follow * moving), right)
    q = moving @ v if coordinates is None else moving @ v + coordinates
    return np.concatenate([follow * q, v], axis=1)


def frequency_response(
    model: LinearModel, v: float, *, f: np.ndarray | None = None, n: np.ndarray | None = None
) -> np.ndarray:
    """Return the complex responses (F, S, 2) [m/s² per m] to the left and right wheel path. `v`:
    speed [m/s]. Give either frequencies `f` (F,) [Hz] or spatial frequencies `n` (F,) [cycles/m].
    Phases refer to the road under the front axle. Raises ValueError.
    """
    if not (np.isfinite(v) and v > 0):
        raise ValueError(f"the speed must be positive, got {v} m/s")
    if model.speed is not None and abs(model.speed - v) > 1e-6 * v:
        raise ValueError(f"a vehicle with side motion linearised at {model.speed:g} m/s, not {v:g}")
    if (f is None) == (n is None):
        raise ValueError(
            "give frequencies either as f [Hz] or as n [cycles/m], not both or neither"
        )
    hertz = np.atleast_1d(np.asarray(f if n is None else v * np.asarray(n), dtype=float))
    return combine_wheel_paths(model, v, hertz, _wheel_response(model, hertz))


def response_changes(
    model: LinearModel, others: Sequence[LinearModel], v: float, f: np.ndarray
) -> np.ndarray:
    """Return the changes (P, F, S, 2) of the frequency response if `model` becomes each of the P
    `others`, to first order in the change of the matrices.

    With x = (s - A)^-1 B u the change of the accelerations of the coordinates by dA and dB is that
    by additional accelerations dA x + dB u. `v` [m/s], `f` (F,) [Hz] as in `frequency_response`.
    """
    n, (s, states) = len(model.A) // 2, _road_response(model, f)
    u, unit = np.broadcast_to(np.eye(4), (s.size, 4, 4)), np.eye(2 * n)
    # states, heights and their rates
    paths = combine_wheel_paths(model, v, f, np.concatenate([states, u, s * u], axis=1))
    change = np.array([np.hstack([one.A - model.A, one.B - model.B]) for one in others])
    if model.speed is None:
        change = change[:, n:]
        sensed = s**2 * (model.sensor_rows @ _states(model, s, unit[:n, :n])[:, :n])
    else:  # the rates of the deflections change too
        sensed = s * (model.sensor_rows @ _states(model, s, unit[n:], unit[:n])[:, n:])
    rates = (change.reshape(-1, change.shape[2]) @ paths).reshape(s.size, -1, change.shape[1], 2)
    return np.moveaxis(sensed[:, None] @ rates, 1, 0)


def combine_wheel_paths(
    model: LinearModel, v: float, f: np.ndarray, wheels: np.ndarray
) -> np.ndarray:
    """Combine responses (F, K, 4) to the four wheels into responses (F, K, 2) to the wheel paths.
    `f` (F,) [Hz]; `v` [m/s]: speed, which sets the delay between the axles.
    """
    delay = np.exp(-2j * np.pi * f * model.wheelbase / v)[:, None, None]
    return wheels[:, :, :2] + delay * wheels[:, :, 2:]
