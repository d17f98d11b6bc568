"""Time history of one drive of a policy: tyre loads, commanded states, heave, roll."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from leaderboard.report.figures import INK, Chart, axis, chart, rounded
from road_envs.policies.rollout import Drives
from road_envs.simulation.drive import Trajectory
from road_envs.vehicle.equations import PHI, Z_B
from road_envs.vehicle.suspension import MODES, WHEELS, decode_commands

MODE_NAMES = tuple(MODES)
_MODE_COLOURS = {  # ride mode is drawn as a gap
    "handling": "var(--line-0)",
    "soft_high": "var(--line-1)",
    "stiff_low": "var(--line-3)",
}
_LOAD_COLOURS = (INK, "var(--line-1)", "var(--line-2)", "var(--line-3)")  # of WHEELS


class Timeline(NamedTuple):
    """Signals of a drive at times `t` (T,) [s].
    `loads` (4, T) [N] of the tyres FL, FR, RL, RR; `states` (2, T): index into MODE_NAMES of the
    commanded state of front and rear; heave `acceleration` (T,) [m/s²]; `roll` (T,) [rad].
    """

    t: np.ndarray
    loads: np.ndarray
    states: np.ndarray
    acceleration: np.ndarray
    roll: np.ndarray

    @classmethod
    def from_drive(cls, drives: Drives, i: int, actions: np.ndarray) -> "Timeline":
        """Return drive number `i` under `actions` (T, N), sampled at 50 Hz or so."""
        setup, start = drives.setup, drives.starts[i]
        fleet = setup.make_fleet(keep_signals=True)
        fleet.start(0, start.drive, start.logger, start.speed_kmh)
        parts = []
        for byte in (start.command_byte, *setup.command_bytes[actions[:, i]]):
            ended = fleet.advance(int(byte)).end_of_road[0]
            parts.append(fleet.last_interval(0, int(byte)))
            if ended:
                break
        sampled = slice(None, None, max(1, round(1.0 / (50.0 * fleet.step))))
        names = ("t", "s", "v", "commands", "signals")
        columns = (np.concatenate([getattr(x, name) for x in parts])[sampled] for name in names)
        motion = Trajectory(*columns)
        stiff, high = decode_commands(motion.commands)
        flags = list(MODES.values())
        states = [
            [flags.index((bool(s[w]), bool(h[w]))) for s, h in zip(stiff, high, strict=True)]
            for w in (0, 2)  # left wheels: an axle is commanded as a whole
        ]
        heave, roll = motion.acceleration[:, Z_B], motion.state[:, PHI]
        return cls(motion.t, motion.tyre_load.T, np.array(states), heave, roll)

    def curves(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return tyre loads (4, T) [kN], heave acceleration (T,) [m/s²] and roll (T,) [deg]."""
        return 0.001 * self.loads, self.acceleration, np.degrees(self.roll)


def drive_chart(timelines: Mapping[str, Timeline]) -> Chart:
    """Return a chart with a figure for each policy; all have the same axes."""
    signals = zip(*(line.curves() for line in timelines.values()), strict=True)
    limits = (max(float(np.abs(x).max()) for x in each) for each in signals)
    load, heave, roll = (rounded(1.05 * limit, 3) for limit in limits)
    seconds = max(float(line.t[-1] - line.t[0]) for line in timelines.values())
    time = axis("time [s]", 0.0, rounded(seconds, 4), anchor="y4")
    layout = {"height": 480, "barmode": "overlay", "xaxis": time}
    order: Any = {"categoryorder": "array", "categoryarray": ("rear", "front")}
    axes = {  # from above, each with its share of the height
        "yaxis": (axis("tyre load [kN]", 0.0, load), (0.80, 1.0)),
        "yaxis2": (axis("", type="category", **order, range=[-0.5, 1.5]), (0.58, 0.72)),
        "yaxis3": (axis("heave [m/s²]", -heave, heave), (0.27, 0.50)),
        "yaxis4": (axis("roll [deg]", -roll, roll), (0.0, 0.19)),
    }
    layout |= {name: {**one, "domain": part, "nticks": 4} for name, (one, part) in axes.items()}
    figures = {name: {"data": _drive_data(line)} for name, line in timelines.items()}
    return chart("One drive over time", figures, layout, by=("policy",))


def _drive_data(line: Timeline) -> list[dict[str, Any]]:
    loads, heave, roll = line.curves()
    curves = (
        *(
            (f"load {wheel}", load, "y", colour, f"{wheel} %{{y:.1f}} kN")
            for wheel, load, colour in zip(WHEELS, loads, _LOAD_COLOURS, strict=True)
        ),
        ("heave acceleration", heave, "y3", INK, "%{y:.2f} m/s²"),
        ("roll", roll, "y4", INK, "%{y:.2f}°"),
    )
    spacing = rounded(float(line.t[1] - line.t[0]), 6)
    data = [
        {
            "name": name,
            "mode": "lines",
            "x0": 0.0,
            "dx": spacing,
            "y": np.round(values, 2).tolist(),
            "yaxis": place,
            "line": {"color": colour, "width": 1.3},
            "showlegend": place == "y",
            "hovertemplate": f"{hover} at %{{x:.2f}} s",
        }
        for name, values, place, colour, hover in curves
    ]
    return data + _state_bars(line)


def _state_bars(line: Timeline) -> list[dict[str, Any]]:
    """Return a bar for each time in which an axle is commanded to another state than ride."""
    bars: dict[str, list[tuple[str, float, float]]] = {mode: [] for mode in _MODE_COLOURS}
    t = line.t - line.t[0]
    for axle, states in zip(("front", "rear"), line.states, strict=True):
        changes = np.flatnonzero(np.diff(states)) + 1
        for first, end in zip([0, *changes], [*changes, t.size - 1], strict=True):
            mode = MODE_NAMES[states[first]]
            if mode in bars and end > first:
                begin, duration = (round(float(x), 3) for x in (t[first], t[end] - t[first]))
                bars[mode].append((axle, begin, duration))
    return [
        {
            "type": "bar",
            "orientation": "h",
            "name": mode.replace("_", " "),
            **{key: [bar[k] for bar in bars[mode]] for k, key in enumerate(("y", "base", "x"))},
            "yaxis": "y2",
            "width": 0.7,
            "marker": {"color": colour},
            "showlegend": True,
            "hovertemplate": "%{y}: from %{base:.2f} s for %{x:.2f} s",
        }
        for mode, colour in _MODE_COLOURS.items()
    ]
