"""Heights of an estimate whose model does not explain the drive, reduced towards a level road."""

import numpy as np


def reduce_unexplained(
    z: np.ndarray, z_std: np.ndarray | None, share: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return heights `z` (2, M) [m] times `share`, 0 to 1, and the standard deviation they leave.

    The part that is taken away counts as error. `share` is a number or one per station (M,).
    """
    share = np.broadcast_to(share, z.shape)
    if z_std is None or not (share < 1.0).any():
        return z * share, z_std
    return z * share, np.hypot(z_std, (1.0 - share) * np.abs(z))
