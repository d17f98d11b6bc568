"""Colours and captions of a frame.

Colours with a meaning are of Okabe & Ito's palette, which is safe for colour-blind readers.
"""

import numpy as np

from road_envs.vehicle.struts import Modes

PAPER = "#ffffff"
RULE = "#c9d1d8"
INK = "#1d2a35"
FAINT = "#6b7884"
PALE = "#93a3b1"
GRID = "#e6eaee"

SKY = "#dfebf3"
HILLS = "#cfdccf"
ROAD = "#a5a198"
ASPHALT = "#8f9296"
PAINT = "#d9dadb"
STONES = ("#bcb8b0", "#b3aea5", "#c3bfb8", "#aeaaa3", "#b8b2a6")
EARTH = "#857d71"
LEFT_PATH = "#16222d"
RIGHT_PATH = "#f4f1ea"

BODY = "#5f8263"
BODY_EDGE = "#44604a"
ROOF = "#f3efe4"
GLASS = "#3a4a56"
DARK = "#2a2d30"
RUBBER = "#33363a"
RIM = "#dcd8cc"
STEEL = "#8d959c"
LAMP = "#b5382a"
INDICATOR = "#e08a1e"

SOFT = "#0072b2"
STIFF = "#d55e00"
STOP_REACHED = "#f0e442"
AIRBORNE = LAMP

BLENDED_EDGES = (
    (PAPER, INK, 2),
    (PAPER, FAINT, 1),
    (EARTH, PAPER, 1),
    (SKY, INK, 1),
    (BODY, BODY_EDGE, 1),
)
"""Pairs of adjacent colours, and the number of intermediate shades of their smooth edges."""

STATE_NAMES = {"soft_high": "soft/high", "stiff_low": "stiff/low"}  # spring/damping


def palette() -> list[int]:
    """Return red, green and blue of all colours and of the shades at edges, as a flat list."""
    named = [value for value in globals().values() if isinstance(value, str) and value[:1] == "#"]
    colours = [_rgb(value) for value in (*named, *STONES)]
    for one, other, shades in BLENDED_EDGES:
        share = np.arange(1, shades + 1)[:, None] / (shades + 1)
        colours.extend(_rgb(one) + share * (_rgb(other) - _rgb(one)))
    return np.rint(np.unique(colours, axis=0)).astype(int).ravel().tolist()


def _rgb(colour: str) -> np.ndarray:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], dtype=float)


def describe_tilt(angle: float, positive: str, negative: str) -> str:
    """Return an angle [degrees] with the word for its direction."""
    size = f"{abs(angle):.2f}°"
    return size if size == "0.00°" else f"{size} {positive if angle > 0 else negative}"


def describe_state(stiff: bool, high: bool, modes: Modes) -> str:
    """Return the name of the state of a strut, by the `modes` of the car."""
    mode = next(mode for mode, state in modes.items() if state == (stiff, high))
    return STATE_NAMES.get(mode, mode)


def state_colour(firm: bool) -> str:
    """Return the colour of a stiff spring or high damping, else that of a soft or low one."""
    return STIFF if firm else SOFT
