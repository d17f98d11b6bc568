"""Numbers of a vehicle's side motion, also of a vehicle whose file has none."""

from road_envs.vehicle.axles import IndependentWheels, SideMotion
from road_envs.vehicle.parameters import VehicleParameters


def side_values(car: VehicleParameters) -> SideMotion:
    """Return the car's own numbers of side motion, or typical ones [assumed] if it has none."""
    if car.side is not None:
        return car.side
    # roll centres of independent wheels are 0 to 0.2 m high, of solid axles 0.3 to 0.6 m, about
    # that of the springs or of the Panhard rod: Milliken & Milliken 1995, chapter 17
    centres = [0.05 if isinstance(axle, IndependentWheels) else 0.4 for axle in car.axles]
    # cornering stiffness: 10 to 20 times the static load per radian are usual
    front, rear = (14.0 * load for load in car.tyre_loads)
    return SideMotion(
        I_zz=car.I_yy,  # 0.96 to 1.08 of it, of the shipped cars
        wheel_radius=0.3 if isinstance(car.front, IndependentWheels) else 0.36,
        roll_centre=(centres[0], centres[1]),
        C_alpha=(front, rear),
        relaxation=(0.4, 0.4),  # 0.3 to 0.5 m are usual: Pacejka 2012, chapter 7
    )
