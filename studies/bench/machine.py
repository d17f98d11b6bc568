"""Measured arithmetic of the machine: multiply-adds per second of a thread, gain of a second one,
and the latency of a multiply-add and of a division.

The speed of a simulation is compared with it: a loop that computes in registers and touches no
memory shows whether two cores are twice as fast as one at all, and a chain in which each operation
needs the result of the one before shows how long a chain of a step must take.
"""

import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import LANES
from road_envs.kernels.simd_arrays import get, put

CHAINS = 12
"""Independent sums: more than a multiply-add has cycles of latency times units per core."""

ROUNDS = 2_000_000
REPETITIONS = 5


class MachineSpeed(NamedTuple):
    """Rate of one thread [multiply-adds of doubles per second], and that of two relative to it;
    time [s] until the result of a multiply-add and of a division can be used.
    """

    one_thread: float
    second_thread: float
    multiply_add: float
    division: float


@kernel(inline=False)
def multiply_adds(x, rounds):
    """Take `rounds` of multiply-adds on `x` (CHAINS + 2, LANES): a factor, a summand, the sums."""
    factor, summand = get(x, 0), get(x, 1)
    a, b, c, d, e, f = get(x, 2), get(x, 3), get(x, 4), get(x, 5), get(x, 6), get(x, 7)
    g, h, i, j, k, m = get(x, 8), get(x, 9), get(x, 10), get(x, 11), get(x, 12), get(x, 13)
    for _ in range(rounds):
        a, b, c = a * factor + summand, b * factor + summand, c * factor + summand
        d, e, f = d * factor + summand, e * factor + summand, f * factor + summand
        g, h, i = g * factor + summand, h * factor + summand, i * factor + summand
        j, k, m = j * factor + summand, k * factor + summand, m * factor + summand
    put(x, 2, a + b + c + d + e + f + g + h + i + j + k + m)


@kernel(inline=False)
def dependent_multiply_adds(x, factor, summand, rounds):
    """Return `x` after `rounds` of four multiply-adds, each of the result of the one before."""
    for _ in range(rounds):
        x = (((x * factor + summand) * factor + summand) * factor + summand) * factor + summand
    return x


@kernel(inline=False)
def _dependent_divisions(x, dividend, rounds):
    """Return `x` after `rounds` of four divisions of `dividend` by the result before."""
    for _ in range(rounds):
        x = dividend / (dividend / (dividend / (dividend / x)))
    return x


def _measure_latencies(rounds: int = ROUNDS // 4) -> tuple[float, float]:
    """Return the least times [s] of a multiply-add and of a division in a chain."""
    dependent_multiply_adds(1.0, 0.5, 1.0, 1), _dependent_divisions(1.5, 2.0, 1)
    spans = []
    for _ in range(REPETITIONS):
        times = [time.perf_counter()]
        dependent_multiply_adds(1.0, 0.5, 1.0, rounds)
        times.append(time.perf_counter())
        _dependent_divisions(1.5, 2.0, rounds)
        spans.append(np.diff([*times, time.perf_counter()]) / (4 * rounds))
    multiply_add, division = np.min(spans, axis=0)
    return float(multiply_add), float(division)


def _operands() -> np.ndarray:
    x = np.zeros((CHAINS + 2, LANES))
    x[0], x[1] = 0.5, 1.0 + np.arange(LANES)
    return x


def measure_machine(rounds: int = ROUNDS) -> MachineSpeed:
    """Return the best of some runs on one thread and on two, in turn."""
    multiply_adds(_operands(), 10)
    spans: dict[int, list[float]] = {1: [], 2: []}
    with ThreadPoolExecutor(2) as pool:
        for _ in range(REPETITIONS):
            for threads, taken in spans.items():
                operands = [_operands() for _ in range(threads)]
                begin = time.perf_counter()
                list(pool.map(lambda x: multiply_adds(x, rounds), operands))
                taken.append(time.perf_counter() - begin)
    one, two = min(spans[1]), min(spans[2])
    latencies = _measure_latencies(rounds // 4)
    return MachineSpeed(CHAINS * LANES * rounds / one, 2.0 * one / two, *latencies)
