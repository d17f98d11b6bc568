"""Force laws of one 4S4 strut, and the commands that switch the struts.

Positive strut forces push the body up; `e` [m] is the extension from the static length, `e_dot`
[m/s] its rate. A strut has five components (paper, section 2.3); all but the gas spring are
tabulated cubics of measured curves:

    gas spring   F = p_stat A (x_1 / (x_1 + e - e_2))^n_p                       eq. 1
    damper       function of e_dot, low (ride) and high (handling)              Fig. 1a
    friction     Stribeck function of e_dot, one for each damper setting        Fig. 1b
    bushing      function of e, small inside -0.1 ... +0.05 m                   Fig. 1c
    bump stop    function of e, one for each axle                               Fig. 1d

The first accumulator, with static gas column x_1, is always connected to the strut; the second,
with x_2, is behind a valve and takes up the part e_2 of the extension. Valve open: the pressures
are equal, e_2 = e x_2 / (x_1 + x_2), and eq. 1 holds with x_stat = x_1 + x_2 (ride). Valve closed:
the gas behind the valve is trapped, e_2 is constant, and x_stat = x_1 (handling). In between, with
u the open fraction of the valve, T the time constant of equalisation and r = x_2 / (x_1 + x_2),

    de_2/dt = u r de/dt + u (r e - e_2) / T

The force is therefore continuous through every switch, and a switch under deflection shifts the
ride height.

A passive strut has the same form, so that the same kernels run it: its gas column is endless, which
makes the gas force the constant static load; what the spring has more or less at an extension is in
the table of displacement, its damper and friction in both tables of velocity.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from road_envs.core.config import ConfigError, validate_choice
from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import equals_one, if_positive, is_zero_or_one, maximum, power
from road_envs.kernels.simd_arrays import get
from road_envs.records.record import Record
from road_envs.vehicle import force_curves
from road_envs.vehicle.force_curves import Curve, Law, interpolate_table, second_derivative
from road_envs.vehicle.parameters import UNIT_FACTORS, VehicleParameters
from road_envs.vehicle.struts import MODES, PASSIVE_MODES, PassiveStrut, Strut

WHEELS = ("FL", "FR", "RL", "RR")
ALL_MODES = MODES | PASSIVE_MODES
ENDLESS = 1e12  # gas column [m] that no extension changes: a spring's constant static load

V_0, V_STEP, V_CELLS = -3.0, 0.01, 600
E_0, E_STEP, E_CELLS = -0.2, 0.0025, 160
"""Grids of the force tables over rate of extension [m/s] and extension [m]."""

HELD_EXTENSION, VALVE_OPEN, DAMPING_HIGH = 0, 1, 2
"""Columns of the strut state (4, 3): the held extension o [m] of the second accumulator, defined by
e_2 = o + u r e; the open fraction u of its valve; the share of high damping. o is 0 while the valve
is open and equals e_2 once it is closed."""


class VehicleBuffers(NamedTuple):
    """One vehicle, or LANES of them, as kernels read it: its constants and laws of the struts."""

    constants: np.ndarray  # (1,) of `equations.PLANT_DTYPE`; lanes: a last axis in each field
    velocity: np.ndarray  # tables of an `equations.Plant`, as is `displacement`
    displacement: np.ndarray
    strut_state: np.ndarray  # (4, 3), selects among the tables, may be advanced in place


def encode_command(
    mode: str | Mapping[str, str] | None, car: VehicleParameters | None = None
) -> int:
    """Return a mode of the struts as a byte: bits w and 4 + w for stiff spring and high damping.

    `mode` is the name of a mode for the whole vehicle, or a mapping from "front" and "rear", or
    from all of FL, FR, RL, RR, to such names. With a `car` it must be one of its own, and None is
    its first. Raises ConfigError.
    """
    modes = ALL_MODES if car is None else car.modes
    if not isinstance(mode, Mapping):
        wheels = [next(iter(modes)) if mode is None else mode] * 4
    elif set(mode) == {"front", "rear"}:
        wheels = [mode["front"], mode["front"], mode["rear"], mode["rear"]]
    elif set(mode) == set(WHEELS):
        wheels = [mode[w] for w in WHEELS]
    else:
        raise ConfigError(
            f"a suspension mode needs the keys front and rear, or {', '.join(WHEELS)}, "
            f"got {list(mode)}"
        )
    foreign = [m for m in wheels if isinstance(m, str) and m in ALL_MODES and m not in modes]
    if car is not None and foreign:
        kind, own = "passive" if car.is_passive else "4S4", ", ".join(modes)
        raise ConfigError(f"the car {car.name} has {kind} struts: mode {own}, not {foreign[0]!r}")
    states = [modes[validate_choice("suspension mode", m, modes)] for m in wheels]
    return sum((stiff << w) | (high << (4 + w)) for w, (stiff, high) in enumerate(states))


def decode_commands(commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the stiff-spring and high-damping flags (N, 4) of command bytes (N,)."""
    bits = (np.asarray(commands, dtype=np.uint8)[:, None] >> np.arange(8)) & 1
    return bits[:, :4].astype(bool), bits[:, 4:].astype(bool)


