"""Linear window over distance: a height is a weighted sum of the accelerations around its station.

Taught once for all speeds and modes (`bank.py`): taps that follow the speed and the states of the
struts, of the motions of the body. So it comes with the package.

Fitted to the drives of one speed and one mode, as the paper trains its network:

    z_k(s) = sum_j sum_i taps[k, j, i] a_j(s + i d)        |i d| <= reach

a_j are the three processed accelerations (RF, LR, RR) over the front axle's station. They hold
nothing above 25 Hz, hence nothing above 25 Hz / v over distance, so taps need stand no closer than
d = v / 50 Hz, rounded down to the grid. Beyond the record the car is taken to be at rest.

Those taps minimise the squared error on the training roads plus ridge x mean(a²) x sum(taps²).
Drives enter as normal equations, whatever their number, summed apart for the five fifths of every
drive; the ridge is the one whose taps from four fifths do best on the fifth (cross-validation).

Accelerometers do not see slow heights (acceleration falls with n² v²), and a window cannot hold
them: the target is the truth high-passed at 0.05 cycles/m (second-order Butterworth, both ways),
so of longer waves nothing is claimed. No constant is added: a mirrored drive gives the mirrored
road.

Known to fail: on large strokes, where the struts are far from linear; and what was fitted to one
speed and mode, at another. A window of 3 m instead of 12 m makes the error 1.3 to 2 times as large,
since it holds too little of the body's motion and of the rear axle's passage.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import ClassVar, NamedTuple, Self

import numpy as np
from scipy import signal
from scipy.linalg import cho_solve
from threadpoolctl import threadpool_limits

from estimators.api import arrays, copy_with, fitted
from estimators.common.spatial_signals import N_HIGH_PASS, course, finer, wheel_paths
from estimators.linear.fir_bank import Bank, fitted_bank, shape_of
from estimators.networks.training_data import BEHIND, MARGIN, SLOW, Material, limits, material
from estimators.preprocessing import F_C, accelerations, heights, mended
from estimators.pretrained_weights import shipped
from road_envs.config import STRICT
from road_envs.data.record import GRID, SENSORS, Estimate, Profile, Record, grid
from road_envs.vehicle.parameters import VehicleParameters

REACH = 12.0
"""Of the window that comes with the package, about, and of others unless they say so [m]."""

FOLDS = 5
RIDGES = 10.0 ** np.arange(-6, 1)
"""Candidates, relative to the mean square of the accelerations."""


class Taps(NamedTuple):
    """`taps` (2, 3, T) [s²] for wheel path, sensor and offset, `stride` grid steps apart; `speed`
    [m/s] of the training drives and the chosen `ridge`.
    """

    taps: np.ndarray
    stride: int
    speed: float
    ridge: float


class Sums(NamedTuple):
    """Sums over samples of X'X (p, p), X'Z (p, 2) and Z'Z (); they add, part by part."""

    XX: np.ndarray
    XZ: np.ndarray
    ZZ: np.ndarray

    @classmethod
    def none(cls, size: int) -> "Sums":
        """The sums of no samples, for `size` regressors."""
        return cls(np.zeros((size, size)), np.zeros((size, 2)), np.zeros(()))

    @classmethod
    def of(cls, X: np.ndarray, Z: np.ndarray) -> "Sums":
        """The sums of regressors `X` (N, p) and targets `Z` (N, 2)."""
        return cls(X.T @ X, X.T @ Z, np.vdot(Z, Z))

    def plus(self, other: "Sums", sign: float = 1.0) -> "Sums":
        """These sums with another's added, or taken away with `sign` -1."""
        return Sums(*(mine + sign * its for mine, its in zip(self, other, strict=True)))

    def solve(self, ridge: float) -> np.ndarray:
        """Coefficients (p, 2) with a `ridge` relative to the mean of the diagonal of XX."""
        size = len(self.XX)
        level = np.trace(self.XX) / size or 1.0  # a drive may have been level
        # NumPy's factor: SciPy's BLAS has threads of its own, which fight for the processor
        factor = np.linalg.cholesky(self.XX + ridge * level * np.eye(size))
        return cho_solve((factor, True), self.XZ)

    def squared_error(self, coefficients: np.ndarray) -> float:
        """Sum of squared errors that `coefficients` (p, 2) make on these samples."""
        fit = 2.0 * self.XZ - self.XX @ coefficients
        return float(self.ZZ - np.vdot(coefficients, fit))


