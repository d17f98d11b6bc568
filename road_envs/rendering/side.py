"""Side view of the vehicle, from its right, driving to the right over both wheel paths.

The left wheel path is behind the right one, shifted upwards and to the right; lengths along the
vehicle are to scale. The outline is that of a Defender 110, attached to the axles of the vehicle.
"""

import numpy as np

from road_envs.rendering import style
from road_envs.rendering.canvas import Canvas
from road_envs.rendering.parts import MOUNT, OUTLINES, draw_part, strut
from road_envs.rendering.scene import LEFT_WHEELS, RIGHT_WHEELS, WHEEL_RADIUS, Scene
from road_envs.vehicle.equations import THETA, Z_B

SCALE = 92.0  # pixels per metre
SHEAR = np.array([0.07, 0.13])  # shift [m] right and up of a point one metre to the left
GROUND = 254.0  # row of the canvas of a level right wheel path
SHOULDER = 0.3  # width of the road outside the wheel paths [m]
STONE = 0.25  # length of a paving stone [m]
COURSES = 4  # number of courses of paving stones between the wheel paths
DASH = 1.0  # length of the painted dashes on asphalt [m]
GAP = 2.0  # spacing of the painted dashes [m]
DASH_EDGES = (0.46, 0.54)  # of the painted dashes, from the left (0) to the right wheel path (1)

LEGEND = (
    (10, style.SOFT, "soft spring, low damping"),
    (210, style.STIFF, "stiff spring, high damping"),
    (420, style.STOP_REACHED, "stop reached"),
)
"""Column, colour and text of the legend of strut colours."""


