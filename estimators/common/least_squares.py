"""Ridge regression from sums over samples, with the ridge chosen by cross-validation."""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve


class LeastSquaresSums(NamedTuple):
    """Sums over `n` samples: X'X (p, p), X'Z (p, m) and the squares of each target, ZZ (m,)."""

    XX: np.ndarray
    XZ: np.ndarray
    ZZ: np.ndarray
    n: int

    @classmethod
    def zeros(cls, size: int, targets: int = 2) -> "LeastSquaresSums":
        """Return empty sums for `size` regressors."""
        return cls(np.zeros((size, size)), np.zeros((size, targets)), np.zeros(targets), 0)

    @classmethod
    def from_samples(cls, X: np.ndarray, Z: np.ndarray) -> "LeastSquaresSums":
        """Return the sums of regressors `X` (N, p) and targets `Z` (N, m)."""
        return cls(X.T @ X, X.T @ Z, np.sum(Z**2, axis=0), len(X))

    def plus(self, other: "LeastSquaresSums", sign: int = 1) -> "LeastSquaresSums":
        """Return these sums plus `sign` times those of `other`."""
        XX, XZ, ZZ = (x + sign * y for x, y in zip(self[:3], other[:3], strict=True))
        return LeastSquaresSums(XX, XZ, ZZ, self.n + sign * other.n)

    def solve(self, ridge: float) -> np.ndarray:
        """Return coefficients (p, m); `ridge` is relative to the mean diagonal of XX."""
        if not np.isfinite(ridge):
            return np.zeros_like(self.XZ)
        size = len(self.XX)
        level = np.trace(self.XX) / size or 1.0  # a level drive has no signal
        # NumPy's factor: SciPy's BLAS has a thread pool of its own, which competes with NumPy's
        factor = np.linalg.cholesky(self.XX + ridge * level * np.eye(size))
        return cho_solve((factor, True), self.XZ)

    def squared_error(self, coefficients: np.ndarray) -> float:
        """Return the sum of squared errors of `coefficients` (p, 2) on these samples."""
        fit = 2.0 * self.XZ - self.XX @ coefficients
        return float(self.ZZ.sum() - np.vdot(coefficients, fit))


def cross_validate(
    folds: Sequence[LeastSquaresSums], ridges: np.ndarray
) -> tuple[float, np.ndarray, float]:
    """Return the best of `ridges`, its coefficients (p, m) on all folds and squared error."""
    total = reduce(LeastSquaresSums.plus, folds)
    errors = np.zeros(ridges.size)
    for fold in folds:
        others = total.plus(fold, -1)
        errors += [fold.squared_error(others.solve(ridge)) for ridge in ridges]
    best = int(np.argmin(errors))
    return float(ridges[best]), total.solve(ridges[best]), float(errors[best])
