import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from studies.bench.machine import (
    CHAINS,
    LANES,
    _dependent_divisions,
    dependent_multiply_adds,
    measure_machine,
    multiply_adds,
)
from studies.bench.speed import (
    CHAIN_DIVISIONS,
    CHAIN_MULTIPLY_ADDS,
    STEP_ADDITIONS,
    STEP_COMPARISONS,
    STEP_DIVISIONS,
    STEP_MULTIPLICATIONS,
    benchmark_row,
)

COUNT = Path(__file__).parents[1] / "support" / "count_operations.py"


def test_every_chain_of_multiply_adds_sums_its_geometric_series():
    x = np.zeros((CHAINS + 2, LANES))
    x[0], x[1] = 0.5, 1.0 + np.arange(LANES)
    multiply_adds(x, 3)
    np.testing.assert_array_equal(x[2], CHAINS * x[1] * (1.0 + 0.5 + 0.25))


def test_a_chain_takes_four_operations_in_each_round():
    assert dependent_multiply_adds(1.0, 0.5, 1.0, 2) == 2.0 - 0.5**8
    assert _dependent_divisions(1.5, 2.0, 3) == 1.5


def test_the_machine_is_measured_on_one_thread_and_on_two():
    machine = measure_machine(rounds=2000)
    assert machine.one_thread > 1e6
    assert machine.second_thread > 0.0
    assert 0.0 < machine.multiply_add < machine.division


def test_the_bench_states_the_operations_of_a_step_as_counted():
    counted = subprocess.run(
        [sys.executable, COUNT],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        check=True,
        capture_output=True,
        text=True,
    )
    assert json.loads(counted.stdout) == {
        "additions": STEP_ADDITIONS,
        "multiplications": STEP_MULTIPLICATIONS,
        "divisions": STEP_DIVISIONS,
        "comparisons": STEP_COMPARISONS,
        "chain_multiply_adds": CHAIN_MULTIPLY_ADDS,
        "chain_divisions": CHAIN_DIVISIONS,
    }


@pytest.mark.parametrize(
    ("aim", "value", "met"),
    [
        (">= 90 %", 90.0, True),
        (">= 90 %", 89.9, False),
        ("<= 5 MiB", 5.0, True),
        ("< 3 s", 3.0, False),
    ],
)
def test_an_aim_is_met_by_its_own_relation_and_only_a_missed_one_says_why(aim, value, met):
    row = benchmark_row("speed", "as measured", aim, value, "its limit", rate=value)
    assert (row["met"], row.get("why"), row["rate"]) == (met, None if met else "its limit", value)
    assert benchmark_row("speed", "as measured")["met"] is None
