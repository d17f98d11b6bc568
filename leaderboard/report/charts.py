"""Charts of a task: along the road, over spatial frequency, over the runs.

Drawn heights are integers of _HEIGHT_UNIT, encoded as differences under `dy`; `std` is their
standard deviation in that unit, of which the script makes a 90 % band.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from leaderboard.evaluation.results import Result, Trace, score_arrays
from leaderboard.evaluation.tasks import Condition, Task
from leaderboard.metrics.bootstrap import MIN_ROADS, count_roads, performance_profile
from leaderboard.metrics.heights import band_pass, scored_band
from leaderboard.metrics.obstacles import Obstacle, match_obstacles, true_obstacles
from leaderboard.metrics.registry import SCORES
from leaderboard.metrics.roughness import THIRD_OCTAVES
from leaderboard.report import figures as fig
from leaderboard.report.tables import SPECTRUM_SCORES, Row
from road_envs.analysis.information_bound import RoadPrior, bound
from road_envs.records.roughness import CLASSES, N_0, displacement_psd, smooth_psd
from road_envs.sensing.instruments import load_instruments

_HEIGHT_UNIT = 1e-4  # unit [m] of encoded heights
_DRAWN_HEIGHT_LIMIT = 3.0  # drawn heights are clipped to +- this [m]
_N_SHOWN = 2  # number of entries, best first, whose lines are shown at first
_BOUNDS: dict[tuple[str, str], list[float]] = {}  # by task and condition, for every page
_ERROR_HOVER = "%{y:.3f} at %{x:.2f} cycles/m"
_CLASS_FREQUENCIES = (0.05, 10.0)  # range [cycles/m] of the chart of densities


def _frequency_axis(low: float, high: float) -> Any:
    ticks = [n for n in (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10) if low <= n <= high]
    label = "spatial frequency [cycles/m]"
    ends = (fig.rounded(math.log10(low)), fig.rounded(math.log10(high)))
    return fig.axis(label, *ends, type="log", tickvals=ticks, ticktext=[f"{n:g}" for n in ticks])


HEIGHT_AXES: dict[str, Any] = {
    "hovermode": "x unified",
    "xaxis": fig.axis("distance [m]", unifiedhovertitle={"text": "%{x:.1f} m"}),
    "yaxis": fig.axis("height [mm]"),
}
ERROR_AXES: dict[str, Any] = {
    "xaxis": _frequency_axis(THIRD_OCTAVES[0], THIRD_OCTAVES[-1]),
    "yaxis": fig.axis("error over truth", 0.0, 2.0),
}


def task_charts(
    task: Task, results: Mapping[str, Result], rows: Mapping[str, Row], on_level: np.ndarray
) -> dict[str, fig.Chart]:
    """Return the charts of a task by name, with the given results in their order, best first. Runs
    `on_level` (R, C) roads, by `level_runs` of all results of the task, count for nobody.
    """
    drawn = {
        condition: traces
        for k, condition in enumerate(task.conditions)
        if (traces := {name: r.traces[k] for name, r in results.items() if len(r.traces) > k})
    }
    charts = {
        "road": _road_chart(drawn),
        "density": _density_chart(drawn),
        "error": _error_chart(task, {name: rows[name] for name in results}),
    }
    key = task.board_definition.ranks_by
    arrays = {name: _counted_runs(r, key, on_level) for name, r in results.items()}
    scores = {name: x for name, x in arrays.items() if count_roads(x) >= MIN_ROADS}
    if scores:
        charts["runs"] = _runs_chart(scores, task)
    return charts


def _counted_runs(result: Result, key: str, on_level: np.ndarray) -> np.ndarray:
    """Return a score (R, C, S) of all runs, infinite without it unless `on_level` (R, C) roads."""
    every = score_arrays(result.scores)
    own = every[[*SCORES].index(key)]
    own[np.isfinite(every).any(axis=0) & np.isnan(own)] = np.inf
    own[on_level] = np.nan
    return own


def _visibility(k: int) -> dict[str, Any]:
    """Return whether the line of entry number `k` is shown at first."""
    return {} if k < _N_SHOWN else {"visible": "legendonly"}


def _look_of_entry(k: int, name: str) -> dict[str, Any]:
    return {"line": fig.line_style(name), **_visibility(k)}


def height_lines(traces: Mapping[str, Trace], side: int, kind: str) -> list[dict[str, Any]]:
    """Return the truth and the estimates of one wheel path, _N_SHOWN of them visible at first."""
    reference = next(iter(traces.values()))
    truth = _height_line("truth", reference, reference.z_true, side, kind)
    lines = [truth | {"line": fig.TRUTH_LINE}]
    for k, (name, trace) in enumerate(traces.items()):
        line = _height_line(name, trace, trace.z_estimated, side, kind)
        if kind == "inside" and trace.z_std is not None:
            first, stride = (round(line[key] / trace.ds) for key in ("x0", "dx"))
            std = np.minimum(trace.z_std[side, first::stride], _DRAWN_HEIGHT_LIMIT) / _HEIGHT_UNIT
            line["std"] = np.rint(std).astype(int).tolist()[: len(line["dy"])]
        lines.append(line | _look_of_entry(k, name))
    return lines


def _height_line(name: str, trace: Trace, z: np.ndarray, side: int, kind: str) -> dict[str, Any]:
    """Return a line of heights (2, N) [m]: "raw", about their median, as no sensor knows the datum,
    or "inside" the scored band; the least spacings [m] drawn are those here.
    """
    drawn, spacing = z - np.median(z, axis=1, keepdims=True), 0.05
    if kind == "inside":  # 5 points of the shortest wave
        drawn, spacing = band_pass(z, trace.ds, scored_band(trace.speed_kmh / 3.6)), 0.1
    first, stride = (z.shape[1] - drawn.shape[1]) // 2, max(1, round(spacing / trace.ds))
    limited = np.clip(drawn[side, ::stride], -_DRAWN_HEIGHT_LIMIT, _DRAWN_HEIGHT_LIMIT)
    steps = np.diff(np.rint(limited / _HEIGHT_UNIT).astype(int), prepend=0).tolist()
    at = {"x0": fig.rounded(first * trace.ds), "dx": fig.rounded(stride * trace.ds), "dy": steps}
    look = {"legendgroup": name, "mode": "lines", "hovertemplate": "%{y:.1f} mm"}
    return {"name": name, **at, **look}


def _road_chart(drawn: Mapping[Condition, Mapping[str, Trace]]) -> fig.Chart:
    figures = {}
    for condition, traces in drawn.items():
        trace = next(iter(traces.values()))
        caption = (
            f"{trace.road}, seed {trace.road_seed}: the first test road, first "
            f"{trace.s[-1] + trace.ds:.0f} m; of a trained entry, the training with the median "
            "error"
        )
        for side, path in enumerate(("left", "right")):
            marks = _obstacle_marks(traces, side)
            for kind in ("inside", "raw"):
                lines = height_lines(traces, side, kind) + (marks if kind == "raw" else [])
                figures[f"{condition.label}|{path}|{kind}"] = {"data": lines, "caption": caption}
    title, by = "Truth and estimates along the road", ("condition", "side", "kind")
    return fig.chart(title, figures, {"height": 420, **HEIGHT_AXES}, by=by)


def _obstacle_marks(traces: Mapping[str, Trace], side: int) -> list[dict[str, Any]]:
    reference = next(iter(traces.values()))
    found = true_obstacles(reference.z_true, reference.ds)[side]
    marks = [_marks("truth", "true obstacle", found, "triangle-down", fig.INK)] if found else []
    for k, (name, trace) in enumerate(traces.items()):
        if not (matches := match_obstacles(trace.z_true, trace.z_estimated, trace.ds)):
            continue
        pairs, missed, false = matches[side]
        for kind, symbol, obstacles in (
            ("detected", "circle-open", [mine for _, mine in pairs]),
            ("missed", "x-thin-open", missed),
            ("false alarm", "diamond-open", false),
        ):
            if obstacles:
                own = _marks(name, kind, obstacles, symbol, fig.colour(name))
                marks.append(own | _visibility(k))
    return marks


def _marks(name: str, kind: str, obstacles: list[Obstacle], symbol: str, paint: str) -> fig.Chart:
    return {
        "name": f"{name}: {kind}",
        "legendgroup": name,
        "showlegend": False,
        "mode": "markers",
        "x": [round(obstacle.s, 2) for obstacle in obstacles],
        "y": [round(1000.0 * obstacle.height, 1) for obstacle in obstacles],
        "marker": {"symbol": symbol, "size": 10, "color": paint, "line": {"width": 2}},
        "hovertemplate": "%{y:.0f} mm",
    }


def _density_chart(drawn: Mapping[Condition, Mapping[str, Trace]]) -> fig.Chart:
    """Return densities over areas of every second class: half to twice its mean, of waviness 2."""
    n = list(_CLASS_FREQUENCIES)
    means = {x: [G * (m / N_0) ** -2.0 for m in n] for x, G in CLASSES.items() if x in "ACEG"}
    own: Any = {"fillcolor": fig.BAND, "name": "class"}
    areas = [fig.area(n, [0.5 * G for G in x], [2.0 * G for G in x], **own) for x in means.values()]
    look = {"showarrow": False, "xanchor": "right", "font": {"color": fig.QUIET}}
    letters = [  # annotations take powers of ten
        {"text": letter, "x": np.log10(n[1]), "y": fig.rounded(y, 4), **look}
        for letter, mean in means.items()
        if (y := np.log10(mean[1])) > -9
    ]
    figures = {}
    for condition, traces in drawn.items():
        reference = next(iter(traces.values()))
        lines = [_density("truth", reference.z_true, reference.ds) | {"line": fig.TRUTH_LINE}]
        for k, (name, trace) in enumerate(traces.items()):
            line = _density(name, trace.z_estimated, trace.ds)
            lines.append(line | _look_of_entry(k, name))
        figures[condition.label] = {"data": [*areas, *lines], "layout": _band_edges(condition)}
    layout = {
        "xaxis": _frequency_axis(*_CLASS_FREQUENCIES),
        "yaxis": fig.axis("density [m³]", -9, -1, type="log", exponentformat="power", dtick=2),
        "annotations": letters,
    }
    title = "Displacement spectral densities over the classes of ISO 8608"
    return fig.chart(title, figures, layout, by=("condition",))


def _density(name: str, z: np.ndarray, ds: float) -> dict[str, Any]:
    """Return the mean density of both wheel paths, with gaps where it is 0."""
    n, G = smooth_psd(*displacement_psd(z, ds))
    y = [fig.rounded(x, 3) if x > 0.0 else None for x in G.mean(axis=0)]
    hover = "%{y:.2e} m³ at %{x:.2f} cycles/m"
    return fig.curve(name, [fig.rounded(x, 4) for x in n], y, hovertemplate=hover)


def _band_edges(condition: Condition) -> dict[str, Any]:
    return {"shapes": [fig.upright(n) for n in scored_band(condition.speed_kmh / 3.6)]}


def error_lines(rows: Mapping[str, Row], group: str) -> list[dict[str, Any]]:
    """Return the third-octave errors of rows over a group of runs, or over all of them."""
    lines = []
    for k, (name, row) in enumerate(rows.items()):
        values = row.groups.get(group, row.values)
        found = map(values.get, SPECTRUM_SCORES)
        y = [None if x is None else fig.rounded(x, 4) for x in found]
        look = _look_of_entry(k, name) | {"hovertemplate": _ERROR_HOVER}
        lines.append(fig.curve(name, THIRD_OCTAVES, y, **look))
    return lines


def _third_octave_bound(task: Task, condition: Condition) -> list[float]:
    """Return the least NRMSE [-] by third octave on an ISO road of class D (w = 2), if any."""
    v, edge = condition.speed_kmh / 3.6, 2.0 ** (1 / 6)  # half a third octave
    car, instruments = task.vehicle_of(condition), load_instruments(task.instruments)
    n = np.geomspace(THIRD_OCTAVES[0] / edge, THIRD_OCTAVES[-1] * edge, 15 * 60)
    prior = RoadPrior(G_d0=CLASSES["D"])
    try:
        posterior = bound(car, condition.simulator_mode, v, instruments, prior, n=n)
    except np.linalg.LinAlgError:  # instruments without noise
        return []
    errors = []
    for centre in THIRD_OCTAVES:
        inside = (n >= centre / edge) & (n < centre * edge)
        wrong = np.trapezoid(posterior.path_psd[inside].sum(axis=1), n[inside])
        road = np.real(np.trace(posterior.prior[inside], axis1=1, axis2=2))
        errors.append(float(np.sqrt(wrong / np.trapezoid(road, n[inside]))))
    return errors


def bound_lines(task: Task, condition: Condition, name: str = "bound") -> list[dict[str, Any]]:
    """Return the bound in third octaves under a condition, on a class-D road, if there is one."""
    key = (task.digest, condition.label)
    if task.bound and task.test.noise and key not in _BOUNDS:
        _BOUNDS[key] = [fig.rounded(x, 4) for x in _third_octave_bound(task, condition)]
    look: Any = {"line": {"color": fig.INK, "dash": "dot", "width": 1.6}}
    y = _BOUNDS.get(key)
    return [fig.curve(name, THIRD_OCTAVES, y, hovertemplate=_ERROR_HOVER, **look)] if y else []


def _error_chart(task: Task, rows: Mapping[str, Row]) -> fig.Chart:
    figures = {
        condition.label: {
            "data": [*bound_lines(task, condition), *error_lines(rows, condition.label)],
            "layout": _band_edges(condition),
        }
        for condition in task.conditions
    }
    return fig.chart("Error over spatial frequency", figures, ERROR_AXES, by=("condition",))


def _runs_chart(scores: Mapping[str, np.ndarray], task: Task) -> fig.Chart:
    """Return the performance profiles of scores (R, C, S), with their intervals."""
    definition, strata = task.board_definition, task.test.strata
    thresholds = np.linspace(0.0, definition.scale, 41)
    x = [fig.rounded(limit) for limit in thresholds]
    data, hover = [], "%{y:.0f} % of runs up to %{x:.2f}"
    for k, (name, values) in enumerate(scores.items()):
        profile = performance_profile(values, thresholds, strata)
        share, low, high = (np.round(100.0 * y, 1).tolist() for y in profile)
        own = {"legendgroup": name, **_visibility(k)}
        band = fig.area(x, low, high, fillcolor=f"{fig.colour(name)}2e", name=name, **own)
        look = {"line": fig.line_style(name), "hovertemplate": hover, **own}
        data += [band, fig.curve(name, x, share, **look)]
    layout = {
        "xaxis": fig.axis(SCORES[definition.ranks_by].label, 0.0, definition.scale),
        "yaxis": fig.axis("share of runs [%]", 0.0, 100.0),
    }
    return fig.chart("Share of runs at or below an error", {"": {"data": data}}, layout)
