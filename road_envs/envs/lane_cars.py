"""Vehicles in the lanes of a fleet: one that all have, until a lane gets another one."""

import numpy as np

from road_envs.envs.fleet_arrays import CarBuffers
from road_envs.kernels.simd import LANES
from road_envs.simulation.lanes import aligned_zeros, transpose_constants
from road_envs.vehicle.equations import Plant
from road_envs.vehicle.parameters import VehicleParameters

TABLES = (("velocity_table", "velocity", 8), ("displacement_table", "displacement", 4))
"""Fields of a plant's constants that number its force tables, these tables, and the most of them:
one for each strut and, by velocity, damper valve."""


class LaneCars:
    """Cars of the lanes of `blocks` blocks as the kernels read them, in `buffers`.

    All lanes have `plant` and `car` at first, in one block that every block reads. The tables of
    another plant are stored once for each lane that was given it.
    """

    def __init__(self, plant: Plant, car: VehicleParameters, step: float, blocks: int):
        self.plant, self.step, self.blocks = plant, step, blocks
        self.slots: dict[int, int] = {}  # place of the tables of each lane that has own ones
        constants = np.repeat(plant.constants, LANES)
        alpha = aligned_zeros(1)
        alpha[:] = 1.0 - np.exp(-step / car.valve.lag)
        self.buffers = CarBuffers(
            transpose_constants(constants), constants[None], alpha, plant.velocity,
            plant.displacement,
        )  # fmt: skip

    def put(self, i: int, plant: Plant, car: VehicleParameters) -> None:
        """Give lane `i` (over all blocks) another plant, or the common one."""
        if plant is self.plant and len(self.buffers.constants) == 1:
            return
        if len(self.buffers.constants) < self.blocks:
            self._expand()
        (b, k), constants = divmod(i, LANES), plant.constants.copy()
        if plant is not self.plant:
            slot = self.slots.setdefault(i, len(self.slots))
            for field, table, most in TABLES:
                constants[field] += self._store_table(table, getattr(plant, table), most, slot)
        self.buffers.constants[b, k] = constants[0]
        self.buffers.alpha[b, k] = 1.0 - np.exp(-self.step / car.valve.lag)
        self._write_lane(b, k)

    def share(self, i: int, other: int) -> None:
        """Give lane `other` the car of lane `i`."""
        (b, k), (c, j) = divmod(i, LANES), divmod(other, LANES)
        if len(self.buffers.constants) < self.blocks:
            return
        self.buffers.constants[c, j] = self.buffers.constants[b, k]
        self.buffers.alpha[c, j] = self.buffers.alpha[b, k]
        self._write_lane(c, j)

    def _write_lane(self, b: int, k: int) -> None:
        """Copy the constants of a lane to its place among the transposed ones."""
        for name in self.buffers.lane_constants.dtype.names or ():
            self.buffers.lane_constants[name][b, ..., k] = self.buffers.constants[name][b, k]

    def _expand(self) -> None:
        """Give every block constants of its own."""
        old, size = self.buffers, self.blocks
        width = old.lane_constants.dtype.itemsize // (8 * LANES)
        lane_constants = aligned_zeros(size, width).reshape(-1).view(old.lane_constants.dtype)
        alpha = aligned_zeros(size)
        lane_constants[:], alpha[:] = old.lane_constants[0], old.alpha[0]
        constants = np.repeat(old.constants, size, axis=0)
        self.buffers = old._replace(lane_constants=lane_constants, constants=constants, alpha=alpha)

    def _store_table(self, name: str, table: np.ndarray, most: int, slot: int) -> int:
        """Store a `table` of at most `most` rows in a slot; return the number of its first row."""
        stored, common = getattr(self.buffers, name), len(getattr(self.plant, name))
        first = common + most * slot
        if len(stored) < first + most:
            grown = np.zeros((common + most * max(2 * slot, 8), *stored.shape[1:]))
            grown[: len(stored)] = stored
            self.buffers, stored = self.buffers._replace(**{name: grown}), grown
        stored[first : first + len(table)] = table
        return first
