"""Time history of one drive of a policy as SVG: road, commanded states, heave, roll."""

from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from road_envs.roads import Surface
from road_envs.simulation.drive import Trajectory
from road_envs.vehicle.equations import PHI, Z_B
from road_envs.vehicle.suspension import MODES, decode_commands

POINTS_PER_SECOND = 50.0
"""Sample rate [Hz] of the drawn curves."""

WIDTH, LEFT, GAP = 720.0, 74.0, 12.0
PANEL_HEIGHTS = {"road": 52.0, "states": 64.0, "acceleration": 70.0, "roll": 44.0}
MODE_NAMES = tuple(MODES)


class Timeline(NamedTuple):
    """Signals of a drive at times `t` (T,) [s].

    `road` (2, T) [m]: heights under the front axle; `states` (2, T): index into MODE_NAMES of the
    commanded state of front and rear; heave `acceleration` (T,) [m/s²]; `roll` (T,) [rad].
    """

    t: np.ndarray
    road: np.ndarray
    states: np.ndarray
    acceleration: np.ndarray
    roll: np.ndarray

    @classmethod
    def from_trajectory(cls, motion: Trajectory, surface: Surface) -> "Timeline":
        """Return the timeline of a motion over a surface, sampled at POINTS_PER_SECOND."""
        stride = max(1, round(1.0 / (POINTS_PER_SECOND * float(motion.t[1] - motion.t[0]))))
        sampled = slice(None, None, stride)
        stiff, high = decode_commands(motion.commands[sampled])
        flags = list(MODES.values())
        states = [
            [flags.index((bool(s[w]), bool(h[w]))) for s, h in zip(stiff, high, strict=True)]
            for w in (0, 2)  # left wheels: an axle is commanded as a whole
        ]
        return cls(
            motion.t[sampled],
            surface.height(motion.s[sampled]),
            np.array(states),
            motion.acceleration[sampled, Z_B],
            motion.state[sampled, PHI],
        )

    def svg(self) -> Markup:
        """Return the drawing as SVG, without size, colours or fonts of its own."""
        panels, top = [], 4.0
        lines = {
            "road": (1000.0 * self.road, "road", "mm"),
            "states": (self.states, "", ""),
            "acceleration": (self.acceleration[None], "heave", "m/s²"),
            "roll": (np.degrees(self.roll)[None], "roll", "deg"),
        }
        for name, (values, label, unit) in lines.items():
            height = PANEL_HEIGHTS[name]
            make = _draw_mode_strips if name == "states" else _draw_curves
            panels.append(make(self.t, values, top, height, label, unit))
            top += height + GAP
        panels.append(_draw_time_axis(self.t, top - GAP))
        body = "".join(panels)
        size = f"0 0 {WIDTH:g} {top + 12:g}"
        return Markup(f'<svg viewBox="{size}" role="img" aria-label="over time">{body}</svg>')


def _x_pixels(t: np.ndarray) -> np.ndarray:
    return LEFT + (WIDTH - LEFT - 4.0) * (t - t[0]) / (t[-1] - t[0])


def _draw_curves(t, values, top: float, height: float, label: str, unit: str) -> str:
    """Draw curves over each other, scaled by their largest magnitude."""
    most = max(float(np.abs(values).max()), 1e-9)  # a flat curve has no scale
    middle = top + 0.5 * height
    parts = [
        f'<path class="axis" d="M{LEFT:g} {middle:g}H{WIDTH - 4:g}"/>',
        f'<text x="0" y="{middle:g}">{label}</text>',
        f'<text class="quiet" x="0" y="{middle + 12:g}">±{most:.2g} {unit}</text>',
    ]
    for k, y in enumerate(values):
        points = zip(_x_pixels(t), middle - 0.5 * height * y / most, strict=True)
        d = "L".join(f"{x:.1f} {v:.1f}" for x, v in points)
        parts.append(f'<path class="line-{k}" d="M{d}"/>')
    return "".join(parts)


def _draw_mode_strips(t, states, top: float, height: float, label: str, unit: str) -> str:
    """Draw a strip for each axle, filled while the state is not ride."""
    parts, x, tall = [], _x_pixels(t), 0.5 * height - 6.0
    for k, (axle, state) in enumerate(zip(("front", "rear"), states, strict=True)):
        bottom = top + (k + 1) * 0.5 * height - 2.0
        parts.append(f'<text x="0" y="{bottom - 4:g}">{axle}</text>')
        parts.append(f'<path class="axis" d="M{LEFT:g} {bottom:g}H{WIDTH - 4:g}"/>')
        changes = np.flatnonzero(np.diff(state)) + 1
        for a, b in zip([0, *changes], [*changes, len(t) - 1], strict=True):
            name = MODE_NAMES[state[a]]
            if name != "ride" and b > a:
                parts.append(
                    f'<rect class="{name}" x="{x[a]:.1f}" y="{bottom - tall:g}" '
                    f'width="{x[b] - x[a]:.1f}" height="{tall:g}"><title>{axle}: {name}, '
                    f"{t[a]:.2f} to {t[b]:.2f} s</title></rect>"
                )
    return "".join(parts)


def _draw_time_axis(t, top: float) -> str:
    ticks = np.arange(np.ceil(t[0]), t[-1] + 1e-9)
    x = np.interp(ticks, t, _x_pixels(t))
    return "".join(
        f'<path class="axis" d="M{at:.1f} {top:g}v4"/>'
        f'<text class="quiet tick" x="{at:.1f}" y="{top + 14:g}">{second:g} s</text>'
        for at, second in zip(x, ticks, strict=True)
    )
