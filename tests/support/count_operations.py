"""Operations of one step of one vehicle, counted by running it uncompiled on numbers that count.

NUMBA_DISABLE_JIT=1 python tests/support/count_operations.py
"""

import json
from collections import Counter
from types import SimpleNamespace

import numpy as np

from road_envs.simulation.rosenbrock import StepInputs, StepWorkspace, step
from road_envs.vehicle.equations import Motion, build_plant
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import VehicleBuffers, encode_command, settled_strut_state

COUNTS: Counter[str] = Counter()


class Counted(float):
    """A number whose arithmetic is counted."""


def _count(method: str, kind: str) -> None:
    exact = getattr(float, method)

    def counted(self, other):
        COUNTS[kind] += 1
        result = exact(self, float(other))
        return result if isinstance(result, bool) else Counted(result)

    setattr(Counted, method, counted)


for _kind, _operators in {
    "additions": ("add", "radd", "sub", "rsub"),
    "multiplications": ("mul", "rmul"),
    "divisions": ("truediv", "rtruediv"),
    "comparisons": ("gt", "lt"),
}.items():
    for _operator in _operators:
        _count(f"__{_operator}__", _kind)
Counted.__neg__ = lambda self: Counted(-float(self))  # a change of sign is no operation


class Numbers:
    """An array of counted numbers."""

    def __init__(self, values):
        values = np.asarray(values, dtype=float)
        self.shape, self.flat = values.shape, [Counted(v) for v in values.ravel()]

    def ravel(self):
        return self.flat

    def _place(self, i):
        return int(np.ravel_multi_index(i, self.shape)) if isinstance(i, tuple) else i

    def __getitem__(self, i):
        return self.flat[self._place(i)]

    def __setitem__(self, i, value):
        self.flat[self._place(i)] = Counted(value)


def count_step() -> dict[str, int]:
    """Return the operations of `rosenbrock.step`, by kind, for the default vehicle in motion."""
    plant, rng = build_plant(load_vehicle("land_rover_defender_110")), np.random.default_rng(0)
    constants = plant.constants[0]
    p = SimpleNamespace(
        **{
            name: Numbers(constants[name]) if constants[name].shape else Counted(constants[name])
            for name in plant.constants.dtype.names
        }
    )
    tables = Numbers(plant.velocity), Numbers(plant.displacement)
    vehicle = VehicleBuffers([p], *tables, Numbers(settled_strut_state(encode_command("ride"))))
    sizes = 6 * [7] + 8 * [4] + [12, 6]
    work = StepWorkspace(*(Numbers(np.zeros(size)) for size in sizes))
    q, v = 1e-3 * rng.standard_normal((2, 7))
    road = Numbers(1e-3 * rng.standard_normal(16))
    inputs, out = StepInputs(road, Numbers(np.zeros(4))), Numbers(np.zeros(29))
    COUNTS.clear()
    step(vehicle, Motion(Numbers(q), Numbers(v)), inputs, 0.001, work, out)
    return dict(COUNTS)


if __name__ == "__main__":
    print(json.dumps(count_step()))
