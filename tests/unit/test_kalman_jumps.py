"""Accepted steps of the road against the dense posterior of a linear model with their prior."""

from dataclasses import replace

import numpy as np

from estimators.kalman import jumps
from estimators.kalman.state import LocalState, StepTest
from estimators.kalman.tuning import TUNING

N_NODES, N_STATES, BLOCKS = 6, 20, 12
NODES = slice(8, 20)
"""Means and half differences of the nodes, in turn; before them the vehicle."""
LEAST = TUNING.min_log_ratio


def filtered(steps: dict[int, float], seed: int):
    """Filter a static linear model whose road has `steps` [m] of candidates that the filter does
    not know. Return the candidates, the filter's mean, covariance and directions, its innovations
    with their mean per unit step, and the model.
    """
    rng = np.random.default_rng(seed)
    one = jumps.RoadJumps.none(0.0, N_NODES, TUNING.jump_length / N_NODES)
    one.begin(np.arange(N_NODES))
    direction = np.zeros((N_STATES, 2 * N_NODES))
    for node in range(N_NODES):
        direction[NODES.start + 2 * node, [2 * node, 2 * node + 1]] = 0.5
        direction[NODES.start + 2 * node + 1, [2 * node, 2 * node + 1]] = 0.5, -0.5
    unit = direction.T.copy()
    P0 = np.diag(rng.uniform(0.5, 2.0, N_STATES)) * 1e-6
    H = rng.standard_normal((BLOCKS, 3, N_STATES)) * 300.0
    truth = rng.multivariate_normal(np.zeros(N_STATES), P0)
    truth += sum(size * unit[i] for i, size in steps.items())
    y = H @ truth + rng.standard_normal((BLOCKS, 3))
    x, P = np.zeros(N_STATES), P0.copy()
    innovation, response = np.zeros((BLOCKS, 3)), np.zeros((BLOCKS, 3, 2 * N_NODES))
    for j in range(BLOCKS):
        whitener = np.linalg.inv(np.linalg.cholesky(H[j] @ P @ H[j].T + np.eye(3)))
        white = whitener @ H[j]
        V, innovation[j] = white @ P, whitener @ (y[j] - H[j] @ x)
        response[j] = white @ direction
        direction -= V.T @ response[j]
        x, P = x + V.T @ innovation[j], P - V.T @ V
        jumps._add_information.py_func(one.score, one.information, response[j], innovation[j])
    return one, (x, P, direction), (innovation, response), (P0, H.reshape(-1, N_STATES), y, unit)


def test_accepted_steps_give_the_dense_posterior_and_innovations_of_their_prior(monkeypatch):
    monkeypatch.setattr(jumps, "TUNING", replace(TUNING, relative_error=0.0))
    steps = {3: 0.08, 8: -0.06}  # of the right path at node 1, of the left one at node 4
    one, (x, P, direction), (innovation, response), (P0, H, y, unit) = filtered(steps, 5)
    before = x.copy(), (innovation**2).mean()
    accepted = one.accept(x, P, direction, N_NODES - 1, LEAST)
    assert {step.candidate for step in accepted} == set(steps)
    assert {2 * node + side for node, side in np.argwhere(one.square > 0.0)} == set(steps)
    prior = P0 + TUNING.jump_std**2 * sum(np.outer(unit[i], unit[i]) for i in steps)
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + np.eye(y.size))
    np.testing.assert_allclose(x, gain @ y.ravel(), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(P, prior - gain @ H @ prior, rtol=1e-5, atol=1e-9)
    assert np.abs(before[0] - x).max() > 0.01
    # what the smoother goes back over is as if the filter had known the steps
    for step in accepted:
        share = response[:, :, step.candidate].copy()
        innovation -= step.size * share
        response -= share[:, :, None] * (step.variance * step.cross)
    assert before[1] > 5.0 > 2.0 > (innovation**2).mean()


def test_no_step_is_accepted_on_a_stationary_road_or_a_vehicle_that_is_not_the_one_described():
    for steps, least in (({}, LEAST), ({3: 0.08}, 1e4 * LEAST)):
        one, (x, P, direction), *_ = filtered(steps, 6)
        assert one.accept(x, P, direction, N_NODES - 1, least) == []
        assert not one.square.any()


def test_a_window_ends_at_the_block_after_which_a_step_is_likely():
    """Unless the rear axle is near an earlier step, or another vehicle makes noise."""
    _, _, (innovation, response), (*_, unit) = filtered({3: 0.02}, 6)
    one = jumps.RoadJumps.none(0.0, N_NODES, TUNING.jump_length / N_NODES)
    expected = 0
    for expected in range(BLOCKS):
        jumps._add_information.py_func(
            one.score, one.information, response[expected], innovation[expected]
        )
        if jumps._most_likely(one.score, one.information, N_NODES - 1, N_NODES)[1] > LEAST:
            break
    assert 0 < expected < BLOCKS - 1
    # any derivative by the state of which the directions have these responses
    U = (response @ np.linalg.pinv(unit.T)).reshape(-1, N_STATES)
    for noise, near, found in ((1.0, False, expected), (1e4, False, None), (1.0, True, None)):
        m = 2 * N_NODES
        test = StepTest(
            unit.T.copy(), np.zeros(m), np.zeros((m, m)), np.full(BLOCKS, N_NODES - 1),
            np.full(BLOCKS, near), N_NODES,
        )  # fmt: skip
        adaptive = np.array([1.0, 1.0, 1.0, noise, 0.0])
        local = LocalState(
            np.zeros(0), np.zeros((0, 0)), np.zeros(2, dtype=np.int64), np.zeros((4, 3)),
            adaptive, innovation.ravel(), U, np.zeros(0), np.zeros(0), np.zeros(0),
        )  # fmt: skip
        likely = [i for i in range(BLOCKS) if jumps.step_is_likely(test, local, i)]
        assert likely[:1] == ([] if found is None else [found])


def test_the_rear_axle_meets_a_step_within_its_reach():
    one, node = jumps.RoadJumps.none(0.0, 40, 0.05), np.arange(40)
    one.add(20, 1, 0.05)
    np.testing.assert_array_equal(np.argwhere(one.square > 0.0), [[20, 1]])
    reach = round(TUNING.rear_reach / 0.05)
    np.testing.assert_array_equal(one.near, (node > 20 - reach) & (node <= 20 + reach))
