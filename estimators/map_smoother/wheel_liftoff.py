"""Road under a wheel that has lifted off.

Where no wheel presses on the road, any lower road explains the measurements as well, and the prior
alone should decide. But the minimization comes from a road that carries the wheel, where the
tangent predicts that a lower road pulls the wheel down, so no step leads on. The minimization
therefore goes on from a lowered road:

- a stationary road is straight wherever neither axle has pressed on it, which is the most probable
  road across a gap in a random walk;
- among obstacles it is level there, as low as its lowest point or that of landing. A wheel lifts
  off where the road falls faster than the wheel can, and a road of few edges has fallen before the
  wheel has: behind a bump to the height of landing, into a hole at least as deep as the wheel fell.
"""

import numpy as np
from scipy.ndimage import find_objects, label

from estimators.map_smoother.objective import Linearization
from road_envs.simulation.rosenbrock import LOAD

LIFTOFF_LOAD_SHARE = 0.1
"""Share of the mean wheel load below which a wheel counts as lifted off."""

MIN_DROP = 0.01
"""Least lowering of the road [m] for another minimization."""


def unloaded_nodes(lin: Linearization) -> np.ndarray:
    """Return which free nodes (2, K) were passed but never pressed on, in any of the passes."""
    return np.all([_unloaded_in_pass(one) for one in lin.passes], axis=0)


def passed_nodes(lin: Linearization) -> np.ndarray:
    """Return which free nodes (K,) a wheel has passed, in one of the passes at least."""
    passed = np.any([_passed_by(one, _wheel_nodes(one)) for one in lin.passes], axis=0)
    return np.asarray(passed & (lin.objective.road.free > 0))


def _unloaded_in_pass(lin: Linearization) -> np.ndarray:
    road, nodes = lin.objective.road, _wheel_nodes(lin)
    loads, max_load = lin.tape.signals[:, LOAD : LOAD + 4], np.zeros((2, road.size))
    for wheel in range(4):
        for k in (0, 1):  # the nodes to either side carry the wheel
            np.maximum.at(max_load[wheel % 2], nodes[wheel // 2] + k, loads[:, wheel])
    light = max_load < LIFTOFF_LOAD_SHARE * loads.mean()
    return light & _passed_by(lin, nodes) & (road.free > 0)


def _wheel_nodes(lin: Linearization) -> list[np.ndarray]:
    """Return the node (N,) behind front and rear wheels at each step."""
    road, s = lin.objective.road, lin.objective.inputs.s[::2]
    stations = s, s - lin.objective.model.wheelbase
    return [((station - road.origin) / road.ds).astype(int) for station in stations]


def _passed_by(lin: Linearization, nodes: list[np.ndarray]) -> np.ndarray:
    passed = np.zeros(lin.objective.road.size, dtype=bool)
    for axle in nodes:
        passed[axle.min() : axle.max()] = True
    return passed


def distance_in_air(lin: Linearization) -> float:
    """Return the distance [m] over which at least one wheel had lifted off."""
    lifted = np.any(lin.tape.signals[:, LOAD : LOAD + 4] <= 0.0, axis=1)
    return float(np.diff(lin.objective.inputs.s[::2]) @ lifted[:-1])


def relax_unloaded(lin: Linearization) -> np.ndarray | None:
    """Return `lin.x` with the road lowered where it is unloaded; None if it is not much higher."""
    unloaded, road = unloaded_nodes(lin), lin.objective.road
    u = lin.objective.split(lin.x)[0]
    before = road.coefficients(u)
    lower = _level if road.is_level_between_obstacles else _straight
    pairs = zip(before, unloaded, strict=True)
    c = np.array(
        [np.where(mask, np.minimum(path, lower(path, mask)), path) for path, mask in pairs]
    )
    if not (before - c).max() > MIN_DROP:
        return None
    u = road.whiten(np.diff(c - road.background, axis=1, prepend=0.0))
    return np.concatenate([u.ravel(), lin.x[u.size :]])


def _straight(path: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the `path` (K,) straight across the nodes in the `mask` (K,)."""
    node = np.arange(path.size)
    return np.interp(node, node[~mask], path[~mask])


def _level(path: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the `path` (K,) level in each run of nodes in the `mask` (K,), at the lowest height of
    the run and its neighbours.
    """
    c = path.copy()
    for (run,) in find_objects(label(mask)[0]):
        c[run] = path[max(run.start - 1, 0) : run.stop + 1].min()
    return c
