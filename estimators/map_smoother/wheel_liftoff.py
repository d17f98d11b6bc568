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

At the end the posterior there is one-sided: the road is no higher than estimated, where the wheel
would have pressed on it, and anywhere between there and the lowest that it can be
(`road_below_light_wheels`). Among obstacles its distribution over this range R is taken as uniform:
below a lifted wheel it is R / 2 lower in the mean, with a standard deviation of R / sqrt(12) where
a floor is not seen, and of `edge_std` R where an edge is not. The lowest is

- the height of landing, if the road goes on from there: the wheel has landed on the floor;
- the floor of the deepest hole that a road of so many holes may have, if the road rises at once:
  the wheel has hit the far edge of a hole whose floor it did not reach. Of n holes with depths
  between 0 and D, all equally probable, the deepest is n / (n + 1) D deep in the mean.

Where the wheel is light but presses on the road, and on the nodes next to those, an edge may have
begun: the road errs by as much there, but not in the mean. A stationary road errs as a random walk
between known ends (a Brownian bridge), whose mean over m steps of variance s² has the variance
m s² / 12. Where it had to be taken for even (`gauss_newton.minimize`), a wheel that flew where no
such road falls flew off an obstacle: the road behind is the straight line or the height of landing,
one as probable as the other.
"""

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft
from scipy.ndimage import find_objects, label

from estimators.map_smoother.objective import Linearization
from estimators.map_smoother.one_pass import LinearizedPass
from estimators.map_smoother.tuning import TUNING
from road_envs.simulation.rosenbrock import LOAD


def unloaded_nodes(lin: Linearization, share: float = TUNING.liftoff_load_share) -> np.ndarray:
    """Return which free nodes (2, K) were passed but never pressed on by this `share` of the mean
    wheel load, in any of the passes.
    """
    light = np.all([_greatest_loads(one) < share for one in lin.passes], axis=0)
    return np.asarray(light & (lin.objective.road.free > 0))


def passed_nodes(lin: Linearization) -> np.ndarray:
    """Return which free nodes (K,) a wheel has passed, in one of the passes at least."""
    passed = np.any([np.isfinite(_greatest_loads(one)[0]) for one in lin.passes], axis=0)
    return np.asarray(passed & (lin.objective.road.free > 0))


def _greatest_loads(one: LinearizedPass) -> np.ndarray:
    """Return the greatest load (2, K) on each node over the mean wheel load; inf where no wheel has
    passed.
    """
    nodes, s = one.source.nodes, one.source.inputs.s[::2]
    loads = one.tape.signals[:, LOAD : LOAD + 4]
    passed, greatest = np.zeros(nodes.size, dtype=bool), np.zeros((2, nodes.size))
    for axle, station in enumerate((s, s - one.source.model.wheelbase)):
        node = ((station - nodes.origin) / nodes.ds).astype(int)
        passed[node.min() : node.max()] = True
        for side in range(2):
            for k in (0, 1):  # the nodes to either side carry the wheel
                np.maximum.at(greatest[side], node + k, loads[:, 2 * axle + side])
    return np.where(passed, greatest / loads.mean(), np.inf)


def distance_in_air(one: LinearizedPass) -> float:
    """Return the distance [m] over which at least one wheel had lifted off."""
    lifted = np.any(one.tape.signals[:, LOAD : LOAD + 4] <= 0.0, axis=1)
    return float(np.diff(one.source.inputs.s[::2]) @ lifted[:-1])


def relax_unloaded(lin: Linearization) -> np.ndarray | None:
    """Return `lin.x` with the road lowered where it is unloaded; None if it is not much higher."""
    unloaded, road = unloaded_nodes(lin), lin.objective.road
    before = lin.objective.coefficients(lin.x)
    lower = _level if road.is_level_between_obstacles else _straight
    pairs = zip(before, unloaded, strict=True)
    c = np.array(
        [np.where(mask, np.minimum(path, lower(path, mask)), path) for path, mask in pairs]
    )
    if not (before - c).max() > TUNING.min_drop:
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


class LiftoffError(NamedTuple):
    """Error of the road below a light wheel: of the wheel `path`, with the standard deviation
    `height` (K,) [m], the same error for all nodes but for this factor.
    """

    path: int
    height: np.ndarray


class _Gap(NamedTuple):
    """Nodes `run` of a wheel `path` on which the wheel was light, the `level` [m] of landing, and
    by how much the road falls to it before them, and rises from it within some way behind them.
    """

    path: int
    run: slice
    level: float
    fall: float
    rise: float


def road_below_light_wheels(lin: Linearization) -> tuple[np.ndarray, list[LiftoffError]]:
    """Return by how much (2, K) [m] the road is lower than that of `lin` in the mean, and its
    errors below light wheels, which are independent of one another.
    """
    road = lin.objective.road
    c = lin.objective.coefficients(lin.x)
    is_level = road.is_level_between_obstacles
    light = unloaded_nodes(lin, TUNING.light_on_level if is_level else TUNING.light_elsewhere)
    step_variance = road.local**2 * irfft(road.amplitude**2, road.size, axis=1)[:, 0].sum()
    lower, errors, gaps = np.zeros_like(c), list[LiftoffError](), list[_Gap]()
    unloaded, reach = unloaded_nodes(lin), round(TUNING.edge_reach / road.ds)
    for path, mask in enumerate(light):
        for (run,) in find_objects(label(mask)[0]):
            level = c[path, run.stop]
            fall = c[path, max(run.start - reach, 0) : run.start + 1].max() - level
            rise = c[path, run.stop : run.stop + reach + 1].max() - level
            steps = step_variance[path, run.start : run.stop + 1]
            in_air = unloaded[path, run].mean() > TUNING.flown_share
            # an even road does not fall so far: the wheel flew off an obstacle
            is_drop = fall > TUNING.obstacle_fall * np.sqrt(steps.sum())
            if is_level or (in_air and is_drop and not road.may_be_uneven):
                gaps.append(_Gap(path, run, level, fall, rise))
                continue
            height = np.zeros(road.size)
            height[run] = np.sqrt(steps.sum() / 12.0)
            errors.append(LiftoffError(path, height))
    falls = [gap.fall for gap in gaps if gap.fall > TUNING.min_drop]
    for path, run, level, fall, rise in gaps:
        height, unseen = np.zeros((2, road.size))
        before = max(run.start - 1, 0)
        height[before : run.stop] = np.maximum(c[path, before : run.stop] - level, 0.0)
        if is_level and fall > TUNING.min_drop and rise > TUNING.edge_share * fall:
            unseen[before : run.stop + 1] = max(falls) * (1.0 + 1.0 / len(falls)) - fall
        lower[path, run] += (unloaded[path] * height + unseen)[run] / 2.0
        errors.append(LiftoffError(path, (TUNING.edge_std if is_level else 0.5) * height))
        errors.append(LiftoffError(path, unseen / np.sqrt(12.0)))
    return lower, errors


def lower_road(lin: Linearization, lower: np.ndarray) -> Linearization:
    """Return the linearization on a road that is by `lower` (2, K) [m] below that of `lin`; the
    same one if the motion is not finite there.
    """
    if not lower.max() > 0.0:
        return lin
    u = lin.objective.road.whiten(-np.diff(lower, axis=1, prepend=0.0))
    try:
        return lin.relinearize(lin.x + lin.objective.from_noise(u))
    except ArithmeticError:
        return lin
