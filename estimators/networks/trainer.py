"""How a sequence network learns: stretches of drives, AdamW, early stopping on roads held out.

Per stretch the loss is the mean square of what is missing to the truth, in units of the drive's
level and limited to LOSS_MAX, so that a drive of which nothing can be made rules no step; the
standard deviations learn by the Gaussian likelihood of those errors, beside it. The rate rises over
100 steps and falls as a cosine. Every tenth drive is held out (of fewer than ten drives the last
fifth of each); the weights of the least error there are kept.

One thread and one seed make one network, to the bit, whether or not the teaching was interrupted:
each step draws from a generator of its own.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from estimators.networks.inputs import FLIP, Inputs

LOSS_MAX = 4.0
WARM_UP = 100
RATE_END = 0.02
"""Rate at the end, over the highest."""

CHECKS = 20
"""How often the error on the held-out drives is taken."""

PATIENCE = 6
"""Checks without a better one after which teaching ends."""

HELD_OUT = 10
"""Every so many drives one is held out."""

SPREAD_WEIGHT = 0.1
"""Of the likelihood in the loss; it moves nothing but the standard deviations."""

STD_LOG = (-6.0, 3.0)
"""Logarithms of standard deviations, in levels, stay inside."""


class Lesson(NamedTuple):
    """What is read of a drive, and what is missing (2, M) to the truth, in levels."""

    inputs: Inputs
    missing: np.ndarray


class Plan(NamedTuple):
    """How long, and by how much at a time."""

    steps: int
    batch: int = 32
    crop: int = 160  # stations of a stretch
    rate: float = 3e-3
    decay: float = 1e-3


class Keeper(Protocol):
    """Where an unfinished teaching is kept."""

    def load(self) -> Mapping[str, np.ndarray] | None: ...

    def save(self, state: Mapping[str, np.ndarray]) -> None: ...


class Stretch(NamedTuple):
    """The stations from `start` up to `stop` of a lesson."""

    lesson: Lesson
    start: int
    stop: int

    def cut(self, at: int, size: int, context: Any, flip: bool) -> tuple[np.ndarray, ...]:
        """Inputs, conditions and what is missing of `size` stations from `at` on."""
        x, conditions = self.lesson.inputs.x, self.lesson.inputs.conditions
        read = slice(at, at + context.behind + size + context.ahead)
        x = x[:, read]
        conditions = conditions if conditions.shape[1] == 1 else conditions[:, read]
        missing = self.lesson.missing[:, at : at + size]
        return (x * FLIP, conditions, missing * FLIP[6:8]) if flip else (x, conditions, missing)


def teach(
    network: Any,
    lessons: Sequence[Lesson],
    plan: Plan,
    seed: int,
    progress: Callable[[str, float], None] = lambda text, share: None,
    keeper: Keeper | None = None,
) -> float:
    """Teach a torch `network` in place; returns its error on the held-out stretches."""
    import torch

    taught, held_out = divided(lessons)
    size = min(plan.crop, *(part.stop - part.start for part in [*taught, *held_out]))
    optimiser = torch.optim.AdamW(network.parameters(), lr=plan.rate, weight_decay=plan.decay)
    state = State(network, optimiser)
    begin = state.restore(keeper.load() if keeper else None)
    every = max(1, plan.steps // CHECKS)
    with one_thread():
        for step in range(begin, plan.steps + 1):
            if step % every == 0 or step == plan.steps:
                state.check(held_out_error(network, held_out, size), step)
                if keeper:
                    keeper.save(state.arrays(step))
                progress(f"error on held-out roads {state.best_error:.4f}", step / plan.steps)
                if step - state.best_step > PATIENCE * every:
                    break
            if step < plan.steps:
                rng = np.random.default_rng([seed, step])
                _learn(network, optimiser, taught, plan, size, rng, step)
    state.take_best()
    return state.best_error


def divided(lessons: Sequence[Lesson]) -> tuple[list[Stretch], list[Stretch]]:
    """What is taught and what is held out."""
    taught: list[Stretch] = []
    held_out: list[Stretch] = []
    for k, lesson in enumerate(lessons):
        M = lesson.missing.shape[1]
        if len(lessons) >= HELD_OUT:
            kept = k % HELD_OUT == HELD_OUT - 1
            (held_out if kept else taught).append(Stretch(lesson, 0, M))
        else:
            taught.append(Stretch(lesson, 0, M - M // 5))
            held_out.append(Stretch(lesson, M - M // 5, M))
    return taught, held_out


def held_out_error(network: Any, stretches: Sequence[Stretch], size: int) -> float:
    """Mean of the limited loss over every held-out stretch, cut into pieces of `size`."""
    import torch

    total, count = 0.0, 0
    with torch.no_grad():
        for part in stretches:
            starts = range(part.start, part.stop - size + 1, size)
            cuts = [part.cut(at, size, network, False) for at in starts]
            x, c, missing = (torch.from_numpy(np.stack(group)) for group in zip(*cuts, strict=True))
            square = (network(x, c)[:, :2] - missing).square().mean(dim=(1, 2))
            total += float(square.clamp(max=LOSS_MAX).sum())
            count += len(cuts)
    return total / count


class State:
    """Network, optimiser and the best weights so far, as plain arrays and back."""

    def __init__(self, network: Any, optimiser: Any):
        self.network, self.optimiser = network, optimiser
        self.best: dict[str, np.ndarray] = {}
        self.best_error, self.best_step = float("inf"), 0

    def check(self, error: float, step: int) -> None:
        """Keep the weights if they are the best so far."""
        if error < self.best_error:
            self.best, self.best_error, self.best_step = numbers(self.network), error, step

    def take_best(self) -> None:
        """Put the best weights into the network."""
        put(self.network, self.best)

    def arrays(self, step: int) -> dict[str, np.ndarray]:
        """All that it takes to go on at `step`."""
        found = {f"now.{k}": x for k, x in numbers(self.network).items()}
        found |= {f"best.{k}": x for k, x in self.best.items()}
        for k, moments in self.optimiser.state_dict()["state"].items():
            found |= {f"moments.{k}.{name}": x.numpy().copy() for name, x in moments.items()}
        about = np.array([step, self.best_step, self.best_error])
        return found | {"about": about}

    def restore(self, kept: Mapping[str, np.ndarray] | None) -> int:
        """Go back to what `arrays` gave; returns the step to go on with."""
        import torch

        if kept is None:
            return 0
        step, best_step, self.best_error = kept["about"].tolist()
        self.best_step = int(best_step)
        self.best = {k.removeprefix("best."): x for k, x in kept.items() if k.startswith("best.")}
        put(self.network, {k[4:]: x for k, x in kept.items() if k.startswith("now.")})
        held = self.optimiser.state_dict()
        moments: dict[int, dict[str, Any]] = {}
        for key, x in kept.items():
            if key.startswith("moments."):
                _, k, name = key.split(".")
                moments.setdefault(int(k), {})[name] = torch.from_numpy(np.array(x))
        self.optimiser.load_state_dict({**held, "state": moments})
        return int(step)


def numbers(network: Any) -> dict[str, np.ndarray]:
    """The weights of a torch network by name, copied."""
    return {name: x.detach().numpy().copy() for name, x in network.state_dict().items()}


def put(network: Any, weights: Mapping[str, np.ndarray]) -> None:
    """Put weights by name into a torch network."""
    import torch

    network.load_state_dict(
        {name: torch.from_numpy(np.array(x, dtype=np.float32)) for name, x in weights.items()}
    )


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread, so that sums are added in one order everywhere."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _learn(
    network: Any,
    optimiser: Any,
    taught: Sequence[Stretch],
    plan: Plan,
    size: int,
    rng: np.random.Generator,
    step: int,
) -> None:
    """One step of the optimiser on a batch of stretches drawn by `rng`."""
    import torch

    cuts = []
    for k in rng.integers(len(taught), size=plan.batch):
        part = taught[k]
        at = int(rng.integers(part.start, part.stop - size + 1))
        cuts.append(part.cut(at, size, network, bool(rng.integers(2))))
    x, c, missing = (torch.from_numpy(np.stack(group)) for group in zip(*cuts, strict=True))
    answer = network(x, c)
    error, log_std = answer[:, :2] - missing, answer[:, 2:].clamp(*STD_LOG)
    likelihood = 0.5 * error.detach().square() * torch.exp(-2.0 * log_std) + log_std
    square = error.square().mean(dim=(1, 2)).clamp(max=LOSS_MAX)
    loss = square.mean() + SPREAD_WEIGHT * likelihood.mean()
    for group in optimiser.param_groups:
        group["lr"] = plan.rate * rate(step, plan.steps)
    optimiser.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    optimiser.step()


def rate(step: int, steps: int) -> float:
    """The rate at a step, over the highest."""
    falling = RATE_END + (1.0 - RATE_END) * 0.5 * (1.0 + np.cos(np.pi * step / steps))
    return float(min(1.0, (step + 1) / WARM_UP) * falling)
