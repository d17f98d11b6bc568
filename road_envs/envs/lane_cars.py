"""Vehicles in the lanes of a fleet: one that all have, or one for each lane."""

import numpy as np

from road_envs.envs.fleet_arrays import CarBuffers
from road_envs.kernels.simd import LANES
from road_envs.simulation.lanes import aligned_zeros, transpose_constants
from road_envs.vehicle.equations import Plant
from road_envs.vehicle.parameters import VehicleParameters

TABLES = {"velocity_table": ("velocity", 8), "displacement_table": ("displacement", 4)}
"""Fields of a plant's constants that number its force tables, these tables, and the most of them:
one for each strut and, by velocity, damper valve."""


class LaneCars:
    """Cars of the lanes of `blocks` blocks as the kernels read them, in `buffers`.

    All lanes have `plant` and `car` at first, in one block that every block reads unless they are
    `individual`. Behind its tables there is then room for those of every lane.
    """

    def __init__(
        self, plant: Plant, car: VehicleParameters, step: float, blocks: int, individual: bool
    ):
        self.plant, self.step, lanes = plant, step, blocks * LANES * individual
        size, common = (blocks if individual else 1), np.repeat(plant.constants, LANES)
        one = transpose_constants(common)
        lane_constants = aligned_zeros(size, one.dtype.itemsize // (8 * LANES))
        lane_constants = lane_constants.reshape(-1).view(one.dtype)
        lane_constants[:] = one[0]
        alpha = aligned_zeros(size)
        alpha[:] = 1.0 - np.exp(-step / car.valve.lag)
        tables = []
        for name, most in TABLES.values():
            table = getattr(plant, name)
            tables.append(np.concatenate([table, np.zeros((most * lanes, *table.shape[1:]))]))
        constants = np.repeat(common[None], size, axis=0)
        self.buffers = CarBuffers(lane_constants, constants, alpha, *tables)

    def put(self, i: int, plant: Plant, car: VehicleParameters) -> None:
        """Give lane `i` (over all blocks) another plant."""
        constants, alpha = plant.constants[0].copy(), 1.0 - np.exp(-self.step / car.valve.lag)
        for numbers, (name, most) in TABLES.items():
            table, first = getattr(plant, name), len(getattr(self.plant, name)) + most * i
            getattr(self.buffers, name)[first : first + len(table)] = table
            constants[numbers] += first
        self._write_lane(i, constants, alpha)

    def share(self, i: int, other: int) -> None:
        """Give lane `other` the car of lane `i`."""
        b, k = divmod(i, LANES)
        self._write_lane(other, self.buffers.constants[b, k], self.buffers.alpha[b, k])

    def _write_lane(self, i: int, constants: np.void, alpha: float) -> None:
        b, k = divmod(i, LANES)
        self.buffers.constants[b, k], self.buffers.alpha[b, k] = constants, alpha
        for name in self.buffers.lane_constants.dtype.names or ():
            self.buffers.lane_constants[name][b, ..., k] = constants[name]
