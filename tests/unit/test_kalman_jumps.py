"""Accepted steps of the road against the dense posterior of a linear model with their prior."""

from types import SimpleNamespace

import numpy as np

from estimators.kalman import jumps
from estimators.kalman.state import NOISE_SCALE

N_NODES, N_STATES, BLOCKS = 6, 20, 12
NODES = slice(8, 20)
"""Means and half differences of the nodes, in turn; before them the vehicle and 4 forces."""


def filtered(steps: dict[int, float], seed: int):
    """Filter a static linear model whose road has `steps` [m] of candidates that the filter does
    not know. Return the model, the filter's state and the blocks, as `accept_jumps` takes them.
    """
    rng = np.random.default_rng(seed)
    one = jumps.empty_jumps(N_STATES, N_NODES, N_NODES)
    for node in range(N_NODES):
        jumps.add_candidates.py_func(one, node, NODES.start + 2 * node, True)
    unit = one.direction.copy()
    P0 = np.diag(rng.uniform(0.5, 2.0, N_STATES)) * 1e-6
    H = rng.standard_normal((BLOCKS, 3, N_STATES)) * 300.0
    truth = rng.multivariate_normal(np.zeros(N_STATES), P0)
    truth += sum(size * unit[i] for i, size in steps.items())
    y = H @ truth + rng.standard_normal((BLOCKS, 3))
    x, P = np.zeros(N_STATES), P0.copy()
    blocks = SimpleNamespace(
        jump_response=np.zeros((BLOCKS, 2 * N_NODES, 3)),
        innovation=np.zeros((BLOCKS, 3)),
        nodes_added=np.zeros((BLOCKS, 1), dtype=int),
    )
    for j in range(BLOCKS):
        whitener = np.linalg.inv(np.linalg.cholesky(H[j] @ P @ H[j].T + np.eye(3)))
        white = whitener @ H[j]
        block = SimpleNamespace(
            n_columns=np.array([N_STATES]), columns=np.arange(N_STATES), H=white, V=white @ P,
            innovation=whitener @ (y[j] - H[j] @ x), jump_response=blocks.jump_response[j],
        )  # fmt: skip
        blocks.innovation[j] = block.innovation
        x, P = x + block.V.T @ block.innovation, P - block.V.T @ block.V
        jumps.update_candidates.py_func(one, block)
    state = SimpleNamespace(
        jumps=one, x=x, P=P, newest_node=np.array([N_NODES - 1]), adaptive=np.ones(5)
    )
    return state, blocks, (P0, H.reshape(-1, N_STATES), y.ravel(), unit)


def test_accepted_steps_give_the_dense_posterior_and_innovations_of_their_prior(monkeypatch):
    monkeypatch.setattr(jumps, "RELATIVE_ERROR", 0.0)
    model = SimpleNamespace(wheelbase_nodes=50.0, jump_reach=4)
    steps = {3: 0.08, 8: -0.06}  # of the right path at node 1, of the left one at node 4
    state, blocks, (P0, H, y, unit) = filtered(steps, 5)
    before = state.x.copy(), (blocks.innovation**2).mean()
    jumps.accept_jumps.py_func(model, state, blocks, BLOCKS - 1)
    found = np.argwhere(state.jumps.square > 0.0)
    assert {2 * node + side for node, side in found} == set(steps)
    prior = P0 + jumps.JUMP_STD**2 * sum(np.outer(unit[i], unit[i]) for i in steps)
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + np.eye(y.size))
    np.testing.assert_allclose(state.x, gain @ y, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(state.P, prior - gain @ H @ prior, rtol=1e-5, atol=1e-9)
    assert np.abs(before[0] - state.x).max() > 0.01
    # what the smoother goes back over is as if the filter had known the steps
    assert before[1] > 5.0 > 2.0 > (blocks.innovation**2).mean()


def test_no_step_is_accepted_on_a_stationary_road_or_where_the_rear_axle_meets_one():
    model = SimpleNamespace(wheelbase_nodes=50.0, jump_reach=4)
    state, blocks, _ = filtered({}, 6)
    jumps.accept_jumps.py_func(model, state, blocks, BLOCKS - 1)
    assert not state.jumps.square.any()
    state, blocks, _ = filtered({3: 0.08}, 6)
    state.jumps.square[1, 1] = before = 0.05**2
    model.wheelbase_nodes = 2.0  # the rear axle stands on node 1
    jumps.accept_jumps.py_func(model, state, blocks, BLOCKS - 1)
    assert state.jumps.square.sum() == before
    state, blocks, _ = filtered({3: 0.08}, 6)
    state.adaptive[NOISE_SCALE] = 1e4  # another vehicle than the one described
    jumps.accept_jumps.py_func(
        SimpleNamespace(wheelbase_nodes=50.0, jump_reach=4), state, blocks, 0
    )
    assert not state.jumps.square.any()
