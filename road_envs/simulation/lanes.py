"""LANES vehicles side by side in SIMD vectors, and their drives over one and the same road.

A lane may hold any vehicle: the constants of LANES vehicles are transposed so that lanes come last,
and their tables of force laws are concatenated. `drive_variants` drives variants of one vehicle,
with the same road under their wheels; differences of their accelerations are the sensitivities to
the parameters in which they differ.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import LANES, broadcast
from road_envs.kernels.simd_arrays import get, put, stack_rows
from road_envs.simulation import rosenbrock
from road_envs.simulation.rosenbrock import N_SIDE_SIGNALS, WORKSPACE_ROWS, StepInputs
from road_envs.vehicle.equations import N_DOF, PLANT_DTYPE, Motion, Plant
from road_envs.vehicle.side_motion import side_size
from road_envs.vehicle.suspension import VehicleBuffers

_LANE_CONSTANTS = np.dtype(
    [(name, "f8", (*PLANT_DTYPE[name].shape, LANES)) for name in PLANT_DTYPE.names or ()]
)


def aligned_zeros(*shape: int) -> np.ndarray:
    """Return zeros (..., LANES) with rows on cache line boundaries, which no load then crosses."""
    size = int(np.prod(shape)) * LANES
    store = np.zeros(size + LANES)
    skip = -(store.ctypes.data // 8) % LANES
    return store[skip : skip + size].reshape(*shape, LANES)


def aligned_copy(array: np.ndarray) -> np.ndarray:
    """Return an aligned copy of an array (..., LANES)."""
    copy = aligned_zeros(*array.shape[:-1])
    copy[...] = array
    return copy


def transpose_constants(constants: np.ndarray) -> np.ndarray:
    """Return the constants (LANES,) of LANES vehicles as one record (1,), lanes last in each field.

    A record needs one address; 30 arrays would need 30, more than there are registers.
    """
    p = aligned_zeros(_LANE_CONSTANTS.itemsize // (8 * LANES)).reshape(-1).view(_LANE_CONSTANTS)
    for name in PLANT_DTYPE.names or ():
        p[name][0] = np.moveaxis(constants[name], 0, -1)
    return p


@kernel(inline=False)
def update_lane_valves(constants, strut_state, q, k, byte, alpha, h):
    """Advance the valves of lane `k`, vehicle `constants` (1,); return whether all are settled."""
    # the valve law is written for the arrays of one vehicle
    return rosenbrock.update_valves(constants[0], strut_state[:, :, k], q[:, k], byte, alpha, h)


class LaneBuffers(NamedTuple):
    """LANES vehicles as kernels read them; `strut_state`, `q` and `v` are advanced in place.

    `lane_constants` (1,) as of `transpose_constants`; for the valves, which move lane by lane, the
    same as `constants` (LANES,) and the factors `alpha` (LANES,) of `suspension.advance_valve`;
    tables `velocity` and `displacement`; `strut_state` (4, 3, LANES); `valves` (2, LANES): 1 where
    those of a lane may move, as at the start, and their last commands; `q`, `v` (7, LANES), or as
    many as of `equations.Motion`.
    """

    lane_constants: np.ndarray
    constants: np.ndarray
    alpha: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray
    strut_state: np.ndarray
    valves: np.ndarray
    q: np.ndarray
    v: np.ndarray


def lane_buffers(
    plants: Sequence[Plant],
    states: Sequence[np.ndarray],
    strut_states: Sequence[np.ndarray],
    lags: Sequence[float],
    h: float,
) -> LaneBuffers:
    """Return LANES vehicles at states (14,) and strut states (4, 3), with valves of `lags` [s]."""
    constants = np.concatenate([plant.constants for plant in plants])
    distinct = list({id(plant): plant for plant in plants}.values())
    of_lane = [next(i for i, p in enumerate(distinct) if p is plant) for plant in plants]
    # the tables of all plants are concatenated, those of shared plants once
    for field, table in (("velocity_table", "velocity"), ("displacement_table", "displacement")):
        first = np.cumsum([0, *(len(getattr(plant, table)) for plant in distinct)])
        constants[field] += first[of_lane][:, None]
    q, v = np.split(np.stack(states, axis=-1), 2)
    return LaneBuffers(
        lane_constants=transpose_constants(constants),
        constants=constants,
        alpha=aligned_copy(1.0 - np.exp(-h / np.asarray(lags))),
        velocity=np.concatenate([plant.velocity for plant in distinct]),
        displacement=np.concatenate([plant.displacement for plant in distinct]),
        strut_state=aligned_copy(np.stack(strut_states, axis=-1)),
        valves=aligned_copy(np.repeat([[1.0], [0.0]], LANES, axis=1)),
        q=aligned_copy(q),
        v=aligned_copy(v),
    )


@kernel(inline=False, count_references=False)
def _integrate_on_road(lanes, road, speed, commands, h, out, flexible=None, side=None):
    """Integrate LaneBuffers over one `road` (N, 16) of StepInputs, at the `speed` (N,) [m/s].

    `commands` (N,) reach the valves. The accelerations go to `out` (N, 7, LANES), (N, 8, LANES) of
    `flexible` vehicles, with those of `side` motion behind.
    """
    q, strut_state, motion = lanes.q, lanes.strut_state, Motion(lanes.q, lanes.v)
    vehicle = VehicleBuffers(lanes.lane_constants, lanes.velocity, lanes.displacement, strut_state)
    work, inputs = rosenbrock.step_workspace(stack_rows(WORKSPACE_ROWS)), stack_rows(16)
    row, no_manoeuvre = stack_rows(N_SIDE_SIGNALS), stack_rows(4)
    for j in range(4):
        put(no_manoeuvre, j, 0.0)
    settled = False
    for n in range(commands.size):
        for j in range(16):
            put(inputs, j, broadcast(road[n, j]))
        if not settled or commands[n] != commands[n - 1]:
            settled = True
            for k in range(LANES):
                own, alpha = lanes.constants[k : k + 1], lanes.alpha[k]
                here = update_lane_valves(own, strut_state, q, k, commands[n], alpha, h)
                settled = settled and here
        step_inputs = StepInputs(inputs, no_manoeuvre, h, speed[n])
        rosenbrock.any_step(vehicle, motion, step_inputs, work, row, flexible, side)
        if flexible is not None:
            put(out[n], N_DOF, get(row, rosenbrock.TWIST + 2))
        if side is not None:
            for j in range(side_size(q)):
                rate = get(row, rosenbrock.SIDE_ACCELERATION + j)
                put(out[n], q.shape[0] - side_size(q) + j, rate)
        for j in range(N_DOF):
            put(out[n], j, get(row, rosenbrock.ACCELERATION + j))


class SharedInputs(NamedTuple):
    """Inputs that variants of a vehicle share in a drive of N steps of `h` [s].

    `road` (2 N, 2, 4): heights [m] and rates [m/s] under the wheels at each half step; `commands`
    (N,): bytes that reach the valves, of time constant `lag` [s]; `strut_state` (4, 3) at the
    start; `v` (N,) [m/s]: speed in the middle of each step.
    """

    road: np.ndarray
    commands: np.ndarray
    strut_state: np.ndarray
    lag: float
    h: float
    v: np.ndarray


def drive_variants(
    plants: Sequence[Plant], starts: Sequence[np.ndarray], inputs: SharedInputs
) -> list[np.ndarray]:
    """Return the accelerations (N, `n_dof`) of each plant from its first state in `starts`.

    All plants are flexible, or none, and so with side motion. A motion that diverges is NaN.
    """
    steps = inputs.commands.size
    road = np.ascontiguousarray(inputs.road.reshape(steps, 16))
    flags, found = plants[0].kernel_flags, []
    out, v = aligned_zeros(steps, plants[0].n_dof), np.ascontiguousarray(inputs.v)
    for first in range(0, len(plants), LANES):
        chosen = [min(first + k, len(plants) - 1) for k in range(LANES)]
        own = [plants[i] for i in chosen], [starts[i] for i in chosen]
        shared = [inputs.strut_state] * LANES, [inputs.lag] * LANES
        lanes = lane_buffers(*own, *shared, inputs.h)
        _integrate_on_road(lanes, road, v, inputs.commands, inputs.h, out, *flags)
        found += [out[:, :, k].copy() for k in range(min(LANES, len(plants) - first))]
    return found