class SideView:
    """Drawing of one scene on one canvas."""

    def __init__(self, canvas: Canvas, scene: Scene):
        self.canvas, self.scene = canvas, scene
        self.origin = 0.5 * canvas.width - SCALE * 0.5 * (scene.car.front.x + scene.car.rear.x)
        self.near = -scene.car.front.y_t
        columns = np.linspace(-20.0, canvas.width + 20.0, 340)
        self.x = (columns - self.origin) / SCALE
        self.s = self.x + scene.station - scene.car.front.x
        self.left, self.right = scene.road_heights(self.s)
        self.paved = "belgian" in scene.surface.name
        self.road_colour = style.ROAD if self.paved else style.ASPHALT

    def draw(self) -> None:
        self._draw_hills()
        self._draw_far_side()
        self._draw_road()
        self._draw_body()
        for wheel in RIGHT_WHEELS:
            self._draw_wheel(wheel)
            self._draw_strut(wheel)
        self._draw_foreground()
        self._draw_captions()

    def project(self, x: np.ndarray, y: np.ndarray | float, z: np.ndarray) -> np.ndarray:
        """Return points (N, 2) of the canvas for positions `x` ahead, `y` left, `z` up [m]."""
        depth = np.asarray(y) - self.near
        columns = self.origin + SCALE * (x + SHEAR[0] * depth)
        rows = GROUND - SCALE * (z + SHEAR[1] * depth)
        return np.stack(np.broadcast_arrays(columns, rows), axis=-1)

    def project_body(self, outline: list) -> np.ndarray:
        """Return points (N, 2) of the canvas for a body outline in the plane of the struts."""
        car = self.scene.car
        share, ahead, z = np.array(outline, dtype=float).T
        x = car.rear.x + share * car.wheelbase + ahead
        x, _, z = self.scene.body_points(x, np.full(x.shape, -car.front.y_s), z)
        return self.project(x, self.near, z)

    def _draw_hills(self) -> None:
        """Draw a distant ridge that moves more slowly than the road."""
        u = 0.12 * self.x + 0.015 * self.scene.station
        ridge = 0.75 + 0.22 * np.sin(4.1 * u) + 0.12 * np.sin(9.7 * u + 1.0)
        foot = self.project(self.x, 0.0, np.zeros(self.x.size))
        self._fill_strip(self.project(self.x, 0.0, ridge), foot, style.HILLS)

    def _draw_far_side(self) -> None:
        y = -self.near
        verge = self.project(self.x, y + SHOULDER, self.left)
        self._fill_strip(verge, self.project(self.x, y, self.left), self.road_colour)
        for wheel in LEFT_WHEELS:
            self._draw_wheel(wheel)

    def _draw_road(self) -> None:
        far = self.project(self.x, -self.near, self.left)
        self._fill_strip(far, self.project(self.x, self.near, self.right), self.road_colour)
        self._draw_stones() if self.paved else self._draw_dashes()
        self.canvas.line(far, style.LEFT_PATH, 1.5)
        for left in LEFT_WHEELS:
            x = self.scene.car.axles[left // 2].x
            ends = [self.scene.hub_height(left), self.scene.hub_height(left + 1)]
            beam = self.project(np.array([x, x]), np.array([-self.near, self.near]), np.array(ends))
            self.canvas.line(beam, style.DARK, 7.0)

    def _draw_stones(self) -> None:
        """Draw courses of stones; a periodic pattern would seem to run backwards."""
        for course in range(COURSES):
            shift = 0.5 * (course % 2)
            number = np.arange(int(self.s[0] / STONE) - 1, int(self.s[-1] / STONE) + 1)
            s = STONE * (number[:, None] + shift + np.array([0.04, 0.96, 0.96, 0.04]))
            across = (course + np.array([0.1, 0.1, 0.95, 0.95])) / COURSES
            stones = self._project_road(s, across)
            for i, stone in zip(number.tolist(), stones, strict=True):
                # a pseudo-random colour, by multiplicative hashing
                colour = ((i * 2654435761 + course * 40503) & 0xFFFFFFFF) >> 13
                self.canvas.polygon(stone, style.STONES[colour % len(style.STONES)])

    def _draw_dashes(self) -> None:
        """Draw the dashes of a centre line, which follow the road in steps of a tenth."""
        period = DASH + GAP
        along = DASH * np.linspace(0.0, 1.0, 11)
        first = period * np.arange(int(self.s[0] / period) - 1, int(self.s[-1] / period) + 1)
        s = first[:, None] + np.concatenate([along, along[::-1]])
        across = np.repeat(DASH_EDGES, along.size)
        for dash in self._project_road(s, across):
            self.canvas.polygon(dash, style.PAINT)

    def _project_road(self, s: np.ndarray, across: np.ndarray) -> np.ndarray:
        """Return canvas points (N, M, 2) at stations `s` (N, M) [m] of the road.

        `across` (M,) is the position between the left (0) and the right (1) wheel path.
        """
        left, right = self.scene.road_heights(s)
        x = s - self.scene.station + self.scene.car.front.x
        z = left + across * (right - left)
        return self.project(x, self.near * (2.0 * across - 1.0), z)

    def _draw_body(self) -> None:
        for part in OUTLINES["side"]:
            draw_part(self.canvas, part, self.project_body(part["points"]), SCALE)

    def _draw_wheel(self, wheel: int) -> None:
        scene, canvas = self.scene, self.canvas
        x, y, z = scene.car.axles[wheel // 2].x, scene.wheel_y(wheel), scene.hub_height(wheel)
        ((column, row),) = self.project(np.array([x]), y, np.array([z]))
        radius = SCALE * scene.tyre_radius(wheel)
        canvas.disc(column, row, radius, style.RUBBER)
        canvas.disc(column, row, 0.235 * SCALE, style.RIM)
        canvas.disc(column, row, 0.15 * SCALE, style.STEEL)
        turned = (scene.station - scene.car.front.x + x) / WHEEL_RADIUS
        mark = 0.19 * SCALE * np.array([np.sin(turned), -np.cos(turned)])
        canvas.disc(column + mark[0], row + mark[1], 0.035 * SCALE, style.DARK)

    def _draw_strut(self, wheel: int) -> None:
        axle = self.scene.car.axles[wheel // 2]
        lower = self.scene.hub_height(wheel, -axle.y_s)
        foot = self.project(np.array([axle.x]), self.near, np.array([lower]))[0]
        head = self.project_body([(1 - wheel // 2, 0.0, MOUNT)])[0]
        strut(self.canvas, self.scene, wheel, foot, head, SCALE)

    def _draw_foreground(self) -> None:
        """Draw the road in front of the right wheels, and the earth under it with stations."""
        path = self.project(self.x, self.near, self.right)
        edge = self.project(self.x, self.near - SHOULDER, self.right)
        self._fill_strip(path, edge, self.road_colour)
        bottom = np.array([[edge[-1, 0], self.canvas.height], [edge[0, 0], self.canvas.height]])
        self.canvas.polygon(np.concatenate([edge, bottom]), style.EARTH)
        self.canvas.line(path, style.RIGHT_PATH, 1.5)
        for mark in np.arange(np.ceil(self.s[0] / 2.0), self.s[-1] / 2.0) * 2.0:
            x, y = (np.interp(mark, self.s, along) for along in edge.T)
            self.canvas.line(np.array([[x, y], [x, y + 6.0]]), style.PAPER)
            label = min(y + 18.0, self.canvas.height - 22.0)
            self.canvas.text(x, label, f"{mark + 0.0:.0f} m", style.PAPER, 11, "ms")

    def _fill_strip(self, one: np.ndarray, other: np.ndarray, fill: str) -> None:
        self.canvas.polygon(np.concatenate([one, other[::-1]]), fill)

    def _draw_captions(self) -> None:
        q = self.scene.q
        pitch, heave = np.degrees(q[THETA]), 1000.0 * q[Z_B]
        write = self.canvas.text
        write(10, 20, f"pitch {style.describe_tilt(pitch, 'nose down', 'nose up')}", style.INK)
        write(200, 20, f"heave {round(heave):+d} mm", style.INK)
        write(self.canvas.width - 10, 20, self.scene.scale_caption, style.INK, anchor="rs")
        y = self.canvas.height - 11.0
        is_switched = len(self.scene.car.modes) > 1
        for x, colour, words in LEGEND if is_switched else LEGEND[-1:]:
            self.canvas.box(x, y - 5, x + 10, y + 5, style.PAPER)
            self.canvas.box(x + 1, y - 4, x + 9, y + 4, colour)
            write(x + 16, y, words, style.PAPER, 11, "lm")
