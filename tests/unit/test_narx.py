"""NARX network: series-parallel in training, its own outputs fed back in use."""

import numpy as np
import pytest
from test_estimator_contract import drive, error

from estimators.networks import levenberg_marquardt as lm
from estimators.networks.narx import Narx, _run_parallel, _series_parallel
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")


@pytest.fixture(scope="module")
def trained() -> Narx:
    records, truths = zip(*(drive(seed) for seed in (1, 2, 3)), strict=True)
    return Narx(hidden=6, max_epochs=30).fit(records, truths, CAR, 0)


def test_regressors_are_current_and_past_accelerations_and_past_true_heights():
    x, z = np.arange(30.0).reshape(3, 10), 100.0 + np.arange(20.0).reshape(2, 10)
    regressors, targets = _series_parallel(x, z, 2)
    np.testing.assert_array_equal(targets, z[:, 2:])
    k = 5
    expected = [*x[:, k], *x[:, k - 1], *x[:, k - 2], *z[:, k - 1], *z[:, k - 2]]
    np.testing.assert_array_equal(regressors[:, k - 2], expected)


def test_in_parallel_the_network_feeds_back_its_own_outputs():
    rng = np.random.default_rng(0)
    network = lm.nguyen_widrow(13, 4, 2, rng)
    x, before = rng.uniform(-1, 1, (3, 12)), rng.uniform(-1, 1, (2, 2))
    z = _run_parallel(network.hidden, network.output, x, before)
    past, sensed = [before[:, 1], before[:, 0]], [x[:, 0], x[:, 0]]
    for k in range(12):
        seen = np.concatenate([x[:, k], *sensed, *past])
        answer = network(seen[:, None])[:, 0]
        np.testing.assert_allclose(z[:, k], answer, rtol=1e-12)
        past, sensed = [answer, past[0]], [x[:, k], sensed[0]]


def test_both_loops_agree_where_the_outputs_are_the_truth():
    rng = np.random.default_rng(1)
    network = lm.nguyen_widrow(13, 4, 2, rng)
    x, before = rng.uniform(-1, 1, (3, 40)), np.zeros((2, 2))
    z = _run_parallel(network.hidden, network.output, x, before)
    regressors, targets = _series_parallel(x, z, 2)
    np.testing.assert_allclose(network(regressors), targets, atol=1e-12)


def test_the_open_loop_error_is_small_and_the_closed_loop_error_is_not(trained):
    open_loop, closed_loop = trained.fitted_state.errors
    assert open_loop < 0.1 < 0.5 < closed_loop
    record, truth = drive(300)
    estimate = trained.estimate(record, CAR)
    assert error(estimate, truth) > 0.5
    (note,) = estimate.notes
    assert f"{closed_loop:.2f} in closed loop, as here; {open_loop:.2f} with the true" in note


def test_the_training_history_is_stored_with_the_weights(trained):
    again = Narx(hidden=6).with_weights(trained.weights()).training
    assert again.stop == trained.training.stop
    assert again.best_epoch == trained.training.best_epoch
    for name in lm.CURVES:
        np.testing.assert_array_equal(getattr(again, name), getattr(trained.training, name))
