"""Rendering of the vehicle on its road: `render_frame(scene)` draws one frame.

Each panel has its own canvas, so that nothing is drawn across panels.
"""

import numpy as np

from road_envs.rendering import panels, style
from road_envs.rendering.canvas import Canvas
from road_envs.rendering.rear import RearView
from road_envs.rendering.scene import Scene
from road_envs.rendering.side import SideView

__all__ = ["HEIGHT", "WIDTH", "Scene", "render_frame"]

WIDTH, HEIGHT = 960, 540

PANELS = (
    (panels.heading, (0, 0), (960, 39), style.PAPER),
    (lambda canvas, scene: SideView(canvas, scene).draw(), (0, 40), (639, 304), style.SKY),
    (lambda canvas, scene: RearView(canvas, scene).draw(), (640, 40), (320, 304), style.SKY),
    (panels.wheel_paths, (0, 345), (639, 88), style.PAPER),
    (panels.accelerations, (0, 434), (639, 106), style.PAPER),
    (panels.corners, (640, 345), (320, 195), style.PAPER),
)
"""Draw function, top left corner, width and height [pixels], and background of each panel."""


def render_frame(scene: Scene) -> np.ndarray:
    """Return a frame (540, 960, 3), uint8, of `scene`."""
    image = np.full((HEIGHT, WIDTH, 3), 201, dtype=np.uint8)  # grey seams between the panels
    for draw, (x, y), (width, height), background in PANELS:
        canvas = Canvas(width, height, background)
        draw(canvas, scene)
        image[y : y + height, x : x + width] = canvas.pixels()
    return image
