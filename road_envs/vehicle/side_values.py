"""Numbers of a vehicle's side motion, also of a vehicle whose file has none."""

from road_envs.vehicle.axles import IndependentWheels, SideMotion
from road_envs.vehicle.parameters import VehicleParameters

INDEPENDENT_ROLL_CENTRE, SOLID_ROLL_CENTRE = 0.05, 0.4
"""Heights [m] of the roll centres of independent wheels (0 to 0.2 m) and solid axles (0.3 to
0.6 m: about that of the springs or of the Panhard rod); Milliken & Milliken 1995, chapter 17."""

CORNERING_PER_LOAD = 14.0
"""Cornering stiffness over the static load of a tyre [1/rad]; 10 to 20 are usual."""

RELAXATION_LENGTH = 0.4  # relaxation length [m]; 0.3 to 0.5 m are usual (Pacejka 2012, chapter 7)

YAW_PER_PITCH_INERTIA = 1.0
"""Yaw inertia of a body over its pitch inertia; 0.96 to 1.08 of the shipped cars."""


def side_values(car: VehicleParameters) -> SideMotion:
    """Return the car's own numbers of side motion, or typical ones [assumed] if it has none."""
    if car.side is not None:
        return car.side
    centres = [
        INDEPENDENT_ROLL_CENTRE if isinstance(axle, IndependentWheels) else SOLID_ROLL_CENTRE
        for axle in car.axles
    ]
    front, rear = (CORNERING_PER_LOAD * load for load in car.tyre_loads)
    return SideMotion(
        I_zz=YAW_PER_PITCH_INERTIA * car.I_yy,
        wheel_radius=0.3 if isinstance(car.front, IndependentWheels) else 0.36,
        roll_centre=(centres[0], centres[1]),
        C_alpha=(front, rear),
        relaxation=(RELAXATION_LENGTH, RELAXATION_LENGTH),
    )
