"""Road under a wheel that has lifted off.

Where no wheel presses on the road, any lower road explains the measurements as well, and the prior
alone should decide. But the minimization comes from a road that carries the wheel, where the
tangent predicts that a lower road pulls the wheel down, so no step leads on. The minimization is
therefore repeated from a road that is straight wherever neither axle has pressed on it.
"""

import numpy as np

from estimators.map_smoother.objective import Linearization
from road_envs.simulation.rosenbrock import LOAD

LIFTOFF_LOAD_SHARE = 0.1
"""Share of the mean wheel load below which a wheel counts as lifted off."""

MIN_DROP = 0.01
"""Least lowering of the road [m] for another minimization."""


def unloaded_nodes(lin: Linearization) -> np.ndarray:
    """Return which free nodes (2, K) were passed but never pressed on, in any of the passes."""
    return np.all([_unloaded_in_pass(one) for one in lin.passes], axis=0)


def _unloaded_in_pass(lin: Linearization) -> np.ndarray:
    objective, road = lin.objective, lin.objective.road
    loads = lin.tape.signals[:, LOAD : LOAD + 4]
    s, max_load = objective.inputs.s[::2], np.zeros((2, road.size))
    passed = np.zeros(road.size, dtype=bool)
    for wheel in range(4):
        station = s - (wheel // 2) * objective.model.wheelbase
        node = ((station - road.origin) / road.ds).astype(int)
        passed[node.min() : node.max()] = True
        for k in (0, 1):  # the nodes to either side carry the wheel
            np.maximum.at(max_load[wheel % 2], node + k, loads[:, wheel])
    return (max_load < LIFTOFF_LOAD_SHARE * loads.mean()) & passed & (road.free > 0)


def distance_in_air(lin: Linearization) -> float:
    """Return the distance [m] over which at least one wheel had lifted off."""
    lifted = np.any(lin.tape.signals[:, LOAD : LOAD + 4] <= 0.0, axis=1)
    return float(np.diff(lin.objective.inputs.s[::2]) @ lifted[:-1])


def relax_unloaded(lin: Linearization) -> np.ndarray | None:
    """Return `lin.x` with the road no higher than straight where unloaded; None if it is lower.

    The straight line is the most probable road across a gap in a random walk.
    """
    unloaded, road = unloaded_nodes(lin), lin.objective.road
    u, _, _ = lin.objective.split(lin.x)
    before, node = road.coefficients(u), np.arange(road.size)
    c = before.copy()
    for path, mask in zip(c, unloaded, strict=True):
        path[mask] = np.minimum(path, np.interp(node, node[~mask], path[~mask]))[mask]
    if not (before - c).max() > MIN_DROP:
        return None
    u = road.whiten(np.diff(c - road.background, axis=1, prepend=0.0))
    return np.concatenate([u.ravel(), lin.x[u.size :]])
