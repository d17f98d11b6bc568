"""Levenberg-Marquardt training of a small network, with the rules of MATLAB's `trainlm`.

One tan-sigmoid hidden layer (`tansig` is tanh), linear outputs, samples in columns:

    y = W2 tanh(W1 x + b1) + b2              x (R, N), y (K, N)
    (J'J + mu I) step = J'e                  e = t - y,  J = dy / d(weights)

J'J and J'e are means over all K N errors, so the gradient of the mean squared error is -2 J'e. A
step that lowers the training error is accepted and mu decreases; otherwise mu increases and the
step is repeated. Training stops at the epoch limit, the error goal, a small gradient, a large mu,
or after `max_fail` epochs without a smaller validation error; the weights of the smallest
validation error are returned. Errors refer to the mapped targets (`mapminmax`), so both outputs
have equal weight: `trainlm` with its `mse` normalisation set to 'standard'.

J is never formed. All outputs share the hidden derivatives: with d = 1 - tanh^2 and the outer
products D = x d, output k has the rows D w_k, hence J'J of the hidden layer is
(D D') * (W2' W2), one product for all outputs.

Sources: K. Levenberg, Quart. Appl. Math. 2 (1944) 164; D. W. Marquardt, J. SIAM 11 (1963) 431;
M. T. Hagan and M. B. Menhaj, IEEE Trans. Neural Networks 5 (1994) 989, doi 10.1109/72.329697;
D. Nguyen and B. Widrow, IJCNN 1990, vol. 3, 21, doi 10.1109/IJCNN.1990.137819; MATLAB reference
pages of trainlm, initnw, mapminmax, dividerand, divideblock and mse.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NamedTuple, Self, get_args

import numpy as np
from numpy.random import Generator
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.blas import dsyrk

from estimators.common.blas import single_blas_thread

CHUNK = 512  # samples per block of derivatives: 1 MB for the 3-50-2 network, which fits the cache
_MU_FLOOR = 1e-20  # lower limit of mu, so that a failing step needs few increases to succeed
_ACTIVE_RANGE = 2.0  # active range of tanh, net inputs of -2 to 2, as MATLAB's tansig('active')

_StopReason = Literal["epochs", "goal", "gradient", "mu", "validation"]
_STOP_REASONS: tuple[_StopReason, ...] = get_args(_StopReason)
CURVES = ("train", "validation", "test", "mu", "gradient")
HISTORY_SHAPES: dict[str, tuple[int | None, ...]] = {"curves": (len(CURVES), None), "stop": (2,)}


@dataclass(frozen=True)
class TwoLayerNetwork:
    """Weights: `hidden` (R + 1, S) is W1' above b1', `output` (K, S + 1) is W2 beside b2."""

    hidden: np.ndarray
    output: np.ndarray

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return outputs (K, N) for inputs `x` (R, N)."""
        return self.output @ _append_ones(np.tanh(self.hidden.T @ _append_ones(x)))

    def add_step(self, step: np.ndarray) -> "TwoLayerNetwork":
        """Return the network with a `step` (P,) added to its weights, hidden layer first."""
        parts, layers = np.split(step, [self.hidden.size]), (self.hidden, self.output)
        moved = (x + part.reshape(x.shape) for x, part in zip(layers, parts, strict=True))
        return TwoLayerNetwork(*moved)


@dataclass(frozen=True)
class Scaling:
    """Mapping of rows onto [-1, 1] (`mapminmax`); a constant row is left as it is."""

    low: np.ndarray
    high: np.ndarray

    @classmethod
    def fit(cls, x: np.ndarray) -> Self:
        """Return the scaling that maps the range of each row of `x` (k, N) onto [-1, 1]."""
        return cls(x.min(axis=1), x.max(axis=1))

    def apply(self, x: np.ndarray) -> np.ndarray:
        """Return `x` (k, N) in mapped units; values outside the range exceed 1."""
        centre, half = self._centre_and_half()
        return (x - centre) / half

    def reverse(self, y: np.ndarray) -> np.ndarray:
        """Return `y` (k, N) in the original units."""
        centre, half = self._centre_and_half()
        return y * half + centre

    def _centre_and_half(self) -> tuple[np.ndarray, np.ndarray]:
        constant = self.high == self.low
        centre = np.where(constant, 0.0, 0.5 * (self.high + self.low))
        half = np.where(constant, 1.0, 0.5 * (self.high - self.low))
        return centre[:, None], half[:, None]


class Split(NamedTuple):
    """Indices of the samples for training, validation and test."""

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray

    @classmethod
    def divide(cls, size: int, method: Literal["random", "block"], rng: Generator) -> Self:
        """Split `size` samples into 70, 15 and 15 %, at random (`dividerand`, which leaks on a time
        series, since neighbours are alike) or in consecutive blocks (`divideblock`).
        """
        held_out = round(0.15 * size)
        train = size - 2 * held_out
        order = rng.permutation(size) if method == "random" else np.arange(size)
        return cls(*(np.sort(part) for part in np.split(order, [train, train + held_out])))


