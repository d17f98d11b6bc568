"""Training of a sequence network: random crops of drives, AdamW, early stopping on validation data.

The loss of a crop is the mean squared residual in units of the drive's level, clamped at _LOSS_MAX
so that a hopeless drive cannot dominate a step. The standard deviations are trained by the Gaussian
likelihood of these residuals. The learning rate rises over 100 steps and falls as a cosine. Every
tenth drive is used for validation (with fewer than ten, the last fifth of each); the weights of the
smallest validation error are kept. With one thread and one seed the result is reproducible to the
bit, interrupted or not.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from estimators.networks.inputs import MIRROR_SIGNS, NetworkInputs
from road_envs.core.extras import optional_import

_LOSS_MAX = 4.0
_WARM_UP_STEPS = 100
_FINAL_RATE_SHARE = 0.02  # final learning rate over the highest
_N_VALIDATIONS = 20  # number of evaluations of the validation error
_PATIENCE = 6  # evaluations without improvement after which training stops
_VALIDATION_INTERVAL = 10  # one drive in so many is used for validation
# Weight of the likelihood in the loss; it affects only the standard deviations
_LIKELIHOOD_WEIGHT = 0.1
LOG_STD_RANGE = (-6.0, 3.0)  # range of the logarithms of standard deviations, in levels


class TrainingSequence(NamedTuple):
    """Network inputs of a drive, and the residual (2, M) to be predicted, in levels; of its
    stations those from `start` up to `stop` are used.
    """

    inputs: NetworkInputs
    residual: np.ndarray
    start: int
    stop: int

    def crop(self, at: int, size: int, context: Any, flip: bool = False) -> tuple[np.ndarray, ...]:
        """Return inputs, conditions and residual of `size` stations, mirrored if `flip`."""
        read = slice(at, at + context.behind + size + context.ahead)
        x, conditions = self.inputs.x[:, read], self.inputs.conditions
        conditions = conditions if conditions.shape[1] == 1 else conditions[:, read]
        residual = self.residual[:, at : at + size]
        if flip:
            x, residual = x * MIRROR_SIGNS, residual * MIRROR_SIGNS[6:8]
        return x, conditions, residual


class TrainerConfig(NamedTuple):
    steps: int
    batch: int = 32
    crop_length: int = 160  # [stations]
    learning_rate: float = 3e-3
    weight_decay: float = 1e-3


def train_network(
    network: Any,
    sequences: Sequence[TrainingSequence],
    config: TrainerConfig,
    seed: int,
    progress: Callable[[str, float], None] = lambda text, share: None,
    checkpoint: Any = None,
) -> tuple[float, list[TrainingSequence]]:
    """Train a torch `network` in place; return its validation error and the validation parts."""
    training, validation = _split_validation(sequences)
    size = min(config.crop_length, *(part.stop - part.start for part in [*training, *validation]))
    state = _Training(network, config)
    begin = state.restore(checkpoint.load() if checkpoint else None)
    every = max(1, config.steps // _N_VALIDATIONS)
    with single_thread():
        for step in range(begin, config.steps + 1):
            if step % every == 0 or step == config.steps:
                error = _validation_error(network, validation, size)
                if error < state.best_error:
                    state.best = get_weights(network)
                    state.best_error, state.best_step = error, step
                if checkpoint:
                    checkpoint.save(state.to_arrays(step))
                progress(f"validation error {state.best_error:.4f}", step / config.steps)
                if step - state.best_step > _PATIENCE * every:
                    break
            if step < config.steps:
                # a generator per step: a resumed training draws the same batches
                rng = np.random.default_rng([seed, step])
                state.take_step(training, size, rng, step)
    set_weights(network, state.best)
    return state.best_error, validation


def _split_validation(
    sequences: Sequence[TrainingSequence],
) -> tuple[list[TrainingSequence], list[TrainingSequence]]:
    whole = list(sequences)
    if len(whole) >= _VALIDATION_INTERVAL:
        validation = whole[_VALIDATION_INTERVAL - 1 :: _VALIDATION_INTERVAL]
        del whole[_VALIDATION_INTERVAL - 1 :: _VALIDATION_INTERVAL]
        return whole, validation
    cut = [each._replace(stop=each.stop - each.stop // 5) for each in whole]
    return cut, [each._replace(start=each.stop - each.stop // 5) for each in whole]


def _validation_error(network: Any, parts: Sequence[TrainingSequence], size: int) -> float:
    torch = require_torch()
    total, count = 0.0, 0
    with torch.no_grad():
        for part in parts:
            starts = range(part.start, part.stop - size + 1, size)
            x, c, residual = _to_batch([part.crop(at, size, network) for at in starts])
            squared_error = (network(x, c)[:, :2] - residual).square().mean(dim=(1, 2))
            total += float(squared_error.clamp(max=_LOSS_MAX).sum())
            count += len(starts)
    return total / count


def _to_batch(crops: Sequence[tuple[np.ndarray, ...]]) -> tuple[Any, ...]:
    torch = require_torch()
    return tuple(torch.from_numpy(np.stack(group)) for group in zip(*crops, strict=True))


class _Training:
    """Network, optimiser and best weights so far, convertible to and from arrays."""

    def __init__(self, network: Any, config: TrainerConfig):
        rates = {"lr": config.learning_rate, "weight_decay": config.weight_decay}
        self.optimiser = require_torch().optim.AdamW(network.parameters(), **rates)
        self.network, self.config = network, config
        self.best: dict[str, np.ndarray] = {}
        self.best_error, self.best_step = float("inf"), 0

    def take_step(
        self, training: Sequence[TrainingSequence], size: int, rng: np.random.Generator, step: int
    ) -> None:
        torch, config = require_torch(), self.config
        crops = []
        for k in rng.integers(len(training), size=config.batch):
            part = training[k]
            at = int(rng.integers(part.start, part.stop - size + 1))
            crops.append(part.crop(at, size, self.network, bool(rng.integers(2))))
        x, c, residual = _to_batch(crops)
        output = self.network(x, c)
        error, log_std = output[:, :2] - residual, output[:, 2:].clamp(*LOG_STD_RANGE)
        likelihood = 0.5 * error.detach().square() * torch.exp(-2.0 * log_std) + log_std
        squared_error = error.square().mean(dim=(1, 2)).clamp(max=_LOSS_MAX)
        loss = squared_error.mean() + _LIKELIHOOD_WEIGHT * likelihood.mean()
        for group in self.optimiser.param_groups:
            group["lr"] = config.learning_rate * _learning_rate_factor(step, config.steps)
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()

    def to_arrays(self, step: int) -> dict[str, np.ndarray]:
        arrays = {f"now.{k}": x for k, x in get_weights(self.network).items()}
        arrays |= {f"best.{k}": x for k, x in self.best.items()}
        for k, moments in self.optimiser.state_dict()["state"].items():
            arrays |= {f"moments.{k}.{name}": x.numpy().copy() for name, x in moments.items()}
        return arrays | {"about": np.array([step, self.best_step, self.best_error])}

    def restore(self, arrays: Mapping[str, np.ndarray] | None) -> int:
        """Load the result of `to_arrays`; return the step to continue with."""
        torch = require_torch()
        if arrays is None:
            return 0
        step, best_step, self.best_error = arrays["about"].tolist()
        self.best_step = int(best_step)
        self.best = {k.removeprefix("best."): x for k, x in arrays.items() if k.startswith("best.")}
        set_weights(self.network, {k[4:]: x for k, x in arrays.items() if k.startswith("now.")})
        current = self.optimiser.state_dict()
        moments: dict[int, dict[str, Any]] = {}
        for key, x in arrays.items():
            if key.startswith("moments."):
                _, k, name = key.split(".")
                moments.setdefault(int(k), {})[name] = torch.from_numpy(np.array(x))
        self.optimiser.load_state_dict({**current, "state": moments})
        return int(step)


def get_weights(network: Any) -> dict[str, np.ndarray]:
    return {name: x.detach().numpy().copy() for name, x in network.state_dict().items()}


def set_weights(network: Any, weights: Mapping[str, np.ndarray]) -> None:
    torch = require_torch()
    network.load_state_dict(
        {name: torch.from_numpy(np.array(x, dtype=np.float32)) for name, x in weights.items()}
    )


def require_torch() -> Any:
    """Return the module torch, which is loaded where it is used. Raises MissingExtraError."""
    with optional_import("a neural network"):
        import torch
    return torch


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Run torch on one thread, so that sums have the same order on every machine."""
    torch = require_torch()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _learning_rate_factor(step: int, steps: int) -> float:
    cosine = 0.5 * (1.0 + np.cos(np.pi * step / steps))
    falling = _FINAL_RATE_SHARE + (1.0 - _FINAL_RATE_SHARE) * cosine
    return float(min(1.0, (step + 1) / _WARM_UP_STEPS) * falling)
