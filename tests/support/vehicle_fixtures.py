"""Vehicles, Hypothesis strategies and drives shared by the tests of the physics."""

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from road_envs.roads.surface import Surface
from road_envs.simulation import rosenbrock
from road_envs.simulation.drive import DriveInputs
from road_envs.vehicle.axles import Axle
from road_envs.vehicle.equations import Motion, accelerations, build_plant
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.parameters import (
    TorsionalFrame,
    VehicleParameters,
    VehicleVariation,
    load_vehicle,
)
from road_envs.vehicle.struts import _AxleCurves, _ModeCurves
from road_envs.vehicle.suspension import encode_command, settled_strut_state

DEFENDER = load_vehicle("land_rover_defender_110")


def unequal_axles_car() -> VehicleParameters:
    """Return a car with unequal axles, a polytropic gas spring and a slow valve."""
    front = Axle(x=1.2, m=190.0, I_xx=27.0, y_s=0.5, y_t=0.72, k_t=230000.0, c_t=900.0)
    rear = Axle(x=-1.6, m=260.0, I_xx=41.0, y_s=0.6, y_t=0.78, k_t=310000.0, c_t=1500.0)
    strut = replace(DEFENDER.strut, n_p=1.3, p_stat=1.9e6, x_1=0.06, x_2=0.17)
    valve = replace(DEFENDER.valve, lag=0.004, equalisation=0.05)
    return replace(
        DEFENDER,
        name="unequal_axles",
        m_b=1500.0,
        I_xx=600.0,
        I_yy=2600.0,
        h_cg=1.1,
        roll_centre=0.4,
        pitch_centre=0.7,
        front=front,
        rear=rear,
        strut=strut,
        valve=valve,
    )


def lossless(car: VehicleParameters) -> VehicleParameters:
    """Return the car without dampers, friction and tyre damping."""
    nothing = Curve(x=(-3.0, 3.0), F=(0.0, 0.0))
    none = _ModeCurves(ride=nothing, handling=nothing)
    return replace(
        car,
        front=replace(car.front, c_t=0.0),
        rear=replace(car.rear, c_t=0.0),
        strut=replace(car.strut, damper=none, friction=none),
    )


def varied_plant(car: VehicleParameters, variation: VehicleVariation, manoeuvres: bool = False):
    """Return the plant of a car with a variation in place of its own, which None leaves."""
    one = car if variation is None else replace(car, variation=variation)
    return build_plant(one, manoeuvres)


CARS = {"defender": DEFENDER, "unequal_axles": unequal_axles_car()}
PLANTS = {name: build_plant(car) for name, car in CARS.items()}
MANOEUVRE_PLANTS = {name: build_plant(car, manoeuvres=True) for name, car in CARS.items()}
VARIED = VehicleVariation(
    gas=(1.03, 0.96, 0.99, 1.02),
    damper=(1.1, 0.85, 1.2, 0.9),
    friction=(0.8, 1.3, 1.1, 0.9),
    bushing=(1.2, 0.9, 0.8, 1.1),
    tyre=(1.06, 0.95, 0.9, 1.08),
    tyre_progression=4.0,
    roll_stiffness=(5000.0, 2000.0),
)
"""A variation with unequal struts and tyres; VARIED_FLEXIBLE adds a flexible frame."""
VARIED_FLEXIBLE = replace(VARIED, frame=TorsionalFrame(f=11.0, zeta=0.05))
VARIATIONS = {"varied": VARIED, "flexible": VARIED_FLEXIBLE}
_NO_FORCE = Curve(x=(-1.0, 1.0), F=(0.0, 0.0))
WITHOUT_STOPS = replace(
    CARS["unequal_axles"],
    strut=replace(
        CARS["unequal_axles"].strut,
        bushing=_NO_FORCE,
        bump_stop=_AxleCurves(front=_NO_FORCE, rear=_NO_FORCE),
    ),
)
"""The car with unequal axles without bushings and bump stops."""
VARIED_PLANTS = {name: varied_plant(CARS["unequal_axles"], one) for name, one in VARIATIONS.items()}
VARIED_MANOEUVRE_PLANTS = {
    name: varied_plant(CARS["unequal_axles"], one, True) for name, one in VARIATIONS.items()
}
FLAT_SURFACE = Surface(np.zeros((2, 8)), 1.0, name="level")
ZEROS = np.zeros(4)