@dataclass(frozen=True, kw_only=True)
class TrainlmOptions:
    """Parameters of `trainlm`, with its defaults."""

    max_epochs: int = 1000
    goal: float = 0.0
    min_grad: float = 1e-7
    max_fail: int = 6
    mu: float = 1e-3
    mu_decrease: float = 0.1
    mu_increase: float = 10.0
    mu_max: float = 1e10


@dataclass(frozen=True)
class LmResult:
    """A trained `network`, the stop reason, and the history, one value per epoch from 0: mean
    squared errors `train`, `validation`, `test` in mapped units, NaN for an empty set; `mu` with
    which the epoch starts; norm `gradient` of the training error's gradient.
    """

    network: TwoLayerNetwork
    stop: _StopReason
    best_epoch: int
    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray
    mu: np.ndarray
    gradient: np.ndarray

    @property
    def epochs(self) -> int:
        return self.train.size - 1

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return all but the network: `curves` (5, epochs + 1) with -1 for NaN, and `stop`, the
        index of the reason in _STOP_REASONS and the best epoch.
        """
        curves = np.array([getattr(self, name) for name in CURVES])
        curves[np.isnan(curves)] = -1.0
        stop = np.array([_STOP_REASONS.index(self.stop), self.best_epoch])
        return {"curves": curves, "stop": stop}

    @classmethod
    def from_arrays(cls, network: TwoLayerNetwork, curves: np.ndarray, stop: np.ndarray) -> Self:
        """Return the result of this `network` and the arrays of `to_arrays`. Raises ValueError."""
        reason, best_epoch = (int(x) for x in stop)
        if not 0 <= reason < len(_STOP_REASONS):
            last = len(_STOP_REASONS) - 1
            raise ValueError(f"stop: the reason must be an index from 0 to {last}, got {reason}")
        history = np.where(curves < 0.0, np.nan, curves)
        return cls(network, _STOP_REASONS[reason], best_epoch, *history)


class _Evaluation(NamedTuple):
    """A network at N samples: its `inputs` (R + 1, N) and hidden `units` (S + 1, N), each with ones
    behind, the targets `t` (K, N) and its errors `e` (K, N).
    """

    network: TwoLayerNetwork
    inputs: np.ndarray
    t: np.ndarray
    units: np.ndarray
    e: np.ndarray

    @property
    def mse(self) -> float:
        """Mean squared error over all outputs and samples; NaN without samples."""
        return float(np.vdot(self.e, self.e)) / self.e.size if self.e.size else float("nan")


def nguyen_widrow(inputs: int, hidden: int, outputs: int, rng: Generator) -> TwoLayerNetwork:
    """Draw initial weights whose active regions cover inputs in [-1, 1], as `initnw`. Each hidden
    neuron's weight vector has a random direction and the length 2 x 0.7 S^(1/R), where the 2
    extends Nguyen and Widrow's unit range to the active range of tanh; the biases are evenly
    spaced. The output layer is uniform in [-1, 1], as a linear layer has no active region.
    """
    magnitude = _ACTIVE_RANGE * 0.7 * hidden ** (1.0 / inputs)
    W1 = rng.uniform(-1.0, 1.0, (inputs, hidden))
    W1 *= magnitude / np.linalg.norm(W1, axis=0)
    spread = np.linspace(-1.0, 1.0, hidden) if hidden > 1 else np.zeros(1)
    b1 = magnitude * spread * np.sign(W1[0])
    return TwoLayerNetwork(np.vstack([W1, b1]), rng.uniform(-1.0, 1.0, (outputs, hidden + 1)))


@single_blas_thread()
def train(
    network: TwoLayerNetwork,
    x: np.ndarray,
    t: np.ndarray,
    split: Split,
    options: TrainlmOptions | None = None,
) -> LmResult:
    """Train from `network` on mapped inputs `x` (R, N) and targets `t` (K, N), on one thread:
    products of this size do not gain from more, slow down tenfold when another job occupies the
    other core, and are summed in the same order on every machine.
    """
    options = options or TrainlmOptions()
    training, validation, test = ((_append_ones(x[:, part]), t[:, part]) for part in split)
    at = _evaluate(network, *training)
    best, best_error, best_epoch = network, np.inf, 0
    mu, stop = options.mu, None
    history: list[tuple[float, ...]] = []
    while stop is None:
        epoch, (JJ, Je) = len(history), _normal_equations(at)
        gradient = 2.0 * float(np.linalg.norm(Je))
        errors = [at.mse, *(_evaluate(at.network, *part).mse for part in (validation, test))]
        history.append((*errors, mu, gradient))
        if errors[1] < best_error or not split.validation.size:
            best, best_error, best_epoch = at.network, errors[1], epoch
        reasons: dict[_StopReason, bool] = {
            "goal": errors[0] <= options.goal,
            "epochs": epoch >= options.max_epochs,
            "gradient": gradient <= options.min_grad,
            "mu": mu > options.mu_max,
            "validation": epoch - best_epoch >= options.max_fail,
        }
        stop = next((name for name, holds in reasons.items() if holds), None)
        if stop is None:
            at, mu = _take_step(at, JJ, Je, mu, options)
    return LmResult(best, stop, best_epoch, *np.array(history).T)


def _take_step(
    at: _Evaluation, JJ: np.ndarray, Je: np.ndarray, mu: float, options: TrainlmOptions
) -> tuple[_Evaluation, float]:
    """Return the network after the first step that lowers the error, or `at`, and the next mu."""
    while mu <= options.mu_max:
        damped = JJ.copy(order="F")  # as LAPACK takes it
        damped[np.diag_indices_from(damped)] += mu
        with suppress(np.linalg.LinAlgError):  # singular: a failed step
            factor = cho_factor(damped, lower=True, overwrite_a=True, check_finite=False)
            step = cho_solve(factor, Je, check_finite=False)
            trial = _evaluate(at.network.add_step(step), at.inputs, at.t)
            if trial.mse < at.mse:
                return trial, max(mu * options.mu_decrease, _MU_FLOOR)
        mu *= options.mu_increase
    return at, mu


def _evaluate(network: TwoLayerNetwork, inputs: np.ndarray, t: np.ndarray) -> _Evaluation:
    """Return a network at samples with `inputs` (R + 1, N), ones last, and targets `t` (K, N)."""
    hidden, output = network.hidden, network.output
    units, e = np.empty((output.shape[1], t.shape[1])), np.empty_like(t)
    units[-1] = 1.0
    for part in _chunks(t.shape[1]):
        np.tanh(hidden.T @ inputs[:, part], out=units[:-1, part])
        np.subtract(t[:, part], output @ units[:, part], out=e[:, part])
    return _Evaluation(network, inputs, t, units, e)


def _normal_equations(at: _Evaluation) -> tuple[np.ndarray, np.ndarray]:
    """Return J'J (P, P), the lower triangle alone, and J'e (P,): means over all errors."""
    (hidden, output), (K, N) = (at.network.hidden, at.network.output), at.e.shape
    P, width = hidden.size, output.shape[1]
    # hidden derivatives, activations and errors: their products with each other are all that counts
    rows = np.empty((P + width + K, min(CHUNK, N)))
    products = np.zeros((len(rows), len(rows)), order="F")
    for part in _chunks(N):
        inputs, here = at.inputs[:, part], rows[:, : at.inputs[:, part].shape[1]]
        D, units, e = np.split(here, [P, P + width])
        units[:], e[:] = at.units[:, part], at.e[:, part]
        np.multiply(inputs[:, None], 1.0 - units[:-1] ** 2, out=D.reshape(*hidden.shape, -1))
        products = dsyrk(1.0, here.T, 1.0, products, trans=True, lower=True, overwrite_c=True)
    products /= at.e.size
    # an error falls by w_s D[r, s] with hidden weight (r, s), w_s the weight of unit s, and by unit
    # s with an output weight: J'e follows from the rows of the errors, hidden weights summed over
    # the outputs, each output's own weights behind
    middle, of_e, W2 = slice(P, P + width), products[P + width :], output[:, :-1]
    Je = np.sum(of_e[:, :P] * np.tile(W2, len(hidden)), axis=0), of_e[:, middle].ravel()
    # hidden against hidden: D'D, each pair of units weighed by its product of output weights, which
    # tiles over the inputs. An output's own weights meet the hidden ones through its weights w,
    # themselves as units'units, and those of other outputs not at all
    JJ = np.zeros((P + output.size,) * 2, order="F")
    JJ[:P, :P] = products[:P, :P] * np.tile(W2.T @ W2, (len(hidden), len(hidden)))
    for k, w in enumerate(W2):
        own = slice(P + k * width, P + (k + 1) * width)
        JJ[own, :P] = products[middle, :P] * np.tile(w, len(hidden))
        JJ[own, own] = products[middle, middle]
    return JJ, np.concatenate(Je)


def _chunks(size: int) -> Iterator[slice]:
    return (slice(start, start + CHUNK) for start in range(0, size, CHUNK))


def _append_ones(x: np.ndarray) -> np.ndarray:
    """`x` (R, N) above a row of ones, the input of the biases."""
    return np.vstack([x, np.ones(x.shape[1])])
