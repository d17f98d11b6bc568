"""Force laws of one 4S4 strut and one tyre, and the commands that switch the struts.

Strut forces push the body up; `e` [m] is the extension from the static length, `e_dot` [m/s] its
rate. Five components (paper, section 2.3), the measured ones as tabulated cubics:

    gas spring   F = p_stat A (x_1 / (x_1 + e - e_2))^n_p                       eq. 1
    damper       function of e_dot, low (ride) and high (handling)              Fig. 1a
    friction     Stribeck function of e_dot, one for each damper setting        Fig. 1b
    bushing      function of e, small inside -0.1 ... +0.05 m                   Fig. 1c
    bump stop    function of e, one for each axle                               Fig. 1d

Two accumulators: the first, of static column x_1, is always open to the strut; the second, x_2,
stands behind a valve. e_2 is the part of the extension that the second has taken up. Valve open:
the pressures are equal, e_2 = e x_2 / (x_1 + x_2), and the law is eq. 1 with x_stat = x_1 + x_2
(ride). Valve closed: e_2 is frozen with the gas behind it, and x_stat = x_1 (handling). Between,
with u the open fraction of the valve, T the time constant of equalisation and r = x_2/(x_1 + x_2),

    de_2/dt = u r de/dt + u (r e - e_2) / T

so the force is continuous through every switch, and a switch under deflection shifts the ride
height.
"""

from collections.abc import Mapping

import numpy as np

from road_envs._numba import kernel
from road_envs.config import ConfigError, validate_choice
from road_envs.simulation.simd import equals_one, get, if_positive, is_zero_or_one, maximum, power
from road_envs.vehicle.force_curves import interpolate_table, second_derivative, tabulate
from road_envs.vehicle.parameters import NOMINAL, VehicleParameters, VehicleVariation

WHEELS = ("FL", "FR", "RL", "RR")
MODES = {
    "ride": (False, False),
    "handling": (True, True),
    "soft_high": (False, True),
    "stiff_low": (True, False),
}
"""The four states of a strut: (stiff spring, high damping)."""

V_0, V_STEP, V_CELLS = -3.0, 0.01, 600
E_0, E_STEP, E_CELLS = -0.2, 0.0025, 160
"""Grids of the tables, over rate of extension [m/s] and extension [m]."""

HELD_EXTENSION, VALVE_OPEN, DAMPING_HIGH = 0, 1, 2
"""Columns of the struts' memory (4, 3): the held extension o [m] of the second accumulator, in
e_2 = o + u r e; the open fraction u of the valve; the share of high damping. o is 0 as long as the
valve stays open, and e_2 itself once it is closed."""


def encode_command(mode: str | Mapping[str, str]) -> int:
    """A 4S4 command as one byte: bit w is a stiff spring, bit 4 + w high damping at wheel w.

    `mode` is a name from MODES for the whole vehicle, or a mapping from "front" and "rear", or
    from all of FL, FR, RL, RR, to such names. Raises ConfigError.
    """
    if isinstance(mode, Mapping):
        if set(mode) == {"front", "rear"}:
            wheels = [mode["front"], mode["front"], mode["rear"], mode["rear"]]
        elif set(mode) == set(WHEELS):
            wheels = [mode[w] for w in WHEELS]
        else:
            raise ConfigError(f"a mode is set for front and rear or for {WHEELS}, got {list(mode)}")
    else:
        wheels = [mode] * 4
    states = [MODES[validate_choice("suspension mode", m, MODES)] for m in wheels]
    return sum((stiff << w) | (high << (4 + w)) for w, (stiff, high) in enumerate(states))


