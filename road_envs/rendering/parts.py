"""Parts of the vehicle that both views draw."""

from typing import Any

import numpy as np

from road_envs.core.config import folder, read_yaml
from road_envs.rendering import style
from road_envs.rendering.canvas import Canvas
from road_envs.rendering.scene import Scene

MOUNT = 1.02  # height [m] of the upper strut mounts on the body
TUBE = 0.34  # length [m] of the lower tube of a strut
COLLAR = 0.06  # length [m] of the stops of a strut

OUTLINES = read_yaml(folder() / "rendering" / "defender_110.yaml")
"""Parts of the body by view: `colour`, `points`, and an `edge`, a `radius` [m] or `line`."""


def draw_part(canvas: Canvas, part: dict[str, Any], points: np.ndarray, scale: float) -> None:
    """Draw one of OUTLINES with its `points` (N, 2) of the canvas."""
    colour = getattr(style, part["colour"])
    if "radius" in part:
        ((x, y),) = points
        canvas.disc(x, y, part["radius"] * scale, colour)
    elif "line" in part:
        canvas.line(points, colour)
    else:
        canvas.polygon(points, colour, getattr(style, part["edge"]) if "edge" in part else None)


def strut(
    canvas: Canvas, scene: Scene, wheel: int, lower: np.ndarray, upper: np.ndarray, scale: float
) -> None:
    """Draw the telescopic strut of `wheel` from `lower` to `upper` (2,) on the canvas.

    The tube has the colour of the damper state, the rod that of the spring state. A stop that is
    reached is highlighted: the bump stop under the body, the rebound stop on the tube.
    """
    along = upper - lower
    length = float(np.hypot(*along))
    along = along / length
    top = lower + along * min(TUBE * scale, length)
    across = np.array([-along[1], along[0]])
    stop = scene.stop_state(wheel)
    _bar(canvas, top, upper, across * 0.032 * scale, style.state_colour(scene.spring_stiff[wheel]))
    _bar(canvas, lower, top, across * 0.06 * scale, style.state_colour(scene.damper_high[wheel]))
    collar = along * COLLAR * scale
    _stop(canvas, upper - collar, upper, across * 0.075 * scale, stop < 0)
    _stop(canvas, top - collar, top, across * 0.075 * scale, stop > 0)


def _stop(canvas: Canvas, start: np.ndarray, end: np.ndarray, half: np.ndarray, lit: bool) -> None:
    _bar(canvas, start, end, (1.9 if lit else 1.0) * half, style.DARK)
    if lit:
        _bar(canvas, start, end, 1.6 * half, style.STOP_REACHED)


def _bar(canvas: Canvas, start: np.ndarray, end: np.ndarray, half: np.ndarray, fill: str) -> None:
    canvas.polygon(np.array([start + half, end + half, end - half, start - half]), fill)
