"""Speed profiles of the tests: a ramp, and stop and go."""

import numpy as np

from road_envs.simulation.speed import SpeedProfile


def speed_ramp(v_0: float, v_1: float, duration: float, after: float = 0.0) -> SpeedProfile:
    """Return a linear change from `v_0` to `v_1` [m/s] in `duration` [s], beginning at `after`."""
    if after > 0.0:
        return SpeedProfile(t=(0.0, after, after + duration), v=(v_0, v_0, v_1))
    return SpeedProfile(t=(0.0, duration), v=(v_0, v_1))


def stop_and_go(v: float, a: float, cruise: float, halt: float, stops: int) -> SpeedProfile:
    """Return a profile of `stops` cycles: cruise, brake, halt, accelerate.

    `v` [m/s] is the cruising speed, `a` [m/s²] both the deceleration and the acceleration, `cruise`
    and `halt` [s] are durations.
    """
    change = v / a
    parts = [(cruise, v), (change, 0.0), (halt, 0.0), (change, v)] * stops
    durations, speeds = zip(*parts, strict=True)
    return SpeedProfile(t=(0.0, *np.cumsum(durations).tolist()), v=(v, *speeds))
