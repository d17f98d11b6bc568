"""Linear algebra keeps to one thread where several would wait for each other."""

import numpy as np
import pytest
from fakes import fake_drives, task
from threadpoolctl import threadpool_info, threadpool_limits

from estimators import estimate
from leaderboard.evaluation.evaluate import run_task
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Estimate, profile_stations


def threads():
    return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}


class Counting:
    """Counts the threads of BLAS while it estimates."""

    causal = False

    def estimate(self, record, vehicle):
        self.seen = threads()
        s = profile_stations(record.length)
        return Estimate(s, np.zeros((2, s.size)))


def test_an_estimate_is_made_on_one_thread_and_leaves_the_threads_as_they_were():
    record, _ = simulate_record("iso_c", speed_kmh=36.0, length=10.0)
    estimator = Counting()
    with threadpool_limits(2, user_api="blas"):
        if threads() == {1}:
            pytest.skip("this BLAS has one thread only")
        estimate(estimator, record)
        assert estimator.seen == {1} and threads() == {2}


def test_drives_and_rows_are_made_on_one_thread_in_the_process_of_any_user():
    """`verify_folder` and `run_job_file` make them by the same two functions as `run_task`."""
    estimator, simulated = Counting(), set()

    def simulate(*asked):
        simulated.update(threads())
        return fake_drives(*asked)

    with threadpool_limits(2, user_api="blas"):
        if threads() == {1}:
            pytest.skip("this BLAS has one thread only")
        (row,) = run_task(task(), {"counting": estimator}, (1,), simulate=simulate)
        assert row.failure is None and threads() == {2}
    assert estimator.seen == {1} and simulated == {1}
