"""Bending of the body in the readings: a linear filter behind the model of the rigid motion.

What the struts bend (`road_envs.vehicle.body_bending`) follows from the body's heave and pitch and
acts on the sensors alone. Sample by sample it is one more filter of the predicted accelerations;
in the tangent, which is in block means, the modal force is one more sensor behind the others. In
the frequency domain the body's heave and pitch are those of two more sensors, BODY.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import sosfilt

from road_envs.sensing.instruments import SensorLocation
from road_envs.vehicle import body_bending
from road_envs.vehicle.equations import THETA, Z_B
from road_envs.vehicle.parameters import BendingMode, VehicleParameters

# Points (x, y) [m] whose accelerations are the body's heave, and heave and pitch
BODY = {"middle of the body": (0.0, 0.0), "1 m behind it": (-1.0, 0.0)}


@dataclass(frozen=True, eq=False)
class SensedBending:
    """A bending `mode`, its modal `force` (2,) per modal mass by heave and pitch, and its `shape`
    (S,) at the sensors, in units of their readings.
    """

    mode: BendingMode
    force: np.ndarray
    shape: np.ndarray

    def at_samples(self, acceleration: np.ndarray, step: float) -> np.ndarray:
        """Return its readings (S, N), from coordinates' accelerations (N, 7) every `step` [s]."""
        force = acceleration[:, [Z_B, THETA]] @ self.force
        return self.shape[:, None] * sosfilt(body_bending.section(self.mode, step), force)

    def extended(
        self, sample_weight: np.ndarray, sensor_rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return weights (S + 1, J, b) of the samples in block means, and sensor rows (S + 1, 7),
        with the modal force as the last sensor.
        """
        mean = np.full((1, *sample_weight.shape[1:]), 1.0 / sample_weight.shape[2])
        return np.concatenate([sample_weight, mean]), self.extended_rows(sensor_rows)

    def extended_rows(self, sensor_rows: np.ndarray) -> np.ndarray:
        """Return sensor rows (S + 1, 7) with the modal force as the last sensor."""
        row = np.zeros((1, sensor_rows.shape[1]))
        row[0, [Z_B, THETA]] = self.force
        return np.concatenate([sensor_rows, row])

    def sense(self, means: np.ndarray, duration: float) -> np.ndarray:
        """Return the block means (S, J) of the sensors, from those of `extended` (S + 1, J)."""
        q = sosfilt(body_bending.section(self.mode, duration), means[-1])
        return means[:-1] + self.shape[:, None] * q

    def sense_transpose(self, means: np.ndarray, duration: float) -> np.ndarray:
        """Apply the transpose of `sense`: from (S, J) to (S + 1, J)."""
        backward = (self.shape @ means)[::-1]
        force = sosfilt(body_bending.section(self.mode, duration), backward)[::-1]
        return np.concatenate([means, force[None]])

    def response(self, unbent: np.ndarray, f: np.ndarray) -> np.ndarray:
        """Return the responses (F, S, K) of the sensors at `f` (F,) [Hz], from those (F, S + 2, K)
        of the same sensors and of BODY on a body that does not bend.
        """
        heave, behind = unbent[:, -2], unbent[:, -1]
        force = self.force[0] * heave + self.force[1] * (behind - heave)
        q = body_bending.response(self.mode, f)[:, None] * force
        return unbent[:, :-2] + self.shape[:, None] * q[:, None, :]


def sensed_bending(
    car: VehicleParameters, locations: Mapping[str, SensorLocation]
) -> SensedBending | None:
    """Return the bending of a vehicle as sensors at `locations` read it; None if it is stiff."""
    mode = car.variation.bending
    if mode is None:
        return None
    on_body = np.array([place.axle is None for place in locations.values()])
    shape = on_body * body_bending.shape(mode, np.array([place.x for place in locations.values()]))
    return SensedBending(mode, body_bending.modal_force(mode, car), shape)
