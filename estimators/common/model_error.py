"""Error of a linear model whose parameters are uncertain, as noise.

With the response H(x) and parameters x = x_0 + d of covariance P, signals H(x) z of a road z with
the spectrum S differ from H(x_0) z by the sum over p of d_p (dH / dx_p) z, to first order. Its mean
over d is zero, and its spectrum

    S_e = sum over p, q of P_pq (dH / dx_p) S (dH / dx_q)*

It adds to the noise of the sensors: where the model is uncertain, the signals are trusted less. It
is as large as the road is rough, and neglects that d is the same at all frequencies.
"""

import numpy as np

from road_envs.analysis.statistical_linearization import hermitian


def model_error_psd(dH: np.ndarray, covariance: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return the spectrum (F, S, S) that uncertain parameters add to S signals.

    `dH` (P, F, S, 2): derivatives of the response; `covariance` (P, P) of the parameters; `S`
    (F, 2, 2): spectrum of the road.
    """
    root = np.linalg.cholesky(covariance)
    parts = np.tensordot(root.T, dH, axes=1)
    return np.sum(parts @ S @ hermitian(parts), axis=0)
