"""Natural modes of a vehicle about a state, without side motion."""

from dataclasses import dataclass

import numpy as np
import scipy

from road_envs.vehicle.linear_model import LinearModel

NATURAL_MODE_NAMES = (
    *("bounce", "roll", "pitch"),
    *("front axle hop", "front axle roll", "rear axle hop", "rear axle roll", "frame torsion"),
)
"""Names of the modes, in the order of the dominant coordinates: `equations.DOF`, and the twist."""


@dataclass(frozen=True, eq=False)
class _NaturalModes:
    """The seven natural modes in ascending frequency; damping ratios are from the diagonal of the
    modal damping matrix, a good approximation for light damping.
    """

    names: tuple[str, ...]
    f: np.ndarray  # (7,) [Hz], undamped
    zeta: np.ndarray  # (7,)
    # (7, 7): a column per mode over `equations.DOF`, with unit modal mass (phi' M phi = 1) and
    # positive in the coordinate that names the mode
    shapes: np.ndarray


def natural_modes(model: LinearModel) -> _NaturalModes:
    """Return the natural modes of M q'' + C q' + K q = 0, named after their dominant coordinate.

    M_j phi_j² is the share of a mode's kinetic energy in coordinate j; names are assigned such that
    the sum of these shares is greatest. Raises ArithmeticError if the state is not stable (all
    wheels off the ground, or a body that tips over), ValueError if the vehicle has side motion.
    """
    if model.speed is not None:
        raise ValueError("natural modes are those of a vehicle without side motion")
    M, n = model.M, model.M.size
    K, C = (-M[:, None] * model.A[n:, part] for part in (slice(n), slice(n, None)))
    square, shapes = scipy.linalg.eigh(0.5 * (K + K.T), np.diag(M))
    if not square[0] > 1e-9 * square[-1]:
        raise ArithmeticError(
            "no natural modes: the stiffness matrix of this state is not positive definite; "
            "linearise about a state with all wheels on the ground"
        )
    _, assigned = scipy.optimize.linear_sum_assignment(M[:, None] * shapes**2, maximize=True)
    names = [""] * n
    for name, column in zip(NATURAL_MODE_NAMES[:n], assigned, strict=True):
        names[column] = name
    shapes[:, assigned] *= np.sign(shapes[np.arange(n), assigned])
    omega = np.sqrt(square)
    zeta = np.einsum("ji,jk,ki->i", shapes, C, shapes) / (2.0 * omega)
    return _NaturalModes(tuple(names), omega / (2.0 * np.pi), zeta, shapes)
