"""Rear view of the vehicle: solid axle, struts, roll, and the road under the rear wheels.

The left side is on the left. The view is a section: the body is open around wheels and struts.
"""

import numpy as np

from road_envs.rendering import style
from road_envs.rendering.canvas import Canvas
from road_envs.rendering.parts import MOUNT, OUTLINES, draw_part, strut
from road_envs.rendering.scene import REAR_LEFT, REAR_RIGHT, Scene
from road_envs.vehicle.equations import AXLE, PHI

SCALE = 104.0  # pixels per metre
GROUND = 254.0  # row of the canvas of level ground
TYRE = 0.22  # width of a tyre [m]

SIDES = ("left up", "right up")


class RearView:
    """Drawing of one scene on one canvas."""

    def __init__(self, canvas: Canvas, scene: Scene):
        self.canvas, self.scene = canvas, scene
        self.axle = scene.car.rear

    def draw(self) -> None:
        self._draw_body()
        self._draw_axle()
        for wheel in (REAR_LEFT, REAR_RIGHT):
            self._draw_wheel(wheel)
            self._draw_strut(wheel)
        self._draw_ground()
        self._draw_captions()

    def project(self, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return points (N, 2) of the canvas for positions `y` left, `z` up [m]."""
        return np.stack([0.5 * self.canvas.width - SCALE * y, GROUND - SCALE * z], axis=-1)

    def project_body(self, outline: list, side: int = 1) -> np.ndarray:
        """Return points (N, 2) of the canvas for an outline of the body; `side` -1 mirrors it."""
        y, z = np.array(outline, dtype=float).T
        _, y, z = self.scene.body_points(np.full(y.shape, self.axle.x), side * y, z)
        return self.project(y, z)

    def _draw_body(self) -> None:
        project = self.project_body
        for part in OUTLINES["rear_halves"]:
            left, right = (project(part["points"], side) for side in (1, -1))
            draw_part(self.canvas, part, np.concatenate([left, right[::-1]]), SCALE)
        for part in OUTLINES["rear_sides"]:
            for side in (1, -1):
                draw_part(self.canvas, part, project(part["points"], side), SCALE)
        for part in OUTLINES["rear_middle"]:
            draw_part(self.canvas, part, project(part["points"]), SCALE)

    def _draw_axle(self) -> None:
        y = np.array([self.axle.y_t, -self.axle.y_t])
        z = np.array([self.scene.hub_height(wheel) for wheel in (REAR_LEFT, REAR_RIGHT)])
        self.canvas.line(self.project(y, z), style.STEEL, 9.0)
        ((column, row),) = self.project(np.array([0.0]), np.array([z.mean()]))
        self.canvas.disc(column, row, 0.14 * SCALE, style.STEEL)

    def _draw_wheel(self, wheel: int) -> None:
        scene = self.scene
        roll = scene.exaggeration * scene.q[AXLE + 3]
        radius, half, bevel = scene.tyre_radius(wheel), 0.5 * TYRE, 0.05
        outer, inner = radius - bevel, half - bevel
        y = np.array([half, half, inner, -inner, -half, -half, -inner, inner])
        z = np.array([-outer, outer, radius, radius, outer, -outer, -radius, -radius])
        tread = self.project(
            scene.wheel_y(wheel) + y - roll * z, scene.hub_height(wheel) + z + roll * y
        )
        self.canvas.polygon(tread, style.RUBBER)

    def _draw_strut(self, wheel: int) -> None:
        y = self.axle.y_s if wheel == REAR_LEFT else -self.axle.y_s
        foot = self.project(np.array([y]), np.array([self.scene.hub_height(wheel, y)]))[0]
        head = self.project_body([(y, MOUNT)])[0]
        strut(self.canvas, self.scene, wheel, foot, head, SCALE)

    def _draw_ground(self) -> None:
        """Draw the road under the rear axle: both wheel paths and a plane between them."""
        scene, y = self.scene, self.axle.y_t
        left, right = scene.road_heights(np.array([scene.station - scene.car.wheelbase]))[:, 0]
        reach = 0.5 * self.canvas.width / SCALE
        across = np.array([reach, y - TYRE, -y + TYRE, -reach])
        top = self.project(across, np.array([left, left, right, right]))
        low = self.project(across[[-1, 0]], np.full(2, -9.0))
        self.canvas.polygon(np.concatenate([top, low]), style.EARTH)
        self.canvas.line(top[:2], style.LEFT_PATH, 2.0)
        self.canvas.line(top[1:3], style.ROAD, 2.0)
        self.canvas.line(top[2:], style.RIGHT_PATH, 2.0)

    def _draw_captions(self) -> None:
        write, y = self.canvas.text, self.canvas.height - 12
        write(12, y, "left", style.PAPER, 12)
        write(self.canvas.width - 12, y, "right", style.PAPER, 12, "rs")
        roll, axle = np.degrees(self.scene.q[PHI]), np.degrees(self.scene.q[AXLE + 3])
        write(10, 20, f"roll {style.describe_tilt(roll, *SIDES)}", style.INK)
        words = f"rear axle {style.describe_tilt(axle, *SIDES)}"
        write(0.5 * self.canvas.width, y, words, style.PAPER, 12, "ms")
        write(self.canvas.width - 10, 20, self.scene.scale_caption, style.INK, anchor="rs")
