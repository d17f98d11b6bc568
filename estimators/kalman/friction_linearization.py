"""Force over the rate of extension, as far as the rate is known (statistical linearisation).

Friction turns within 0.02 m/s, and the filter knows the rate of a strut to 0.01 to 0.1 m/s. So the
force that it expects is the mean over what the rate may be, its slope the mean slope (the best
line, for a normal rate), and what is left over is noise of a known variance,

    E[F] = E F(w + s x)     slope = E F'(w + s x)     left = E F² - E[F]² - E[F x]²

with x standard normal (Roberts & Spanos, "Random Vibration and Statistical Linearization", 1990,
section 5.2; for filters Gelb, "Applied Optimal Estimation", 1974, section 6.2).
"""

import numpy as np

from estimators.kalman.state import FORCE, FilterModel, FilterState
from road_envs._numba import kernel
from road_envs.vehicle.equations import N_DOF
from road_envs.vehicle.force_curves import gaussian_smoothed, interpolate_tables
from road_envs.vehicle.suspension import DAMPING_HIGH, V_0, V_STEP

RATE_STDS = np.array([0.0, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3])
"""Uncertainties of a rate [m/s] for which tables stand ready."""

STD_INFLATION = 1.2
"""Times its deviation that a rate counts as uncertain: what the filter has made of other kinks is
not in its covariance. Tuned on training drives."""


def smoothed_tables(velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tables (W K, cells, 4) of the mean force over the rate for each of the WIDTHS of its
    uncertainty, from `velocity` (K, cells, 4), and the variance (W, K, cells + 1) [N²] left over.
    """
    tables = [
        gaussian_smoothed(velocity, V_0, V_STEP, s) if s > 0.0 else velocity for s in RATE_STDS
    ]
    return np.concatenate(tables), np.stack([residual_variance(velocity, s) for s in RATE_STDS])


def residual_variance(velocity: np.ndarray, width: float) -> np.ndarray:
    """Variance (K, cells + 1) [N²] of the force about its best line, over the rate's grid."""
    rate = V_0 + V_STEP * np.arange(velocity.shape[1] + 1)
    x = np.linspace(-4.0, 4.0, 161)
    weight = np.exp(-0.5 * x**2) / np.exp(-0.5 * x**2).sum()
    found = np.empty((velocity.shape[0], rate.size, x.size, 2))
    interpolate_tables(velocity, V_0, V_STEP, rate[:, None] + width * x, found)
    F = found[..., 0]
    spread, both = (F**2) @ weight - (F @ weight) ** 2, (F * x) @ weight
    return np.maximum(spread - both**2 / (x**2 @ weight), 0.0)


@kernel(inline=False)
def choose_linearization(model: FilterModel, state: FilterState):
    """Choose each strut's tables by how uncertain its rate is, and begin its force anew."""
    x, P, p = state.x, state.P, model.constants[0]
    kinds = model.force_variance.shape[1]
    for w in range(4):
        rate, variance = 0.0, 0.0
        for i in range(N_DOF):
            rate += model.strut_rows[w, i] * x[N_DOF + i]
            for k in range(N_DOF):
                both = model.strut_rows[w, i] * model.strut_rows[w, k]
                variance += both * P[N_DOF + i, N_DOF + k]
        std, best = np.sqrt(max(variance, 0.0)), 0
        while best < model.rate_stds.size - 1 and (
            std > 0.5 * (model.rate_stds[best] + model.rate_stds[best + 1])
        ):
            best += 1
        p.velocity_table[w] = model.first_table[w] + kinds * best
        u = min(max((rate - V_0) / V_STEP, 0.0), model.force_variance.shape[2] - 1.001)
        i, low, high = int(u), int(model.first_table[w]), state.strut_state[w, DAMPING_HIGH]
        t = u - i
        left = model.force_variance[best]
        soft = (1.0 - t) * left[low, i] + t * left[low, i + 1]
        hard = (1.0 - t) * left[low + 1, i] + t * left[low + 1, i + 1]
        x[FORCE + w] = 0.0
        P[FORCE + w, :] = 0.0
        P[:, FORCE + w] = 0.0
        P[FORCE + w, FORCE + w] = (1.0 - high) * soft + high * hard
