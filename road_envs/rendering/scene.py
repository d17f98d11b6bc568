"""Content of one frame as plain data.

Displayed heights are relative to a datum that follows the long waves of the road, like a camera
that moves with the vehicle. The `exaggeration` applies to road, wheels, body and tyre deflection
alike, so that an airborne wheel is also airborne in the frame.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from road_envs.roads.surface import Surface
from road_envs.simulation.drive import DriveSimulator, Trajectory
from road_envs.vehicle.equations import AXLE, PHI, THETA, Z_B
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import DAMPING_HIGH, VALVE_OPEN

WHEEL_RADIUS = 0.4  # of an unloaded tyre [m], 7.50 R 16; the ride model itself does not need it
CAMERA_WINDOW = 20.0  # length of road [m] over which the datum is averaged
REAR_LEFT, REAR_RIGHT = 2, 3
LEFT_WHEELS, RIGHT_WHEELS = (REAR_LEFT, 0), (REAR_RIGHT, 1)


@dataclass(frozen=True, eq=False)
class Scene:
    """Vehicle on its road at the instant `t` [s], front axle at `station` [m].

    `samples` (k, N) [m/s²] are those of the accelerometers `sensors` at `fs` [Hz], newest last; the
    last `window` seconds are shown. `q` (7,) are the coordinates of `vehicle.equations`,
    `extension` (4,) [m] and `load` (4,) [N] those of struts and tyres, `spring_stiff` and
    `damper_high` (4,) the valve states, `command` the last command byte.
    """

    car: VehicleParameters
    surface: Surface
    t: float
    station: float
    speed: float
    q: np.ndarray
    extension: np.ndarray
    load: np.ndarray
    spring_stiff: np.ndarray
    damper_high: np.ndarray
    command: int
    samples: np.ndarray
    fs: float
    window: float
    exaggeration: float
    sensors: tuple[str, ...]

    @classmethod
    def from_drive(cls, drive: DriveSimulator, trajectory: Trajectory, **shown: Any) -> "Scene":
        """Return the scene at the end of `trajectory`, the latest one of `drive`.

        `shown` are the fields `samples`, `fs`, `window`, `exaggeration` and `sensors`.
        """
        return cls(
            **shown,
            car=drive.car,
            surface=drive.surface,
            t=float(trajectory.t[-1]),
            station=float(trajectory.s[-1]),
            speed=float(trajectory.v[-1]),
            q=trajectory.state[-1, :7],
            extension=trajectory.extension[-1],
            load=trajectory.tyre_load[-1],
            spring_stiff=drive.strut_state[:, VALVE_OPEN] < 0.5,
            damper_high=drive.strut_state[:, DAMPING_HIGH] >= 0.5,
            command=int(trajectory.commands[-1]),
        )

    @cached_property
    def datum(self) -> float:
        """Height [m] of the camera: a weighted mean of both wheel paths around the vehicle."""
        middle = self.station - 0.5 * self.car.wheelbase
        weights = np.hanning(82)[1:-1]
        s = middle + CAMERA_WINDOW * np.linspace(-0.5, 0.5, weights.size)
        return float(self.surface.height(s).mean(axis=0) @ weights / weights.sum())

    def to_display(self, z: np.ndarray | float) -> np.ndarray:
        """Return heights `z` [m], of any shape, relative to the datum and exaggerated."""
        return self.exaggeration * (np.asarray(z) - self.datum)

    def road_heights(self, s: np.ndarray) -> np.ndarray:
        """Return displayed heights (2, M) [m] of left and right wheel path at stations `s` (M,)."""
        return self.to_display(self.surface.height(s))

    def body_points(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return displayed positions of body points which are at `x`, `y`, `z` (N,) [m] at rest."""
        k, lever = self.exaggeration, z - self.car.h_cg
        heave = self.to_display(self.q[Z_B] - x * self.q[THETA] + y * self.q[PHI])
        return x + k * self.q[THETA] * lever, y - k * self.q[PHI] * lever, z + heave

    def hub_height(self, wheel: int, y: float | None = None) -> float:
        """Return the displayed height [m] of an axle at its `wheel`, or at `y` [m] left."""
        axle = wheel // 2
        y = self.wheel_y(wheel) if y is None else y
        height = self.q[AXLE + 2 * axle] + y * self.q[AXLE + 2 * axle + 1]
        rest = WHEEL_RADIUS - self.car.tyre_deflections[axle]
        return float(rest + self.to_display(height))

    def tyre_radius(self, wheel: int) -> float:
        """Return the displayed radius [m] of an unloaded tyre; its deflection is exaggerated."""
        return WHEEL_RADIUS + (self.exaggeration - 1.0) * self.car.tyre_deflections[wheel // 2]

    def wheel_y(self, wheel: int) -> float:
        """Return the lateral position of the `wheel` [m], positive to the left."""
        y = self.car.axles[wheel // 2].y_t
        return y if wheel % 2 == 0 else -y

    @property
    def scale_caption(self) -> str:
        """Caption on the scale of the vertical motion."""
        k = self.exaggeration
        return "to scale" if k == 1.0 else f"vertical motion ×{k:g}"

    def stop_state(self, wheel: int) -> int:
        """Return -1 if the strut is on its bump stop, 1 on its rebound stop, 0 between."""
        (low, high), e = self.car.free_travel[wheel], self.extension[wheel]
        return int(e >= high) - int(e <= low)
