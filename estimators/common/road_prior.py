"""Prior spectrum of a road's increments from node to node of its spline.

Mean and half difference of the wheel paths of an isotropic surface are independent, of densities
G_d (1 ± g) / 2. The spline attenuates waves by sinc(n ds)^4, for which the amplitude compensates.
"""

import numpy as np
from scipy.fft import rfftfreq

from road_envs.analysis.information_bound import RoadPrior
from road_envs.records.roughness import root_coherence

N_MIN = 0.01  # [cycles/m] below which the density of the increments is constant, for any waviness


def increment_amplitude(
    prior: RoadPrior, size: int, ds: float, flat_below: float | None = None
) -> np.ndarray:
    """Return A(n) (2, size // 2 + 1) [m] for mean and half difference, `size` nodes `ds` [m] apart.

    irfft(A rfft(white noise)) are increments from coefficient to coefficient with the spectrum of
    `prior`. Waves longer than 1 / N_MIN [m] continue as a random walk; with `flat_below` [cycles/m]
    waves longer than 1 / `flat_below` are no higher than that one.
    """
    line = rfftfreq(size, ds)
    line[0] = 0.5 * line[1]  # a constant slope counts as half a wave
    n = np.maximum(line, flat_below or N_MIN)
    g, k = root_coherence(n, prior.w, prior.track), line if flat_below else n
    rise = 2.0 * np.sin(np.pi * k * ds) / np.sinc(k * ds) ** 4
    variance = 0.5 * prior.density(n) / ds * rise**2
    return np.sqrt(0.5 * variance * np.array([1.0 + g, 1.0 - g]))
