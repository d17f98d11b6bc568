"""FIR bank over distance for all speeds and modes: taps depend on speed and strut states.

    m(s_i) = sum_j  f_j front(s_i+j) + r_j rear(s_i+j)          -behind <= j <= ahead
    q(s_i) = sum_j  c_j roll(s_i+j)

Taps are interpolated linearly between KNOTS, evenly spaced in the logarithm of the speed; each
combination of the four states (front and rear, spring and damper) has its own taps. All knots of a
combination are fitted jointly to drives at any speed, each drive scaled to unit level, by least
squares with the penalty

    mean square of the regressors x (ridge x sum(taps²) + smoothness x sum(difference of knots²))

The smoothness term regularises knots with few drives. A high-pass suppresses errors below
0.15 cycles/m: such waves are most of a road's height but lie outside the scored band. A combination
without a drive takes the taps of the one that differs in the fewest states.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from estimators.common.blas import single_blas_thread
from estimators.common.pretrained import SPEED_RANGE
from estimators.common.spatial_signals import (
    LEVEL_MIN,
    N_MOTIONS,
    SpatialSignals,
    keep_short_waves,
    motion_windows,
)

KNOTS = np.geomspace(*SPEED_RANGE, 9)  # speeds [m/s]; outside, the taps of the first or last hold
_N_STATE_COMBINATIONS = 16  # of spring and damper in front (bits 3 and 2), then at the rear
RIDGE = 1e-4
SMOOTHNESS = 1e-4
_MM = 1e-3  # unit of the heights [m]: taps are stored as float16 for heights in mm


class FirBank(NamedTuple):
    """`taps` (16, knots, 3, behind + 1 + ahead) [mm s²/m] of front, rear and roll; the last station
    used is `ahead` of the estimated one.
    """

    taps: np.ndarray
    ahead: int

    @staticmethod
    def shape(behind: int, ahead: int) -> tuple[int, ...]:
        """Return the shape of the taps."""
        return _N_STATE_COMBINATIONS, KNOTS.size, N_MOTIONS, behind + 1 + ahead

    @classmethod
    def fit(
        cls,
        all_signals: Sequence[SpatialSignals],
        targets: Sequence[np.ndarray],
        behind: int,
        ahead: int,
    ) -> "FirBank":
        """Fit the taps to drives with targets m and q (2, M) [m]. A drive counts for its mean speed
        and for the state combination that prevails in it.
        """
        groups: dict[int, list[tuple[SpatialSignals, np.ndarray]]] = {}
        for drive in zip(all_signals, targets, strict=True):
            groups.setdefault(int(drive[0].state @ [8, 4, 2, 1]), []).append(drive)
        taps = np.zeros(cls.shape(behind, ahead), dtype=np.float16)
        for combination, group in groups.items():
            sums = [_KnotNormalEquations.zeros(k * taps.shape[-1]) for k in (2, 1)]
            for signals, heights in group:
                front, rear, roll = motion_windows(signals, behind, ahead)
                z = keep_short_waves(heights)
                scale = 1.0 / (LEVEL_MIN + np.sqrt(np.mean(z**2)))
                centre_line = np.concatenate([front, rear], axis=1)
                for part, X, target in zip(sums, (centre_line, roll), z, strict=True):
                    part.add(scale * X, scale * target, signals.speed)
            solution = np.concatenate([part.solve() for part in sums], axis=1)
            taps[combination] = (solution / _MM).reshape(taps.shape[1:])
        for combination in set(range(_N_STATE_COMBINATIONS)) - groups.keys():
            nearest = min(groups, key=lambda other: ((combination ^ other).bit_count(), other))
            taps[combination] = taps[nearest]
        return cls(taps, ahead)

    @property
    def behind(self) -> int:
        """Stations used before the estimated one."""
        return self.taps.shape[-1] - 1 - self.ahead

    def __call__(self, signals: SpatialSignals, extra: int = 0) -> np.ndarray:
        """Return m and q (2, size + 2 extra) [m], including `extra` stations beyond either end."""
        first = signals.margin - extra
        size = signals.size + 2 * extra
        inside = slice(first, first + size)
        motions = signals.motions[:N_MOTIONS, first - self.behind : first + size + self.ahead]
        z, states = np.zeros((2, size)), signals.states[inside]
        k, above = _locate_knots(signals.v[inside])
        for combination in range(_N_STATE_COMBINATIONS):
            # bit by bit the states of the combination: its weight is the product of their shares
            on = (combination >> np.arange(3, -1, -1)) & 1
            here = np.prod(np.where(on, states, 1.0 - states), axis=1)
            for knot in range(KNOTS.size) if here.any() else ():
                share = here * ((k == knot) * (1.0 - above) + (k + 1 == knot) * above)
                if share.any():
                    taps = self.taps[combination, knot].astype(float)
                    pairs = zip(motions, taps, strict=True)
                    front, rear, roll = (np.correlate(x, h, "valid") for x, h in pairs)
                    z += share * np.array([front + rear, roll])
        return _MM * z


class _KnotNormalEquations(NamedTuple):
    """Normal equations of all knots: blocks X'X (knots, p, p) of each knot with itself and with the
    next, and X'Z (knots, p).
    """

    diagonal: np.ndarray
    off_diagonal: np.ndarray
    XZ: np.ndarray

    @classmethod
    def zeros(cls, p: int) -> "_KnotNormalEquations":
        """Return empty sums for `p` regressors."""
        return cls(*(np.zeros((KNOTS.size, *shape)) for shape in ((p, p), (p, p), (p,))))

    def add(self, X: np.ndarray, z: np.ndarray, v: float) -> None:
        """Add regressors X (N, p) and targets z (N,) of a drive at speed v [m/s]."""
        XX, Xz = X.T @ X, X.T @ z
        (k,), (share,) = _locate_knots(np.array([v]))
        self.diagonal[k] += (1.0 - share) ** 2 * XX
        self.diagonal[k + 1] += share**2 * XX
        self.off_diagonal[k] += share * (1.0 - share) * XX
        self.XZ[k] += (1.0 - share) * Xz
        self.XZ[k + 1] += share * Xz

    @single_blas_thread()
    def solve(self) -> np.ndarray:
        """Return the taps (knots, p)."""
        knots, p = self.XZ.shape
        level = np.einsum("kii->", self.diagonal) / (knots * p) or 1.0
        smoothness = SMOOTHNESS * level * np.eye(p)
        # the matrix is block tridiagonal. LAPACK's lower band (d, j) is the element (j + d, j): the
        # column j of a knot's blocks, stacked in `below`, from its diagonal on
        row, column = np.arange(2 * p)[:, None] + np.arange(p), np.arange(p)
        bands = np.zeros((2 * p, knots * p), order="F")
        for k in range(knots):
            below = np.zeros((3 * p, p))  # the diagonal block, the one below it, and zeros
            below[:p] = self.diagonal[k] + RIDGE * level * np.eye(p)
            below[:p] += smoothness * ((k > 0) + (k + 1 < knots))
            if k + 1 < knots:
                below[p : 2 * p] = (self.off_diagonal[k] - smoothness).T
            bands[:, k * p : (k + 1) * p] = below[row, column]
        taps = solveh_banded(bands, self.XZ.ravel(), overwrite_ab=True, lower=True)
        return taps.reshape(knots, p)


def _locate_knots(v: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the knots below speeds of any shape, and the weights of those above."""
    x = np.interp(np.log(np.maximum(v, KNOTS[0])), np.log(KNOTS), np.arange(KNOTS.size))
    k = np.minimum(x.astype(int), KNOTS.size - 2)
    return k, x - k