def check_modes(record: Record, car: VehicleParameters) -> None:
    """Raise ConfigError if the struts of a record were switched but those of the car cannot be."""
    if car.is_passive and (record.spring_stiff.any() or record.damper_high.any()):
        raise ConfigError(
            f"the struts of the drive were stiff or highly damped, but the car {car.name} has "
            "passive struts: it is the drive of another car"
        )


def settled_strut_state(byte: int) -> np.ndarray:
    """Return the strut state (4, 3) at static length, with all valves settled at a command byte."""
    (stiff,), (high,) = decode_commands(np.array([byte]))
    return np.stack([np.zeros(4), ~stiff, high], axis=1)


def gas_constants(car: VehicleParameters) -> dict[str, object]:
    """Return the constants of the gas springs, by the names that `_gas_spring` reads."""
    strut = car.strut
    if isinstance(strut, Strut):
        return {
            "p_A": [factor * strut.p_stat * strut.A for factor in car.variation.gas],
            "n_p": strut.n_p,
            "x_1": strut.x_1,
            "r_2": strut.x_2 / (strut.x_1 + strut.x_2),
            "column_min": strut.column_min,
        }
    loads = [factor * car.strut_loads[w // 2] for w, factor in enumerate(car.variation.gas)]
    return {"p_A": loads, "n_p": 1.0, "x_1": ENDLESS, "r_2": 0.0, "column_min": 0.5 * ENDLESS}


def velocity_tables(car: VehicleParameters) -> tuple[np.ndarray, list[int]]:
    """Tabulate damper plus friction: tables (K, V_CELLS, 4), index of each strut's ride table,
    which its handling table follows. Equal struts share their tables.
    """
    factors = zip(car.variation.damper, car.variation.friction, strict=True)
    keys = [(w // 2 if car.is_passive else 0, *pair) for w, pair in enumerate(factors)]
    distinct = list(dict.fromkeys(keys))
    tables = [
        _table(((damper, d), (friction, f)), V_0, V_STEP, V_CELLS)
        for axle, d, f in distinct
        for damper, friction in _velocity_curves(car, axle)
    ]
    return np.stack(tables), [2 * distinct.index(key) for key in keys]


@lru_cache(maxsize=128)  # varied vehicles share most struts
def _table(curves: tuple[tuple[Curve, float], ...], x_0: float, dx: float, cells: int):
    return force_curves.tabulate([curve.scaled(factor) for curve, factor in curves], x_0, dx, cells)


def friction_peaks(car: VehicleParameters) -> np.ndarray:
    """Return the greatest friction [N] of each strut with low and with high damping (2, 4)."""
    peaks = [
        [factor * np.abs(curve.F).max() for _, curve in _velocity_curves(car, wheel // 2)]
        for wheel, factor in enumerate(car.variation.friction)
    ]
    return np.array(peaks).T


def _velocity_curves(car: VehicleParameters, axle: int) -> list[tuple[Curve, Curve]]:
    """Return damper and friction of an axle's struts, with low and with high damping."""
    if isinstance(car.strut, Strut):
        damper, friction = car.strut.damper, car.strut.friction
        return [(damper.ride, friction.ride), (damper.handling, friction.handling)]
    strut = (car.strut.front, car.strut.rear)[axle]
    return 2 * [(strut.at_wheel(strut.damper), strut.at_wheel(strut.friction))]


def displacement_tables(car: VehicleParameters) -> tuple[np.ndarray, list[int]]:
    """Tabulate bushing plus bump stop: tables (K, E_CELLS, 4), index of each strut's table, which
    of a passive strut also holds the force that its spring lacks to its static load.
    """

    def tabulated(key: tuple[int, float, float]) -> np.ndarray:
        axle, gas, factor = key
        bump_stop = car.bump_stops[axle]
        if isinstance(car.strut, Strut):
            curves = (car.strut.bushing, factor), (bump_stop, 1.0)
            return _table(curves, E_0, E_STEP, E_CELLS)
        strut = (car.strut.front, car.strut.rear)[axle]
        laws: list[Law] = [bump_stop, _spring_deficit(strut, car.strut_loads[axle], gas)]
        if strut.bushing is not None:
            laws.append(strut.at_wheel(strut.bushing).scaled(factor))
        return force_curves.tabulate(laws, E_0, E_STEP, E_CELLS)

    gas = car.variation.gas if car.is_passive else UNIT_FACTORS
    factors = zip(gas, car.variation.bushing, strict=True)
    keys = [(w // 2, *pair) for w, pair in enumerate(factors)]
    distinct = list(dict.fromkeys(keys))
    return np.stack([tabulated(key) for key in distinct]), [distinct.index(key) for key in keys]


def _spring_deficit(strut: PassiveStrut, load: float, factor: float) -> Law:
    # the static load of a spring less its force, both times `factor`, over extension
    def deficit(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        F, slope = strut.spring_force(e, load)
        return factor * (load - F), -factor * slope

    return deficit


@kernel
def _gas_spring(p, w, column):
    """Return the gas force [N] of strut `w` and its derivative by the gas column [N/m]. Below the
    shortest column the force continues linearly.
    """
    n_p = get(p.n_p)
    inside = maximum(column, get(p.column_min))
    ratio = get(p.x_1) / inside
    if not equals_one(n_p):
        ratio = power(ratio, n_p)
    F = get(p.p_A, w) * ratio
    slope = -n_p * F / inside
    return F + slope * (column - inside), slope


@kernel
def _gas_column(vehicle, w, e):
    """Return the gas column [m] of strut `w`'s first accumulator and its derivative by `e`."""
    p, strut_state = vehicle.constants[0], vehicle.strut_state
    share = 1.0 - get(strut_state, w, VALVE_OPEN) * get(p.r_2)
    return get(p.x_1) + share * e - get(strut_state, w, HELD_EXTENSION), share


@kernel
def advance_valve(p, strut_state, w, e, setting, alpha, h):
    """Advance the state of strut `w` by one step `h` [s] of its valves at extension `e`. `setting`
    is the commanded pair (stiff spring, high damping); `alpha` is the fraction of the way to its
    target that a valve moves in one step.
    """
    stiff, high = setting
    u = strut_state[w, VALVE_OPEN]
    target = 0.0 if stiff else 1.0
    u_next = u + alpha * (target - u)
    if abs(target - u_next) < 1e-9:  # a lag never ends; snap, so that valves_settled can be exact
        u_next = target
    held = strut_state[w, HELD_EXTENSION] + (u - u_next) * p.r_2 * e  # e_2 is continuous in u
    deficit = (1.0 - u_next) * p.r_2 * e - held
    held += deficit * (1.0 - np.exp(-u_next * h / p.equalisation))
    strut_state[w, HELD_EXTENSION] = 0.0 if u_next == 1.0 and abs(held) < 1e-12 else held
    strut_state[w, VALVE_OPEN] = u_next
    target = 1.0 if high else 0.0
    d = strut_state[w, DAMPING_HIGH] + alpha * (target - strut_state[w, DAMPING_HIGH])
    strut_state[w, DAMPING_HIGH] = target if abs(target - d) < 1e-9 else d


@kernel
def valves_settled(strut_state, w, setting):
    """Return whether the valves of strut `w` have reached the commanded `setting` exactly."""
    stiff, high = setting
    if strut_state[w, DAMPING_HIGH] != high:
        return False
    if stiff:
        return strut_state[w, VALVE_OPEN] == 0.0
    return strut_state[w, VALVE_OPEN] == 1.0 and strut_state[w, HELD_EXTENSION] == 0.0


@kernel
def _damping_force(vehicle, w, e_dot):
    """Return damper plus friction force [N] and its derivative by the rate of extension [N s/m]."""
    high = get(vehicle.strut_state, w, DAMPING_HIGH)
    ride = get(vehicle.constants[0].velocity_table, w)
    if is_zero_or_one(high):
        return interpolate_table(vehicle.velocity, ride + high, V_0, V_STEP, e_dot)
    F_0, c_0 = interpolate_table(vehicle.velocity, ride, V_0, V_STEP, e_dot)
    F_1, c_1 = interpolate_table(vehicle.velocity, ride + 1.0, V_0, V_STEP, e_dot)
    low = 1.0 - high  # exact at 0 and 1: a SIMD lane is independent of the other lanes' switching
    return low * F_0 + high * F_1, low * c_0 + high * c_1


@kernel
def strut_force(vehicle, w, e, e_dot):
    """Return force [N], stiffness -dF/de [N/m] and damping -dF/de_dot [N s/m] of strut `w`."""
    p = vehicle.constants[0]
    column, share = _gas_column(vehicle, w, e)
    gas, slope = _gas_spring(p, w, column)
    damper, c = _damping_force(vehicle, w, e_dot)
    stop, k = interpolate_table(vehicle.displacement, get(p.displacement_table, w), E_0, E_STEP, e)
    return gas - damper - stop, k - slope * share, c


@kernel
def strut_curvature(vehicle, w, e, e_dot):
    """Return d stiffness/de [N/m²] and d damping/de_dot [N s²/m²] of a strut."""
    p = vehicle.constants[0]
    column, share = _gas_column(vehicle, w, e)
    _, slope = _gas_spring(p, w, column)
    bend = -(get(p.n_p) + 1.0) * slope / maximum(column, get(p.column_min))
    gas = if_positive(column - get(p.column_min), bend, 0.0)
    stop = second_derivative(vehicle.displacement, get(p.displacement_table, w), E_0, E_STEP, e)
    high, ride = get(vehicle.strut_state, w, DAMPING_HIGH), get(p.velocity_table, w)
    c_0 = second_derivative(vehicle.velocity, ride, V_0, V_STEP, e_dot)
    c_1 = second_derivative(vehicle.velocity, ride + 1.0, V_0, V_STEP, e_dot)
    return stop - share * share * gas, (1.0 - high) * c_0 + high * c_1
