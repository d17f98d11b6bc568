"""Levenberg-Marquardt against automatic differentiation, SciPy and the rules of `trainlm`."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve
from scipy.optimize import least_squares

from estimators.networks import levenberg_marquardt as lm
from studies.bench import levenberg_marquardt as lm_peers
from studies.bench.integrators import PeerError

DEFAULTS = lm.TrainlmOptions()


def problem(seed: int, size: int = 300, hidden: int = 7):
    """A network and samples (3, N), (2, N) that it does not fit yet."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (3, size))
    t = np.array([np.sin(3.0 * x[0]) * x[1], x[2] ** 2 - x[0]])
    t += 0.05 * rng.standard_normal(t.shape)
    return lm.nguyen_widrow(3, hidden, 2, rng), x, t


def all_training(size: int) -> lm.Split:
    """All samples for training."""
    none = np.arange(0)
    return lm.Split(np.arange(size), none, none)


def near_an_optimum(seed: int):
    """A network close to the one that generated the samples (1, N), (1, N), apart from noise."""
    rng = np.random.default_rng(seed)
    teacher = lm.TwoLayerNetwork(np.array([[2.0, -3.0], [0.5, 1.0]]), np.array([[0.7, 0.4, -0.2]]))
    x = rng.uniform(-1.0, 1.0, (1, 80))
    t = teacher(x) + 0.02 * rng.standard_normal(x.shape)
    return teacher.add_step(0.3 * rng.standard_normal(7)), x, t


def parameters(network: lm.TwoLayerNetwork) -> np.ndarray:
    """The weights in the order of the normal equations."""
    return np.concatenate([network.hidden.ravel(), network.output.ravel()])


def evaluate(network: lm.TwoLayerNetwork, x: np.ndarray, t: np.ndarray) -> lm._Evaluation:
    """The network at samples without ones."""
    return lm._evaluate(network, lm._append_ones(x), t)