def decode_commands(commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stiff-spring and high-damping flags (N, 4) of command bytes (N,)."""
    bits = (np.asarray(commands, dtype=np.uint8)[:, None] >> np.arange(8)) & 1
    return bits[:, :4].astype(bool), bits[:, 4:].astype(bool)


def settled_strut_state(byte: int) -> np.ndarray:
    """Memory (4, 3) of struts that have long stood at their static length under a command."""
    strut_state = np.zeros((4, 3))
    stiff, high = decode_commands(np.array([byte]))
    strut_state[:, VALVE_OPEN] = ~stiff[0]
    strut_state[:, DAMPING_HIGH] = high[0]
    return strut_state


def velocity_tables(
    car: VehicleParameters, one: VehicleVariation = NOMINAL
) -> tuple[np.ndarray, list[int]]:
    """Damper plus friction, tables (K, V_CELLS, 4), and for each strut its ride table's number.

    The handling table stands behind it. Equal struts share theirs.
    """
    damper, friction = car.strut.damper, car.strut.friction
    factors = list(zip(one.damper, one.friction, strict=True))
    different = list(dict.fromkeys(factors))
    tables = [
        tabulate((law.scaled(d), rub.scaled(f)), V_0, V_STEP, V_CELLS)
        for d, f in different
        for law, rub in ((damper.ride, friction.ride), (damper.handling, friction.handling))
    ]
    return np.stack(tables), [2 * different.index(pair) for pair in factors]


def displacement_tables(
    car: VehicleParameters, one: VehicleVariation = NOMINAL
) -> tuple[np.ndarray, list[int]]:
    """Bushing plus bump stop, tables (K, E_CELLS, 4), and each strut's number among them."""
    stops = (car.strut.bump_stop.front, car.strut.bump_stop.rear)
    which = [(w // 2, factor) for w, factor in enumerate(one.bushing)]
    different = list(dict.fromkeys(which))
    tables = [
        tabulate((car.strut.bushing.scaled(factor), stops[axle]), E_0, E_STEP, E_CELLS)
        for axle, factor in different
    ]
    return np.stack(tables), [different.index(each) for each in which]


@kernel
def gas_spring(p, w, column):
    """Force [N] of strut `w` and its derivative by the gas column [N/m].

    Below the shortest column it goes on as its tangent.
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
def gas_column(p, strut_state, w, e):
    """Column [m] of the first accumulator of strut `w`, and its derivative by the extension."""
    share = 1.0 - get(strut_state, w, VALVE_OPEN) * get(p.r_2)
    return get(p.x_1) + share * e - get(strut_state, w, HELD_EXTENSION), share


@kernel
def advance_valve(p, strut_state, w, e, stiff, high, alpha, h):
    """Advance the memory of strut `w` by one step `h` [s] of its valves at extension `e`.

    `alpha` is the share of the way to its target that a valve goes in one step.
    """
    u = strut_state[w, VALVE_OPEN]
    target = 0.0 if stiff else 1.0
    closing = u + alpha * (target - u)
    if abs(target - closing) < 1e-9:
        closing = target
    held = strut_state[w, HELD_EXTENSION] + (u - closing) * p.r_2 * e
    lack = (1.0 - closing) * p.r_2 * e - held
    held += lack * (1.0 - np.exp(-closing * h / p.equalisation))
    strut_state[w, HELD_EXTENSION] = 0.0 if closing == 1.0 and abs(held) < 1e-12 else held
    strut_state[w, VALVE_OPEN] = closing
    target = 1.0 if high else 0.0
    d = strut_state[w, DAMPING_HIGH] + alpha * (target - strut_state[w, DAMPING_HIGH])
    strut_state[w, DAMPING_HIGH] = target if abs(target - d) < 1e-9 else d


@kernel
def valves_settled(strut_state, w, stiff, high):
    """Whether the valves of strut `w` have long followed their command."""
    if strut_state[w, DAMPING_HIGH] != high:
        return False
    return (
        strut_state[w, VALVE_OPEN] == 0.0
        if stiff
        else strut_state[w, VALVE_OPEN] == 1.0 and strut_state[w, HELD_EXTENSION] == 0.0
    )


@kernel
def damping_force(p, velocity, strut_state, w, e_dot):
    """Damper plus friction [N] over the rate of extension, and the derivative [N s/m]."""
    high = get(strut_state, w, DAMPING_HIGH)
    if is_zero_or_one(high):
        return interpolate_table(velocity, get(p.velocity_table, w) + high, V_0, V_STEP, e_dot)
    F_0, c_0 = interpolate_table(velocity, get(p.velocity_table, w), V_0, V_STEP, e_dot)
    F_1, c_1 = interpolate_table(velocity, get(p.velocity_table, w) + 1.0, V_0, V_STEP, e_dot)
    low = 1.0 - high  # exact at either end, so that a lane does not feel the others' switching
    return low * F_0 + high * F_1, low * c_0 + high * c_1


@kernel
def strut_force(p, velocity, displacement, strut_state, w, e, e_dot):
    """Force [N] of strut `w`, its stiffness -dF/de [N/m] and damping -dF/de_dot [N s/m]."""
    column, share = gas_column(p, strut_state, w, e)
    gas, slope = gas_spring(p, w, column)
    damper, c = damping_force(p, velocity, strut_state, w, e_dot)
    stop, k = interpolate_table(displacement, get(p.displacement_table, w), E_0, E_STEP, e)
    return gas - damper - stop, k - slope * share, c


@kernel
def strut_curvature(p, velocity, displacement, strut_state, w, e, e_dot):
    """Change of a strut's stiffness with `e` [N/m²] and of its damping with `e_dot` [N s²/m²]."""
    column, share = gas_column(p, strut_state, w, e)
    _, slope = gas_spring(p, w, column)
    bend = -(get(p.n_p) + 1.0) * slope / maximum(column, get(p.column_min))
    gas = if_positive(column - get(p.column_min), bend, 0.0)
    stop = second_derivative(displacement, get(p.displacement_table, w), E_0, E_STEP, e)
    high = get(strut_state, w, DAMPING_HIGH)
    c_0 = second_derivative(velocity, get(p.velocity_table, w), V_0, V_STEP, e_dot)
    c_1 = second_derivative(velocity, get(p.velocity_table, w) + 1.0, V_0, V_STEP, e_dot)
    return stop - share * share * gas, (1.0 - high) * c_0 + high * c_1


@kernel
def tyre_force(p, w, u, u_dot):
    """Load [N] of tyre `w`, its stiffness and damping.

    `u` [m] is the compression beyond the deflection at the origin, `u_dot` [m/s] its rate. The
    spring's force E = (k_t + k_t2 x) x grows with the whole compression x; the damper adds to it
    or takes away, but never more than E itself. So the load lies between 0 and 2 E: a tyre never
    pulls, and one that closes in on the ground pushes from the touch on and not before.
    """
    x = get(p.delta, w // 2) + u
    x = if_positive(-x, 0.0, x)  # what is not a number stays so, here and below
    k, c = get(p.k_t, w) + get(p.k_t2, w) * x, get(p.c_t, w)
    E, slope = k * x, k + get(p.k_t2, w) * x
    T, most = E + c * u_dot, E + E
    free = most - T
    k, c = if_positive(free, slope, slope + slope), if_positive(free, c, 0.0)
    T = if_positive(free, T, most)
    return if_positive(-T, 0.0, T), if_positive(T, k, 0.0), if_positive(T, c, 0.0)


@kernel
def tyre_curvature(p, w, u, u_dot):
    """Change of a tyre's stiffness with its compression [N/m²], in the branch of `tyre_force`."""
    _, k, _ = tyre_force(p, w, u, u_dot)
    x, bend = get(p.delta, w // 2) + u, 2.0 * get(p.k_t2, w)
    E = (get(p.k_t, w) + get(p.k_t2, w) * x) * x
    at_most = get(p.c_t, w) * u_dot - E
    return if_positive(k, if_positive(at_most, bend + bend, bend), 0.0)
