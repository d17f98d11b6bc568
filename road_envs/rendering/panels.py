"""Panels of a frame: heading, wheel paths, accelerations, struts and tyres."""

from dataclasses import dataclass

import numpy as np

from road_envs.rendering import style
from road_envs.rendering.canvas import Canvas
from road_envs.rendering.scene import Scene
from road_envs.vehicle.struts import Modes
from road_envs.vehicle.suspension import WHEELS, decode_commands

GAUGE_TRAVEL = 0.16  # strut extension [m] at the ends of the gauge
GAUGE_LOAD = 3.0  # tyre load at the end of the bar, in static loads
PATH_STYLES = ((style.LEFT_PATH, 1.5), (style.PALE, 2.5))  # colour, thickness: left, right path
MAX_NAME_LENGTH = 24  # longest name of a road that fits into the heading [characters]
MARGIN = 62  # width of the labels left of a curve [pixels]


def heading(canvas: Canvas, scene: Scene) -> None:
    y = 0.5 * canvas.height
    name = scene.surface.name
    shown = name if len(name) <= MAX_NAME_LENGTH else name[: MAX_NAME_LENGTH - 1] + "…"
    canvas.text(12, y, f"road: {shown}", style.INK, 16, "lm", bold=True)
    canvas.text(330, y, f"{3.6 * scene.speed:.1f} km/h", style.INK, 15, "lm", bold=True)
    canvas.text(
        450, y, f"command: {_describe_command(scene.command, scene.car.modes)}", style.INK, 13, "lm"
    )
    canvas.text(860, y, f"station {scene.station:.1f} m", style.INK, 13, "rm")
    canvas.text(948, y, f"{scene.t:.2f} s", style.INK, 13, "rm")


def _describe_command(byte: int, modes: Modes) -> str:
    """Return a command byte in words, by the `modes` of the car."""
    stiff, high = (flags[0] for flags in decode_commands(np.array([byte])))
    flags = zip(stiff, high, strict=True)
    words = [style.describe_state(*pair, modes) for pair in flags]
    if len(set(words)) == 1:
        return words[0]
    if words[0] == words[1] and words[2] == words[3]:
        return f"front {words[0]}, rear {words[2]}"
    return "individual wheels"


@dataclass(frozen=True)
class _AxisScale:
    """Linear map from values to pixels: `low` maps to `start`, `high` to `end`."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value):
        return self.start + (self.end - self.start) * (value - self.low) / (self.high - self.low)

    def ticks(self, step: float) -> np.ndarray:
        """Return the multiples of `step` from `low` to `high`."""
        return step * np.arange(np.ceil(self.low / step), np.floor(self.high / step) + 1)


def wheel_paths(canvas: Canvas, scene: Scene) -> None:
    """Draw the heights of both wheel paths around the vehicle, and the positions of its wheels."""
    z = scene.surface.z
    # 10 m of road behind the front axle, and 20 m ahead of it
    ends = scene.station - 10.0, scene.station + 20.0
    columns = _AxisScale(*ends, MARGIN, canvas.width - 10.0)
    rows = _AxisScale(min(z.min(), 0.0), max(z.max(), 0.01), canvas.height - 16.0, 22.0)
    axles = np.array([scene.station - scene.car.wheelbase, scene.station])
    canvas.text(10, 15, "wheel paths, mm", style.INK, 12)
    canvas.text(columns.end, 15, "left dark, right light", style.FAINT, 11, "rs")
    canvas.box(columns(axles[0]), rows.end - 2, columns(axles[1]), rows.start + 2, style.SKY)
    _grid_lines(canvas, columns, rows)
    s = np.linspace(columns.low, columns.high, 560)
    paths = zip(scene.surface.height(s), scene.surface.height(axles), PATH_STYLES, strict=True)
    for heights, wheels, (colour, thickness) in reversed(list(paths)):
        canvas.line(np.column_stack([columns(s), rows(heights)]), colour, thickness)
        for column, row in zip(columns(axles), rows(wheels), strict=True):
            canvas.disc(column, row, 3.5, colour)


def _grid_lines(canvas: Canvas, columns: _AxisScale, rows: _AxisScale) -> None:
    """Draw a line across the panel for heights, and ticks under it for stations."""
    for z in rows.ticks(_round_up((rows.high - rows.low) / 4.0)):
        canvas.line(np.array([[columns.start, rows(z)], [columns.end, rows(z)]]), style.GRID)
        height = f"{1000 * z + 0.0:g}"  # never -0
        canvas.text(columns.start - 6, rows(z), height, style.FAINT, 11, "rm")
    for s in columns.ticks(5.0):
        x, y = columns(s), rows.start
        canvas.line(np.array([[x, y], [x, y + 4]]), style.FAINT)
        canvas.text(columns(s), canvas.height - 2, f"{s + 0.0:.0f} m", style.FAINT, 10, "ms")


def _round_up(value: float, leading: tuple[int, ...] = (1, 2, 5)) -> float:
    """Return the smallest product of a `leading` digit and a power of ten that is >= `value`."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(m * power for m in (*leading, 10) if m * power >= value * (1 - 1e-9)))


