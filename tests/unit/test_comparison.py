"""Results are compared at a tolerance; the kernels that decide their digits are recorded."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from agreement import disagreements
from fake_results import result_of, runs_of, with_last_run, with_runs

from leaderboard.evaluation.comparison import SAME_KERNELS, distance, largest_distance
from leaderboard.sandbox.limits import guest_environment

READER = result_of("reader")


def with_scores(change):
    """The reader's result with the scores of its last drive changed."""
    return with_last_run(READER, change)


def scaled(name, factor):
    return with_scores(lambda scores: scores | {name: factor * scores[name]})


def test_a_score_may_differ_by_the_tolerance_and_not_by_more():
    assert disagreements(READER, scaled("nrmse", 1.0 + 0.9 * SAME_KERNELS)) == []
    (found,) = disagreements(READER, scaled("nrmse", 1.0 + 1.2 * SAME_KERNELS))
    assert "nrmse differs by" in found and next(reversed(runs_of(READER)))[2] in found


def test_small_scores_are_compared_at_their_printed_digits():
    """The bias of a density is printed as 0.0 dB: 100 steps are 10 dB."""
    assert distance("dsd_bias_db", 0.0, 0.04) == pytest.approx(0.004)
    assert distance("nrmse", 0.0, 0.001) == pytest.approx(0.01)
    assert distance("nrmse", 2.0, 2.002) == pytest.approx(0.001, rel=1e-2)


def test_a_score_that_only_one_result_has_is_at_the_largest_distance():
    lacking = with_scores(lambda scores: {k: x for k, x in scores.items() if k != "r"})
    assert len(disagreements(READER, lacking)) == 1
    assert distance("r", None, None) == 0.0
    assert distance("r", 0.0, None) == distance("r", 3.0, -3.0) == 2.0


def test_the_largest_distance_is_that_of_the_scores_that_are_compared():
    scores = {"nrmse": 1.0, "r": 1.0}, {"nrmse": 1.002, "r": 0.5}
    assert largest_distance(*scores) == ("r", 0.5)
    assert largest_distance(*scores, ["nrmse"]) == ("nrmse", pytest.approx(0.002, rel=1e-2))


def test_times_and_machine_are_not_compared_and_all_else_is():
    other = dataclasses.replace(READER, environment={}, peak_memory=9.0, train_seconds=(9.0,))
    assert disagreements(READER, other) == []
    fewer = with_runs(READER, dict(list(runs_of(READER).items())[1:]))
    for change in ({"parameters": 2}, {"failure": "it failed"}, {"scores": fewer.scores}):
        assert len(disagreements(READER, dataclasses.replace(READER, **change))) == 1
    first, *others = READER.traces
    for step, count in ((1, 0), (2, 1)):  # 0.01 mm is the rounding of what is stored
        moved = first.estimate + step
        traces = (dataclasses.replace(first, estimate=moved), *others)
        assert len(disagreements(READER, dataclasses.replace(READER, traces=traces))) == count


KERNELS = """
import json, numpy
from leaderboard.evaluation.provenance import describe_environment
print(json.dumps(describe_environment()))
"""


@pytest.mark.parametrize("kernel", ["Haswell", "Sandybridge"])
def test_a_guest_computes_with_the_kernels_of_its_judge_and_they_are_recorded(kernel, monkeypatch):
    monkeypatch.setenv("OPENBLAS_CORETYPE", kernel)
    environment = guest_environment(Path("/tmp"), whole_path=True)
    assert environment["OPENBLAS_CORETYPE"] == kernel
    found = subprocess.run(
        [sys.executable, "-c", KERNELS],
        env=environment | {"HOME": os.environ.get("HOME", "/")},
        capture_output=True,
        check=True,
        timeout=60,
    )
    facts = json.loads(found.stdout)
    if not facts["blas"].startswith("openblas"):
        pytest.skip(f"BLAS is {facts['blas']}")
    assert kernel.lower() in facts["blas"].lower() and facts["threads"] == "1"
