"""Training of networks: reproducible, interruptible, validated, causal within the lag."""

from dataclasses import replace

import numpy as np
import pytest
from test_estimator_contract import CAR, drive, fit

from estimators import create, pretrained_weights
from estimators.api import LAG, NotFittedError
from estimators.common.pretrained import STATIONS_AHEAD
from estimators.networks.inputs import NetworkInputs
from estimators.networks.sequence_estimator import Tcn
from estimators.networks.trainer import (
    TrainerConfig,
    TrainingSequence,
    _learning_rate_factor,
    _split_validation,
    get_weights,
    set_weights,
    train_network,
)

torch = pytest.importorskip("torch")


class Shallow(torch.nn.Module):
    """The smallest trainable network: a window of three stations."""

    behind = ahead = 1

    def __init__(self, seed: int = 0):
        super().__init__()
        torch.manual_seed(seed)
        self.window = torch.nn.Conv1d(10, 4, 3)

    def forward(self, x, conditions):
        return self.window(x)


def sequence(seed: int, noise: float, size: int = 400) -> TrainingSequence:
    """The residual is a linear window of the inputs plus noise."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((10, size + 2)).astype(np.float32)
    residual = np.array([0.7 * x[0, 2:] - 0.3 * x[1, :-2], 0.5 * x[2, 1:-1]])
    residual = residual + noise * rng.standard_normal(residual.shape)
    inputs = NetworkInputs(x, np.zeros((8, 1), np.float32), np.ones(size), np.zeros((2, size)))
    return TrainingSequence(inputs, residual.astype(np.float32), 0, size)


CONFIG = TrainerConfig(steps=300, batch=8, crop_length=40, learning_rate=3e-2, weight_decay=0.0)


def test_a_linear_relation_is_learned_and_its_noise_is_the_standard_deviation():
    network = Shallow()
    error, _ = train_network(network, [sequence(k, noise=0.2) for k in range(20)], CONFIG, 0)
    assert error == pytest.approx(0.04, rel=0.1)
    bias = network.window.bias.detach().numpy()
    np.testing.assert_allclose(np.exp(bias[2:]), 0.2, rtol=0.2)


class InterruptionError(Exception):
    pass


class MemoryCheckpoint:
    """Checkpoint in memory; interrupts the training after `last` saves."""

    def __init__(self, last: int | None = None):
        self.last, self.state = last, None

    def load(self):
        return self.state

    def save(self, state):
        self.state = {name: np.array(x) for name, x in state.items()}
        self.last = None if self.last is None else self.last - 1
        if self.last == 0:
            raise InterruptionError


@pytest.mark.parametrize("saves", [1, 7, 20])
def test_an_interrupted_training_gives_the_same_weights_to_the_bit(saves):
    sequences = [sequence(k, noise=0.1, size=120) for k in range(12)]
    config = CONFIG._replace(steps=60)
    whole, parts = Shallow(), Shallow()
    train_network(whole, sequences, config, 3)
    memory = MemoryCheckpoint(saves)
    with pytest.raises(InterruptionError):
        train_network(parts, sequences, config, 3, checkpoint=memory)
    memory.last = None
    resumed = Shallow(seed=99)
    train_network(resumed, sequences, config, 3, checkpoint=memory)
    for name, x in get_weights(whole).items():
        np.testing.assert_array_equal(get_weights(resumed)[name], x)


def test_the_weights_of_the_smallest_validation_error_are_kept():
    """The validation drives follow the opposite law: the initial weights are best."""
    sequences = [sequence(k, noise=0.0) for k in range(20)]
    for k in (9, 19):
        sequences[k] = sequences[k]._replace(residual=-sequences[k].residual)
    network = Shallow()
    for weight in network.parameters():
        torch.nn.init.zeros_(weight)
    shares = []
    train_network(network, sequences, CONFIG, 0, lambda text, share: shares.append(share))
    assert not any(x.any() for name, x in get_weights(network).items() if name == "window.weight")
    assert len(shares) == 8 and shares[-1] < 0.5  # stops after six evaluations without improvement


def test_validation_takes_whole_drives_of_many_and_ends_of_few():
    many, few = ([sequence(k, 0.0, 100) for k in range(n)] for n in (25, 3))
    training, validation = _split_validation(many)
    assert validation == [many[9], many[19]]
    assert len(training) == 23
    training, validation = _split_validation(few)
    assert [(p.start, p.stop) for p in training] == 3 * [(0, 80)]
    assert [(p.start, p.stop) for p in validation] == 3 * [(80, 100)]


def test_a_mirrored_crop_has_roll_and_half_difference_negated():
    part = sequence(0, 0.1)
    x, _, residual = part.crop(10, 5, Shallow, False)
    turned_x, _, turned = part.crop(10, 5, Shallow, True)
    np.testing.assert_array_equal(residual, part.residual[:, 10:15])
    np.testing.assert_array_equal(turned, [residual[0], -residual[1]])
    roll = [2, 5, 7, 9]
    np.testing.assert_array_equal(turned_x[roll], -x[roll])
    np.testing.assert_array_equal(np.delete(turned_x, roll, 0), np.delete(x, roll, 0))


def test_the_learning_rate_rises_and_falls():
    rates = [_learning_rate_factor(step, 1000) for step in range(1001)]
    assert rates[0] < 0.02 and max(rates) > 0.95
    assert np.argmax(rates) == pytest.approx(100, abs=2)
    assert rates[-1] == pytest.approx(0.02)


@pytest.mark.parametrize("name", ["tcn_causal", "gru_causal"])
def test_a_causal_network_uses_samples_up_to_its_lag_and_none_after(name):
    """The first station that changes lies within half a metre of the limit."""
    estimator, (record, _) = fit(name), drive(500)
    before = estimator.estimate(record, CAR)
    changed = replace(record, a=np.where(record.s > 12.0, record.a + 5.0, record.a))
    moved = np.any(estimator.estimate(changed, CAR).z != before.z, axis=0)
    first = before.s[np.argmax(moved)]
    assert 12.0 - LAG <= first <= 12.0 - LAG + 0.5
    assert STATIONS_AHEAD > 0


def test_settings_other_than_those_of_the_shipped_weights_need_a_fit():
    record, _ = drive(501)
    with pytest.raises(NotFittedError, match="Tcn must be fitted"):
        create("tcn", channels=7).estimate(record, CAR)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"channels": 0}, "channels: must be at least 1"),
        ({"kernel": 4}, "kernel: must be odd, got 4"),
        ({"dilations": ()}, "dilations: must have at least 1 element"),
    ],
)
def test_invalid_settings_are_rejected(settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        Tcn(**settings)


def test_weights_survive_a_file_and_a_damaged_file_is_reported(tmp_path):
    path = tmp_path / "w.safetensors"
    arrays = {"x": np.arange(3.0).astype(np.float16)[::-1], "y": np.array(2.0)}
    pretrained_weights.write_weights(path, arrays, {"seed": "1"})
    found, about = pretrained_weights.read_weights(path)
    assert about == {"seed": "1"}
    for name, x in arrays.items():
        assert (found[name].dtype, found[name].shape) == (x.dtype, x.shape)
        np.testing.assert_array_equal(found[name], x)
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(pretrained_weights.StorageError, match=r"w\.safetensors: damaged"):
        pretrained_weights.read_weights(path)
    with pytest.raises(pretrained_weights.StorageError, match=r"no\.safetensors: cannot be read"):
        pretrained_weights.read_weights(tmp_path / "no.safetensors")


def test_a_network_accepts_the_weights_it_returned():
    one, other = Shallow(0), Shallow(1)
    set_weights(other, get_weights(one))
    x = torch.randn(1, 10, 20)
    np.testing.assert_array_equal(one(x, x).detach().numpy(), other(x, x).detach().numpy())
