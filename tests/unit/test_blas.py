"""Linear algebra keeps to one thread where several would wait for each other."""

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from estimators import estimate
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