def test_the_normal_equations_agree_with_automatic_differentiation():
    torch = pytest.importorskip("torch")
    network, x, t = problem(0, size=2 * lm.CHUNK // 3)  # one whole chunk and a part of one
    samples = torch.from_numpy(np.vstack([x, np.ones(x.shape[1])]))
    rows = network.hidden.size

    def forward(weights):
        hidden = weights[:rows].reshape(network.hidden.shape)
        output = weights[rows:].reshape(network.output.shape)
        h = torch.tanh(hidden.T @ samples)
        return (output[:, :-1] @ h + output[:, -1:]).reshape(-1)

    J = torch.func.jacrev(forward)(torch.from_numpy(parameters(network))).numpy()
    e = (t - network(x)).ravel()
    at = evaluate(network, x, t)
    JJ, Je = lm._normal_equations(at)
    np.testing.assert_allclose(JJ, np.tril(J.T @ J) / e.size, rtol=0, atol=1e-12)
    np.testing.assert_allclose(Je, J.T @ e / e.size, rtol=0, atol=1e-12)
    assert at.mse == pytest.approx(np.mean(e**2), rel=1e-12)


def test_the_normal_equations_agree_with_complex_steps():
    network, x, t = problem(1, size=40)
    step = 1e-30
    J = np.array(
        [
            network.add_step(1j * step * unit)(x).imag.ravel() / step
            for unit in np.eye(parameters(network).size)
        ]
    ).T
    e = (t - network(x)).ravel()
    JJ, Je = lm._normal_equations(evaluate(network, x, t))
    np.testing.assert_allclose(JJ, np.tril(J.T @ J) / e.size, rtol=0, atol=1e-13)
    np.testing.assert_allclose(Je, J.T @ e / e.size, rtol=0, atol=1e-13)


def test_the_gradient_is_that_of_the_mean_squared_error():
    network, x, t = problem(14)
    _, Je = lm._normal_equations(evaluate(network, x, t))
    downhill = Je / np.linalg.norm(Je)
    ahead, behind = (evaluate(network.add_step(h * downhill), x, t).mse for h in (1e-5, -1e-5))
    untrained = lm.train(network, x, t, all_training(300), replace(DEFAULTS, max_epochs=0))
    assert untrained.gradient[0] == pytest.approx((behind - ahead) / 2e-5, rel=1e-6)


def test_the_defaults_are_those_of_trainlm():
    assert DEFAULTS == lm.TrainlmOptions(
        max_epochs=1000,
        goal=0.0,
        min_grad=1e-7,
        max_fail=6,
        mu=1e-3,
        mu_decrease=0.1,
        mu_increase=10.0,
        mu_max=1e10,
    )


def test_the_chunk_size_does_not_change_the_sums(monkeypatch):
    network, x, t = problem(2)
    whole = lm._normal_equations(evaluate(network, x, t)), evaluate(network, x, t).mse
    monkeypatch.setattr(lm, "CHUNK", 37)
    parts = lm._normal_equations(evaluate(network, x, t)), evaluate(network, x, t).mse
    for a, b in zip(whole[0], parts[0], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15)
    assert whole[1] == pytest.approx(parts[1], rel=1e-12)


def test_the_network_is_equation_10_of_the_paper():
    network, x, _ = problem(3)
    W1, b1 = network.hidden[:-1].T, network.hidden[-1]
    W2, b2 = network.output[:, :-1], network.output[:, -1]
    for i in range(5):
        n = W1 @ x[:, i] + b1
        tansig = 2.0 / (1.0 + np.exp(-2.0 * n)) - 1.0
        np.testing.assert_allclose(network(x)[:, i], W2 @ tansig + b2, rtol=1e-12)


def test_the_paper_s_network_has_302_weights():
    network = lm.nguyen_widrow(3, 50, 2, np.random.default_rng(0))
    assert parameters(network).size == 302


def test_without_validation_it_reaches_scipys_optimum():
    start, x, t = near_an_optimum(5)
    training = lm.train(start, x, t, all_training(80), replace(DEFAULTS, min_grad=1e-10))

    def residuals(weights):
        return (t - start.add_step(weights - parameters(start))(x)).ravel()

    peer = least_squares(residuals, parameters(start), method="lm", ftol=1e-14, xtol=1e-14)
    assert training.train[-1] == pytest.approx(np.mean(peer.fun**2), rel=1e-6)


def test_training_ends_at_the_epoch_limit():
    network, x, t = problem(6)
    training = lm.train(network, x, t, all_training(300), replace(DEFAULTS, max_epochs=3))
    assert (training.stop, training.epochs) == ("epochs", 3)


def test_training_ends_at_the_goal():
    network, x, t = problem(6)
    goal = 0.5 * evaluate(network, x, t).mse
    training = lm.train(network, x, t, all_training(300), replace(DEFAULTS, goal=goal))
    assert training.stop == "goal"
    assert training.train[-1] <= goal < training.train[-2]


def test_training_ends_where_the_gradient_vanishes():
    network, x, t = near_an_optimum(7)
    training = lm.train(network, x, t, all_training(80))
    assert training.stop == "gradient"
    assert training.gradient[-1] <= 1e-7 < training.gradient[-2]


def test_training_ends_when_no_mu_lowers_the_error():
    network, x, t = near_an_optimum(7)
    optimum = lm.train(network, x, t, all_training(80), replace(DEFAULTS, min_grad=0.0))
    assert optimum.stop == "mu"
    assert optimum.mu[-1] > 1e10
    assert optimum.mu[-2] <= 1e10


def test_six_validation_failures_stop_training_at_the_best_weights():
    network, x, t = problem(8)
    split = lm.Split(np.arange(200), np.arange(200, 300), np.arange(0))
    t[:, 200:] = network(x[:, 200:])  # every step leads away from what validates perfectly
    training = lm.train(network, x, t, split)
    assert (training.stop, training.epochs, training.best_epoch) == ("validation", 6, 0)
    np.testing.assert_array_equal(training.network.hidden, network.hidden)
    np.testing.assert_array_equal(training.network.output, network.output)


def test_a_smaller_validation_error_resets_the_failure_count():
    network, x, t = problem(9, size=600, hidden=12)
    split = lm.Split.divide(600, "random", np.random.default_rng(0))
    training = lm.train(network, x, t, split)
    assert training.stop == "validation"
    assert training.epochs == training.best_epoch + 6
    assert training.best_epoch > 0
    assert training.best_epoch == np.argmin(training.validation)
    best = evaluate(training.network, x[:, split.validation], t[:, split.validation]).mse
    assert best == training.validation.min()


def test_the_training_error_falls_at_every_epoch():
    network, x, t = problem(10)
    training = lm.train(network, x, t, all_training(300), replace(DEFAULTS, max_epochs=40))
    assert (np.diff(training.train) < 0).all()
    assert np.isnan(training.validation).all()
    assert np.isnan(training.test).all()


def test_mu_falls_tenfold_with_every_step_accepted_at_once():
    """With constant input the problem is nearly linear, and every step succeeds."""
    rng = np.random.default_rng(11)
    x = rng.uniform(-1.0, 1.0, (1, 50))
    network = lm.TwoLayerNetwork(np.array([[0.0, 0.0], [1.0, -2.0]]), np.array([[0.5, 0.1, 3.0]]))
    options = replace(DEFAULTS, max_epochs=3, min_grad=0.0)
    training = lm.train(network, 0.0 * x, x, all_training(50), options)
    np.testing.assert_allclose(training.mu, [1e-3, 1e-4, 1e-5, 1e-6], rtol=1e-12)


def test_mu_rises_tenfold_with_every_step_that_fails():
    network, x, t = problem(12, hidden=20)
    options = replace(DEFAULTS, max_epochs=60, mu=1e-9)
    training = lm.train(network, x, t, all_training(300), options)
    exponents = np.diff(np.log10(training.mu))
    np.testing.assert_allclose(exponents, np.round(exponents), atol=1e-9)
    assert (exponents >= -1.0 - 1e-9).all()
    assert (exponents > 0.5).any()
    for epoch in range(3):
        assert_first_successful_mu(network, x, t, training, epoch)


def assert_first_successful_mu(network, x, t, training, epoch):
    """Assert that mu after `epoch` is that of the first step that lowers the error."""
    at = lm.train(network, x, t, all_training(300), replace(DEFAULTS, max_epochs=epoch, mu=1e-9))
    start = evaluate(at.network, x, t)
    JJ, Je = lm._normal_equations(start)
    mu = training.mu[epoch]
    while True:
        step = solve(JJ + mu * np.eye(len(JJ)), Je, lower=True, assume_a="pos")
        if evaluate(at.network.add_step(step), x, t).mse < start.mse:
            break
        mu *= 10.0
    assert training.mu[epoch + 1] == pytest.approx(0.1 * mu, rel=1e-9)


def test_singular_normal_equations_count_as_a_failed_step():
    """Identical neurons make the equations singular without mu."""
    rng = np.random.default_rng(0)
    network = lm.TwoLayerNetwork(np.full((2, 5), 0.3), np.full((1, 6), 0.7))
    x = rng.uniform(-1.0, 1.0, (1, 30))
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(lm._normal_equations(evaluate(network, x, x))[0])
    options = replace(DEFAULTS, mu=1e-30, max_epochs=1)
    training = lm.train(network, x, x, all_training(30), options)
    assert training.mu[1] > 1e-20
    assert training.train[1] < training.train[0]


def test_equal_seeds_give_equal_trainings_and_others_differ():
    def run(seed):
        _, x, t = problem(13)
        rng = np.random.default_rng(seed)
        split = lm.Split.divide(300, "random", rng)
        return lm.train(lm.nguyen_widrow(3, 5, 2, rng), x, t, split)

    one, same, other = run(1), run(1), run(2)
    np.testing.assert_array_equal(one.network.hidden, same.network.hidden)
    np.testing.assert_array_equal(one.train, same.train)
    assert one.train[0] != other.train[0]


@pytest.mark.parametrize(("inputs", "hidden"), [(3, 50), (1, 8), (5, 20)])
def test_initial_weights_have_the_nguyen_widrow_length(inputs, hidden):
    network = lm.nguyen_widrow(inputs, hidden, 2, np.random.default_rng(0))
    magnitude = 2.0 * 0.7 * hidden ** (1.0 / inputs)
    np.testing.assert_allclose(np.linalg.norm(network.hidden[:-1], axis=0), magnitude, rtol=1e-12)
    spread = np.sort(np.abs(network.hidden[-1]))
    np.testing.assert_allclose(
        spread, np.sort(np.abs(np.linspace(-magnitude, magnitude, hidden))), atol=1e-12
    )
    assert (np.abs(network.output) <= 1.0).all()


def test_initial_weights_of_one_input_cover_its_range():
    network = lm.nguyen_widrow(1, 9, 1, np.random.default_rng(3))
    w, b = network.hidden
    np.testing.assert_allclose(np.sort(-b / w), np.linspace(-1.0, 1.0, 9), atol=1e-12)


def test_a_single_hidden_neuron_starts_at_the_centre():
    network = lm.nguyen_widrow(2, 1, 1, np.random.default_rng(4))
    assert network.hidden[-1, 0] == 0.0


def test_scaling_fills_the_range_and_leaves_a_constant_row():
    x = np.array([[1.0, 2.0, 4.0], [7.0, 7.0, 7.0], [0.0, 0.0, 0.0]])
    scaling = lm.Scaling.fit(x)
    y = scaling.apply(x)
    np.testing.assert_allclose(y[0], [-1.0, -1.0 / 3.0, 1.0], rtol=1e-12)
    np.testing.assert_array_equal(y[1:], x[1:])
    np.testing.assert_allclose(scaling.reverse(y), x, rtol=1e-12)
    np.testing.assert_allclose(scaling.apply(np.array([[5.5], [8.0], [1.0]])), [[2], [8], [1]])


@pytest.mark.parametrize("how", ["random", "block"])
def test_a_division_uses_every_sample_once(how):
    split = lm.Split.divide(3964, how, np.random.default_rng(0))
    assert [part.size for part in split] == [2774, 595, 595]
    np.testing.assert_array_equal(np.sort(np.concatenate(split)), np.arange(3964))


def test_blocks_are_contiguous_and_random_divisions_are_not():
    blocks = lm.Split.divide(100, "block", np.random.default_rng(0))
    assert [(part[0], part[-1]) for part in blocks] == [(0, 69), (70, 84), (85, 99)]
    drawn = lm.Split.divide(100, "random", np.random.default_rng(0))
    assert (np.diff(drawn.validation) > 1).any()
    other = lm.Split.divide(100, "random", np.random.default_rng(1))
    assert not np.array_equal(drawn.validation, other.validation)


def test_the_jacobian_for_the_peers_is_the_derivative_of_the_outputs():
    rng = np.random.default_rng(5)
    network = lm.nguyen_widrow(3, 4, 2, rng)
    x = rng.uniform(-1.0, 1.0, (3, 7))
    p = np.concatenate([network.hidden.ravel(), network.output.ravel()])
    found = lm_peers.jacobian(network, x)
    assert found.shape == (14, p.size)
    for i in range(p.size):
        step = np.zeros(p.size)
        step[i] = 1e-6
        slope = (network.add_step(step)(x) - network.add_step(-step)(x)).ravel() / 2e-6
        np.testing.assert_allclose(found[:, i], slope, atol=1e-8)


@pytest.mark.parametrize("peer", [lm_peers.time_scipy, lm_peers.time_torch])
@pytest.mark.costly
def test_a_peer_reaches_the_same_error_from_the_same_start(peer):
    rng = np.random.default_rng(6)
    x = rng.uniform(-1.0, 1.0, (3, 200))
    t = np.tanh(rng.standard_normal((2, 3)) @ x)
    samples = lm_peers.Samples(x, t, lm.nguyen_widrow(3, lm_peers.HIDDEN, 2, rng))
    error = float(lm_peers.train_ours(samples, 2).train[-1])
    try:
        assert 0.0 < peer(samples, error) < lm_peers.TIME_LIMIT
    except PeerError as missing:
        pytest.skip(str(missing))


def test_a_result_survives_conversion_to_arrays():
    rng = np.random.default_rng(7)
    x = rng.uniform(-1.0, 1.0, (3, 40))
    start = lm.nguyen_widrow(3, 3, 2, rng)
    split = lm.Split(np.arange(40), np.arange(0), np.arange(0))  # nothing validated: NaN
    training = lm.train(start, x, x[:2] ** 2, split, lm.TrainlmOptions(max_epochs=4))
    again = lm.LmResult.from_arrays(training.network, **training.to_arrays())
    assert (again.stop, again.best_epoch) == (training.stop, training.best_epoch) == ("epochs", 4)
    for name in lm.CURVES:
        np.testing.assert_array_equal(getattr(again, name), getattr(training, name))
    with pytest.raises(ValueError, match="stop: the reason must be an index from 0 to 4, got 9"):
        lm.LmResult.from_arrays(training.network, training.to_arrays()["curves"], np.array([9, 0]))
