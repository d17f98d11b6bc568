"""Calibration of standard deviations: how many errors lie within the Gaussian bounds."""

import numpy as np

# Probabilities of the intervals that are calibrated, and their bounds in standard deviations
COVERAGE = ((0.5, 0.6745), (0.9, 1.6449))


def coverage_factors(ratios: np.ndarray) -> np.ndarray:
    """Return for each of COVERAGE the factor on the standard deviations that gives it exactly.
    `ratios` are errors over standard deviations, of any shape.
    """
    return np.array([np.quantile(np.abs(ratios), share) / bound for share, bound in COVERAGE])
