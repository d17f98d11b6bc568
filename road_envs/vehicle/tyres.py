"""Force law of a tyre: a spring, which may be progressive, and a damper; a tyre never pulls."""

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import if_positive
from road_envs.kernels.simd_arrays import get
from road_envs.vehicle.parameters import VehicleParameters


def tyre_constants(car: VehicleParameters) -> dict[str, list[float]]:
    """Return k_t and k_t2 of each tyre; at the origin its secant stiffness is the nominal one."""
    variation, deltas = car.variation, car.tyre_deflections
    rise = variation.tyre_progression
    k = [factor * car.axles[w // 2].k_t for w, factor in enumerate(variation.tyre)]
    if not rise * max(deltas) < 1.0:
        raise ValueError(
            f"tyre_progression must be below {1.0 / max(deltas):.1f} 1/m, got {rise}: beyond it "
            "tyres would pull at first contact"
        )
    return {
        "k_t": [k[w] * (1.0 - rise * deltas[w // 2]) for w in range(4)],
        "k_t2": [k[w] * rise for w in range(4)],
    }


@kernel
def tyre_force(p, w, u, u_dot):
    """Return the load [N] of tyre `w`, its stiffness [N/m] and damping [N s/m].

    `u` [m] is the compression beyond the deflection at the origin, `u_dot` [m/s] its rate. With x
    the total compression, the spring force is E = (k_t + k_t2 x) x. The magnitude of the damper
    force is limited to E, so that the load stays between 0 and 2 E: a tyre never pulls, and the
    load of a wheel that approaches the ground starts from 0 at contact.
    """
    x = get(p.delta, w // 2) + u
    x = if_positive(-x, 0.0, x)  # this form propagates NaN, here and below
    k, c = get(p.k_t, w) + get(p.k_t2, w) * x, get(p.c_t, w)
    E, slope = k * x, k + get(p.k_t2, w) * x
    T, T_max = E + c * u_dot, E + E
    margin = T_max - T
    k, c = if_positive(margin, slope, slope + slope), if_positive(margin, c, 0.0)
    T = if_positive(margin, T, T_max)
    return if_positive(-T, 0.0, T), if_positive(T, k, 0.0), if_positive(T, c, 0.0)


@kernel
def tyre_curvature(p, w, u, u_dot):
    """Return d stiffness/du [N/m²] of tyre `w`, in the active branch of `tyre_force`."""
    _, k, _ = tyre_force(p, w, u, u_dot)
    x, bend = get(p.delta, w // 2) + u, 2.0 * get(p.k_t2, w)
    E = (get(p.k_t, w) + get(p.k_t2, w) * x) * x
    excess = get(p.c_t, w) * u_dot - E  # positive where the damper force is limited
    return if_positive(k, if_positive(excess, bend + bend, bend), 0.0)
