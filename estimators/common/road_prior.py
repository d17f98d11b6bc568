"""How likely a road is, from node to node of its spline.

Mean and difference of the wheel paths of an isotropic surface are independent, of densities
G_d (1 ± g) / 2. The spline rounds waves off by sinc(n ds)^4, which is made up for.
"""

import numpy as np
from scipy.fft import rfftfreq

from road_envs.analysis.information_bound import RoadPrior
from road_envs.analysis.roughness import root_coherence

N_MIN = 0.01
"""Steps of waves longer than 1 / N_MIN [m] are no likelier than this one's, for any waviness
[cycles/m]."""


def increment_amplitude(
    prior: RoadPrior, size: int, ds: float, flat_below: float | None = None
) -> np.ndarray:
    """A(n) (2, size // 2 + 1) [m] of `size` nodes `ds` [m] apart, for mean and half difference:
    irfft(A rfft(white noise)) are rises from coefficient to coefficient as likely as the prior has
    them.

    Longer waves than 1 / N_MIN [m] go on as a random walk; or, from `flat_below` [cycles/m] on, no
    wave is higher than that one.
    """
    line = rfftfreq(size, ds)
    line[0] = 0.5 * line[1]  # a slope all along is half a wave
    n = np.maximum(line, flat_below or N_MIN)
    g, k = root_coherence(n, prior.w, prior.track), line if flat_below else n
    rise = 2.0 * np.sin(np.pi * k * ds) / np.sinc(k * ds) ** 4
    variance = 0.5 * prior.density(n) / ds * rise**2
    return np.sqrt(0.5 * variance * np.array([1.0 + g, 1.0 - g]))
