"""Operations of one step of one vehicle, counted by running it uncompiled on numbers that count,
and its longest chain: operations of which each needs the result of the one before.

A multiplication that is followed by an addition counts as one multiply-add in the chain, and
look-ups, comparisons and conversions of indices count nothing there: the chain of the compiled
step is longer.

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

DIVISION_LATENCY = 4.0
"""Latency of a division in multiply-adds, by which chains are compared; `machine` measures both."""


class Counted(float):
    """A number whose arithmetic is counted, with the chain (multiply-adds, divisions) behind it."""

    chain = before = (0, 0)
    """`before` is the chain without the multiplication that made the number."""


def _longest(*chains: tuple[int, int]) -> tuple[int, int]:
    return max(chains, key=lambda chain: chain[0] + DIVISION_LATENCY * chain[1])


def _count(method: str, kind: str) -> None:
    exact = getattr(float, method)

    def counted(self, other):
        COUNTS[kind] += 1
        result = exact(self, float(other))
        if isinstance(result, bool):
            return result
        answer, parts = Counted(result), [x for x in (self, other) if isinstance(x, Counted)]
        before = _longest(*(x.before if kind == "additions" else x.chain for x in parts))
        if kind == "additions":  # at most one of two products is part of the multiply-add
            lengths = [x.chain for x in parts if x.chain != x.before][1:]
            before = _longest(before, *lengths)
        longer = (0, 1) if kind == "divisions" else (1, 0)
        answer.chain = before[0] + longer[0], before[1] + longer[1]
        answer.before = before if kind == "multiplications" else answer.chain
        return answer

    setattr(Counted, method, counted)


for _kind, _operators in {
    "additions": ("add", "radd", "sub", "rsub"),
    "multiplications": ("mul", "rmul"),
    "divisions": ("truediv", "rtruediv"),
    "comparisons": ("gt", "lt"),
}.items():
    for _operator in _operators:
        _count(f"__{_operator}__", _kind)


def _negated(self: Counted) -> Counted:
    answer = Counted(-float(self))  # a change of sign is no operation
    answer.chain, answer.before = self.chain, self.before
    return answer


Counted.__neg__ = _negated  # type: ignore[method-assign]


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
        self.flat[self._place(i)] = value if isinstance(value, Counted) else Counted(value)


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
    inputs, out = StepInputs(road, Numbers(np.zeros(4)), 0.001, 0.0), Numbers(np.zeros(29))
    COUNTS.clear()
    motion = Motion(Numbers(q), Numbers(v))
    step(vehicle, motion, inputs, work, out)
    multiply_adds, divisions = _longest(*(x.chain for x in [*motion.q.flat, *motion.v.flat]))
    return {**COUNTS, "chain_multiply_adds": multiply_adds, "chain_divisions": divisions}


if __name__ == "__main__":
    print(json.dumps(count_step()))
