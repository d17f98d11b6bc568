"""Statistical linearization of the strut force over an uncertain strut rate.

Friction changes sign within 0.02 m/s, whereas the rate of a strut is uncertain by 0.01 to 0.1
m/s. The filter therefore uses the expected force and the expected slope (the best line for a
Gaussian rate), and treats the rest as noise of known variance,

    E[F] = E F(w + s x)     slope = E F'(w + s x)     residual = E F² - E[F]² - E[F x]²

with w and s the mean and standard deviation of the rate and x standard normal (Roberts & Spanos,
"Random Vibration and Statistical Linearization", 1990, section 5.2; for filters Gelb, "Applied
Optimal Estimation", 1974, section 6.2).
"""

from functools import lru_cache

import numpy as np

from estimators.kalman.state import FilterModel, LocalState
from estimators.kalman.tuning import TUNING
from road_envs.kernels._numba import kernel
from road_envs.vehicle.force_curves import gaussian_smoothed, interpolate_tables
from road_envs.vehicle.suspension import DAMPING_HIGH, V_0, V_STEP

# Standard deviations of a rate [m/s] for which tables are computed in advance
RATE_STDS = np.array([0.0, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3])
_CHOSEN_STDS = RATE_STDS / TUNING.std_inflation


def smoothed_tables(velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tables (W K, cells, 4) of the expected force, from the tables `velocity` (K, cells,
    4), for each standard deviation of RATE_STDS, and the residual variances (W, K, cells + 1) [N²].
    """
    return _smoothed_tables(velocity.tobytes(), velocity.shape)


@lru_cache(maxsize=16)  # most drives are of a vehicle that has driven before
def _smoothed_tables(data: bytes, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    velocity = np.frombuffer(data).reshape(shape).copy()
    tables = [
        gaussian_smoothed(velocity, V_0, V_STEP, s) if s > 0.0 else velocity for s in RATE_STDS
    ]
    return np.concatenate(tables), np.stack([_residual_variance(velocity, s) for s in RATE_STDS])


def _residual_variance(velocity: np.ndarray, std: float) -> np.ndarray:
    """Return the variance (K, cells + 1) [N²] of the force about its best line, over the grid of
    rates, for a rate of standard deviation `std` [m/s].
    """
    rate = V_0 + V_STEP * np.arange(velocity.shape[1] + 1)
    x = np.linspace(-4.0, 4.0, 161)
    weight = np.exp(-0.5 * x**2) / np.exp(-0.5 * x**2).sum()
    table_values = np.empty((velocity.shape[0], rate.size, x.size, 2))
    interpolate_tables(velocity, V_0, V_STEP, rate[:, None] + std * x, table_values)
    F = table_values[..., 0]
    variance, cross = (F**2) @ weight - (F @ weight) ** 2, (F * x) @ weight
    return np.maximum(variance - cross**2 / (x**2 @ weight), 0.0)


@kernel(inline=False)
def choose_linearization(model: FilterModel, local: LocalState, force_variance):
    """Select each strut's table by the uncertainty of its rate, and write the variance [N²] of its
    force residual to `force_variance` (4,).
    """
    p, strut_rows = model.constants[0], model.strut_rows
    n_dof, n_tables = strut_rows.shape[1], model.force_variance.shape[1]
    for w in range(4):
        rate, variance = 0.0, 0.0
        for i in range(n_dof):
            rate += strut_rows[w, i] * local.x[n_dof + i]
            for k in range(n_dof):
                cross = strut_rows[w, i] * strut_rows[w, k]
                variance += cross * local.rows[n_dof + i, n_dof + k]
        std, index = np.sqrt(max(variance, 0.0)), 0
        while index < _CHOSEN_STDS.size - 1 and (
            std > 0.5 * (_CHOSEN_STDS[index] + _CHOSEN_STDS[index + 1])
        ):
            index += 1
        p.velocity_table[w] = model.first_table[w] + n_tables * index
        u = min(max((rate - V_0) / V_STEP, 0.0), model.force_variance.shape[2] - 1.001)
        i, low, high = int(u), int(model.first_table[w]), local.strut_state[w, DAMPING_HIGH]
        t = u - i
        table = model.force_variance[index]  # high damping is next to low damping
        soft = (1.0 - t) * table[low, i] + t * table[low, i + 1]
        hard = (1.0 - t) * table[low + 1, i] + t * table[low + 1, i + 1]
        force_variance[w] = (1.0 - high) * soft + high * hard