def vectors(size: int, *bounds: float):
    """Return a strategy of arrays (size,) within ± `bounds`, which are cycled."""
    limits = [bounds[i % len(bounds)] for i in range(size)]
    return st.tuples(*(st.floats(-b, b) for b in limits)).map(np.array)


coordinates = vectors(7, 0.12, 0.1, 0.08, 0.08, 0.08, 0.08, 0.08)
rates = vectors(7, 2.0, 2.0, 1.0, 3.0, 2.0, 3.0, 2.0)
shares = st.sampled_from([0.0, 1.0]) | st.floats(0.0, 1.0)
strut_states = st.tuples(
    *(st.tuples(st.floats(-0.03, 0.03), shares, shares) for _ in range(4)),
).map(np.array)
"""Strategy of strut states (4, 3), different for each strut."""


def with_twist(name, q, v, psi, psi_dot):
    """Return coordinates and rates of a varied car, with the twist if its frame is flexible."""
    return (q, v) if name == "varied" else (np.append(q, psi), np.append(v, psi_dot))


def compute_accelerations(
    plant, strut_state, q, v, z_r=ZEROS, w_r=ZEROS, a_xy=(0.0, 0.0), kernel=accelerations
) -> np.ndarray:
    """Return the accelerations (7,), or (8,) with a flexible frame, by the kernel."""
    out = np.empty(len(q))
    kernel(plant.buffers(strut_state), Motion(q, v), z_r, w_r, out, *a_xy)
    return out


def run_integrator(
    plant,
    y,
    *,
    h,
    steps,
    surface=FLAT_SURFACE,
    speed=10.0,
    s_0=0.0,
    strut_state=None,
    mode="ride",
    a_xy=None,
):
    """Integrate `steps` steps and return the signals (steps, 29), or (steps, 32) if flexible.

    The state `y` and `strut_state` are advanced in place. `a_xy` (2 steps + 1, 2): accelerations
    of a manoeuvre at every half step.
    """
    if strut_state is None:
        strut_state = settled_strut_state(encode_command(mode))
    stiff, high = strut_state[:, 1] == 0.0, strut_state[:, 2] == 1.0
    byte = sum((int(stiff[w]) << w) | (int(high[w]) << (4 + w)) for w in range(4))
    s = s_0 + speed * 0.5 * h * np.arange(2 * steps + 1)
    a_xy = np.zeros((s.size, 2)) if a_xy is None else a_xy
    commands = np.full(steps, byte, dtype=np.uint8)
    inputs = DriveInputs(s, np.full(s.size, speed), a_xy.ravel(), commands, h)
    more = (True,) if plant.flexible else ()
    out = np.empty((steps, rosenbrock.n_signals(plant)))
    vehicle = plant.buffers(strut_state)
    rosenbrock.integrate(vehicle, y, surface.buffers, inputs, 0.01, out, *more)
    return out


def smooth_road(length=40.0, height=0.03, ds=0.02, seed=3) -> Surface:
    """Return smooth random hills, different on both wheel paths, between level ends."""
    s = ds * np.arange(round(length / ds) + 1)
    rng = np.random.default_rng(seed)
    z = np.zeros((2, s.size))
    for wavelength in (9.0, 4.1, 2.3, 1.1):
        phase = rng.uniform(0.0, 2.0 * np.pi, (2, 1))
        z += np.sqrt(wavelength / 9.0) * np.sin(2.0 * np.pi * s / wavelength + phase)
    window = np.clip(np.minimum(s, length - s) / 3.0, 0.0, 1.0)
    return Surface(height * z * window**3 * (10.0 - 15.0 * window + 6.0 * window**2), ds)
