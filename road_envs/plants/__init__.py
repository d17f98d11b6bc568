"""Foreign plants: vehicles whose equations are those of other projects, to validate ours.

They share no equation with `road_envs.vehicle` and `road_envs.simulation`: only a vehicle's numbers
and the heights of the road go in. Optional: `pip install 'road-envs[plants]'`.

| plant | equations |
|---|---|
| `mujoco` | bodies, joints and tendons of MuJoCo; tyres that slip sideways, in `mujoco_car` |
| `commonroad` | multi-body car of `commonroad-vehicle-models`, after DOT HS 807 956 |
"""

from collections.abc import Iterable

from road_envs.core.config import ConfigError
from road_envs.sensing.instruments import SensorLocation


def check_on_body(plant: str, locations: Iterable[SensorLocation]) -> None:
    """Raise ConfigError if an accelerometer of a plant is mounted on an axle."""
    for at in locations:
        if at.axle is not None:
            raise ConfigError(
                f"the plant {plant} has no sensors on its axles, and the one at y = {at.y:g} m is "
                f"on the {('front', 'rear')[at.axle]} axle: mount it on the body"
            )
