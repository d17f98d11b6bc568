"""Foreign plants: vehicles whose equations are those of other projects, to validate ours.

They share no equation with `road_envs.vehicle` and `road_envs.simulation`: only a vehicle's numbers
and the heights of the road go in. Optional: `pip install 'road-envs[plants]'`.

| plant | equations |
|---|---|
| `mujoco` | bodies, joints and tendons of MuJoCo; tyres that slip sideways, in `mujoco_car` |
| `commonroad` | multi-body car of `commonroad-vehicle-models`, after DOT HS 807 956 |
"""