@dataclass(frozen=True, kw_only=True)
class FirRidge:
    """The window that comes with the package; or one of `reach` [m] to either side of the station,
    once it is fitted. With `shipped` false it has to be.
    """

    __pydantic_config__ = STRICT
    causal: ClassVar[bool] = False
    name: ClassVar[str] = "fir_ridge"
    fits_a_case: ClassVar[bool] = True

    reach: float = REACH
    shipped: bool = True
    learnt: Taps | Bank | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        if not 0 < self.reach <= 100:
            raise ValueError(f"reach must be within (0, 100] m, got {self.reach}")

    @threadpool_limits.wrap(limits=1, user_api="blas")  # small products: as in the LM training
    def fit(
        self,
        records: Sequence[Record],
        truths: Sequence[Profile],
        car: VehicleParameters,
        seed: int,
    ) -> Self:
        """Taps for the speed and mode of these drives; nothing is drawn, `seed` plays no part."""
        speed = float(np.mean([record.v.mean() for record in records]))
        stride = max(1, int(speed / (2.0 * F_C) / GRID))
        half = self._half(stride)
        folds = [Sums.none(len(SENSORS) * (2 * half + 1))] * FOLDS
        for record, truth in zip(records, truths, strict=True):
            X = windows(mended(record)[0], stride, half)
            Z = high_passed(truth, grid(record.length))[:, ::stride].T
            parts = zip(np.array_split(X, FOLDS), np.array_split(Z, FOLDS), strict=True)
            folds = [sums.plus(Sums.of(*part)) for sums, part in zip(folds, parts, strict=True)]
        ridge, coefficients = cross_validated(folds)
        taps = coefficients.T.reshape(2, len(SENSORS), 2 * half + 1)
        return copy_with(self, learnt=Taps(taps, stride, speed, ridge))

    def material(self, record: Record, truth: Profile) -> Material:
        """What is kept of a drive to be taught by. Raises RecordError."""
        return material(record, truth, self.causal)

    def learn(
        self,
        drives: Sequence[Material],
        car: VehicleParameters,
        seed: int,
        progress: Callable[[str, float], None] = lambda text, share: None,
        keeper: object = None,
    ) -> Self:
        """Taps for all speeds and modes; nothing is drawn, and it takes less than a minute."""
        progress("fitting linear windows", 0.0)
        courses, targets = zip(*drives, strict=True)
        return copy_with(self, learnt=fitted_bank(courses, targets, BEHIND, BEHIND))

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """The weighted sums. Raises RecordError."""
        record, notes = mended(record)
        learnt, stations = self._learnt(), grid(record.length)
        if isinstance(learnt, Bank):
            seen = course(record, MARGIN)
            z = wheel_paths(finer(learnt(seen), stations.size))
            return Estimate(stations, z, notes=(*notes, SLOW, *limits(seen)))
        taps, stride, speed, _ = learnt
        half = taps.shape[2] // 2
        a = accelerations(record, half * stride)
        z = np.zeros((2, stations.size))
        for i in range(taps.shape[2]):
            z += taps[:, :, i] @ a[:, i * stride : i * stride + stations.size]
        return Estimate(stations, z, notes=(*notes, SLOW, *_another_speed(speed, record)))

    def weights(self) -> dict[str, np.ndarray]:
        """`bank` (16, knots, 3, T); or fitted to one speed, `taps` (2, 3, T), and as scalars
        `stride`, `speed`, `ridge`. Raises NotFittedError.
        """
        learnt = self._learnt()
        if isinstance(learnt, Bank):
            return {"bank": learnt.taps}
        return {name: np.asarray(x) for name, x in learnt._asdict().items()}

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """A copy with these weights. Raises ValueError."""
        if "bank" in weights:
            (taps,) = arrays(weights, {"bank": shape_of(BEHIND, BEHIND)})
            return copy_with(self, learnt=Bank(taps.astype(np.float16), BEHIND))
        shapes = {"taps": (2, len(SENSORS), None), "stride": (), "speed": (), "ridge": ()}
        taps, stride, speed, ridge = arrays(weights, shapes)
        if stride < 1 or taps.shape[2] != 2 * self._half(int(stride)) + 1:
            raise ValueError(f"{taps.shape[2]} taps do not make a window of {self.reach} m")
        return copy_with(self, learnt=Taps(taps, int(stride), float(speed), float(ridge)))

    def _learnt(self) -> Taps | Bank:
        """What was learnt, or what comes with the package. Raises NotFittedError."""
        if self.learnt is not None:
            return self.learnt
        weights = shipped(self.name) if self.shipped and self.reach == REACH else None
        return self.with_weights(fitted(weights, self))._learnt()

    def _half(self, stride: int) -> int:
        """Taps on one side of the station."""
        return int(self.reach / (stride * GRID))


def windows(record: Record, stride: int, half: int) -> np.ndarray:
    """What the taps see (N, 3 (2 half + 1)) [m/s²], at every `stride`-th station."""
    a = accelerations(record, half * stride)
    seen = np.lib.stride_tricks.sliding_window_view(a, 2 * half * stride + 1, axis=1)
    return np.concatenate(list(seen[:, ::stride, ::stride]), axis=1)


def high_passed(truth: Profile, stations: np.ndarray) -> np.ndarray:
    """Heights (2, M) [m] at `stations`, without waves longer than 20 m."""
    sos = signal.butter(2, N_HIGH_PASS, "high", fs=1.0 / GRID, output="sos")
    padding = min(int(1.0 / (N_HIGH_PASS * GRID)), stations.size - 1)
    return signal.sosfiltfilt(sos, heights(truth, stations), axis=1, padlen=padding)


def cross_validated(folds: Sequence[Sums]) -> tuple[float, np.ndarray]:
    """The ridge with the least error on folds left out, and the coefficients (p, 2) of all."""
    total = reduce(Sums.plus, folds)
    errors = np.zeros(RIDGES.size)
    for fold in folds:
        others = total.plus(fold, -1.0)
        errors += [fold.squared_error(others.solve(ridge)) for ridge in RIDGES]
    best = float(RIDGES[np.argmin(errors)])
    return best, total.solve(best)


def _another_speed(speed: float, record: Record) -> tuple[str, ...]:
    driven = float(record.v.mean())
    if abs(driven - speed) <= 0.1 * speed:
        return ()
    return (f"fitted at {speed:.1f} m/s, driven at {driven:.1f} m/s",)