def accelerations(canvas: Canvas, scene: Scene) -> None:
    """Draw the recent samples of the accelerometers, newest at the right."""
    left, right, top = MARGIN, canvas.width - 70.0, 20.0
    height = (canvas.height - top - 4.0) / len(scene.sensors)
    recent = scene.samples[:, -round(scene.window * scene.fs) :]
    limit = _round_up(max(float(np.abs(recent).max()), 1.0), (1, 2, 3, 5))
    canvas.text(10, 15, f"accelerations, ±{limit:g} m/s²", style.INK, 12)
    canvas.text(right, 15, f"last {scene.window:g} s", style.FAINT, 11, "rs")
    for i, name in enumerate(scene.sensors):
        middle = top + (i + 0.5) * height
        canvas.line(np.array([[left, middle], [right, middle]]), style.GRID)
        canvas.text(left - 6, middle, name, style.INK, 12, "rm", bold=True)
        age, a = _envelope(recent[i], scene)
        points = [right - (right - left) * age / scene.window, middle - 0.47 * height * a / limit]
        if age.size > 1:
            canvas.line(np.column_stack(points), style.INK)
            canvas.text(canvas.width - 10, middle, f"{recent[i, -1]:+.1f}", style.INK, 12, "rm")


def _envelope(a: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return ages [s] and values of the extremes of the samples `a` (N,) in about each pixel."""
    size = max(round(scene.window * scene.fs / 500.0), 1)
    cells = a[a.size % size :].reshape(-1, size)
    age = np.arange(cells.shape[0])[::-1] * size / scene.fs
    return np.repeat(age, 2), np.column_stack([cells.min(axis=1), cells.max(axis=1)]).ravel()


def corners(canvas: Canvas, scene: Scene) -> None:
    width, height = 0.5 * canvas.width, 0.5 * canvas.height
    for wheel in range(4):
        _corner(canvas, scene, wheel, (wheel % 2) * width + 10, (wheel // 2) * height, width - 20)


def _corner(canvas: Canvas, scene: Scene, wheel: int, x: float, y: float, width: float) -> None:
    stiff, high = scene.spring_stiff[wheel], scene.damper_high[wheel]
    canvas.text(x, y + 18, WHEELS[wheel], style.INK, 13, bold=True)
    canvas.box(x + 26, y + 8, x + 33, y + 18, style.state_colour(high))
    canvas.box(x + 33, y + 8, x + 40, y + 18, style.state_colour(stiff))
    canvas.text(x + 46, y + 18, style.describe_state(stiff, high, scene.car.modes), style.INK, 12)
    _extension(canvas, scene, wheel, x, y + 28, width)
    _load(canvas, scene, wheel, x, y + 62, width)


def _extension(canvas, scene, wheel, x, y, width) -> None:
    e, stop = scene.extension[wheel], scene.stop_state(wheel)
    low, high = scene.car.free_travel[wheel]

    def column(extension):
        return x + width * (0.5 + 0.5 * np.clip(extension / GAUGE_TRAVEL, -1.0, 1.0))

    canvas.box(x, y + 2, x + width, y + 9, style.GRID)
    canvas.box(x, y, column(low), y + 11, style.STOP_REACHED if stop < 0 else style.RULE)
    canvas.box(column(high), y, x + width, y + 11, style.STOP_REACHED if stop > 0 else style.RULE)
    canvas.box(column(0.0) - 0.5, y, column(0.0) + 0.5, y + 11, style.FAINT)
    canvas.box(column(e) - 2, y - 1, column(e) + 2, y + 12, style.INK)
    words = {-1: "on bump stop", 0: "", 1: "on rebound stop"}[stop]
    canvas.text(x, y + 24, words or f"strut {round(1000 * e):+d} mm", style.INK, 11)


def _load(canvas, scene, wheel, x, y, width) -> None:
    load = scene.load[wheel]
    share = load / scene.car.tyre_loads[wheel // 2]
    canvas.box(x, y, x + width, y + 9, style.GRID)
    canvas.box(x, y, x + width * min(share / GAUGE_LOAD, 1.0), y + 9, style.STEEL)
    canvas.box(x + width / GAUGE_LOAD - 0.5, y - 2, x + width / GAUGE_LOAD + 0.5, y + 11, style.INK)
    if load > 0.0:
        canvas.text(x, y + 22, f"tyre {load / 1000:.1f} kN", style.INK, 11)
    else:
        canvas.text(x, y + 22, "in the air", style.AIRBORNE, 11, bold=True)
