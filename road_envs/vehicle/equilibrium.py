"""Static equilibrium of a vehicle on a road."""

import numpy as np

from road_envs.vehicle.equations import Motion, Plant, accelerations, stiffness_and_damping


def _pose_on_ground(plant: Plant, z_r: np.ndarray) -> np.ndarray:
    """Return the coordinates with every wheel at its road height `z_r` (4,) [m]."""
    x, y_t = plant.constants[0]["x"], plant.constants[0]["y_t"]
    left, right = z_r[0::2], z_r[1::2]
    heave, roll = 0.5 * (left + right), (left - right) / (y_t[0::2] - y_t[1::2])
    theta = (heave[1] - heave[0]) / (x[0] - x[1])
    z_b, phi = heave[0] + x[0] * theta, roll.mean()
    untwisted = [0.0] if plant.flexible else []
    return np.array([z_b, phi, theta, heave[0], roll[0], heave[1], roll[1], *untwisted])


def equilibrium(plant: Plant, strut_state: np.ndarray, z_r: np.ndarray) -> np.ndarray:
    """Return the static equilibrium (14,), (16,) if flexible, on road heights `z_r` (4,) [m], by
    Newton's method; side motion adds zeros, as if the road did not lean. Raises ArithmeticError if
    the iteration does not converge, for example because a wheel is off the ground.
    """
    M, n = plant.inertias, plant.inertias.size
    q, rest, no_rates = _pose_on_ground(plant, z_r), np.zeros(n), np.zeros(4)
    still = np.zeros(plant.n_dof - n)
    vehicle = plant.buffers(strut_state)
    K, C, a = np.empty((n, n)), np.empty((n, n)), np.empty(n)
    for _ in range(50):
        accelerations(vehicle, Motion(q, rest), z_r, no_rates, a)
        if np.abs(a).max() < 1e-10 * (1.0 + np.abs(z_r).max()):
            return np.concatenate([q, still, rest, still])
        stiffness_and_damping(vehicle, Motion(q, rest), z_r, no_rates, K, C)
        try:
            q = q + np.linalg.solve(K, M * a)
        except np.linalg.LinAlgError:  # all wheels off the ground
            break
    raise ArithmeticError(f"no static equilibrium found on the road heights {z_r.tolist()} m")
