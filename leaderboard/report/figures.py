"""Building blocks of the charts of the pages, which `static/charts.js` draws with Plotly.

A chart is plain data:

    title    description for screen readers
    by       names of the form fields that select one of its figures
    layout   Plotly layout of all its figures
    figures  by the values of these fields, joined by "|": {data, layout, caption}

Colours are variables of `static/site.css`, so that a figure serves the light and the dark page.

`static/plotly-basic.min.js` is the unchanged file of the npm package plotly.js-basic-dist-min 4.1.1
(MIT, `static/plotly-LICENSE.txt`).
"""

import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

_N_COLOURS = 7  # number of colours of lines in `static/site.css`: as many as there are FAMILIES
_DASHES = ("solid", "dash", "dot")  # dashes of the estimators in FAMILIES
_OTHER_DASHES = ("dashdot", "longdash", "longdashdot")  # dashes of all other estimators

FAMILIES = (  # those of one method have one colour on every page, and differ by their dashes
    ("map_smoother",),
    ("iterated_wiener", "wiener"),
    ("kalman_rts", "kalman_lag", "kalman"),
    ("tcn", "tcn_causal"),
    ("gru", "gru_causal"),
    ("fir_ridge", "inverse_quarter_car"),
    ("static_lm", "narx"),
)

_STYLES = {x: (k, _DASHES[j]) for k, family in enumerate(FAMILIES) for j, x in enumerate(family)}
INK, QUIET, BAND = "var(--ink)", "var(--quiet)", "var(--band)"
TRUTH_LINE = {"color": "var(--truth)", "width": 4.0}
Chart = dict[str, Any]  # as a whole, or a part of it


def line_style(name: str) -> dict[str, Any]:
    """Return colour, dash and width of the line of an estimator, the same on every page."""
    digest = zlib.crc32(name.encode())
    other = _OTHER_DASHES[digest // _N_COLOURS % len(_OTHER_DASHES)]
    k, dash = _STYLES.get(name, (digest % _N_COLOURS, other))
    return {"color": f"var(--line-{k})", "dash": dash, "width": 1.6}


def colour(name: str) -> str:
    """Return the colour of an estimator."""
    return line_style(name)["color"]


def chart(title: str, figures: Chart, layout: Chart, by: Sequence[str] = ()) -> Chart:
    """Return a chart; a single figure has the key ""."""
    return {"title": title, "by": list(by), "layout": dict(layout), "figures": dict(figures)}


def axis(label: str, low: float | None = None, high: float | None = None, **options: Any) -> Any:
    """Return a Plotly axis with a label; `low` and `high` are powers of ten on a log axis."""
    limits = {} if low is None or high is None else {"range": [low, high]}
    return {"title": {"text": label}, **limits, **options}


def curve(name: str, x: Iterable[float], y: Iterable[float | None], **options: Any) -> Any:
    """Return a line; its legend entry also hides what has the same `legendgroup`."""
    line = {"name": name, "x": list(x), "y": list(y), "legendgroup": name, "mode": "lines"}
    return line | options


def area(x: Sequence[float], low: Sequence[float], high: Sequence[float], **options: Any) -> Any:
    """Return a filled area between two curves, without legend and read-out."""
    outline = {"x": [*x, *x[::-1]], "y": [*high, *low[::-1]]}
    look = {"fill": "toself", "line": {"width": 0}, "mode": "lines"}
    return {**outline, **look, "hoverinfo": "skip", "showlegend": False, **options}


def interval_bars(
    name: str, values: Mapping[str, float], ends: Iterable[tuple[Any, Any]], factor: float
) -> dict[str, Any]:
    """Return horizontal bars of `factor` times the values by label, with intervals if not None."""
    scaled = [factor * value for value in values.values()]
    spans = [
        (0.0, 0.0) if low is None or high is None else (x - factor * low, factor * high - x)
        for x, (low, high) in zip(scaled, ends, strict=True)
    ]
    below, above = ([rounded(x, 4) for x in ends] for ends in zip(*spans, strict=True))
    error = {"type": "data", "arrayminus": below, "array": above, "color": INK}
    x = [rounded(value, 5) for value in scaled]
    bars = {"type": "bar", "orientation": "h", "name": name, "x": x, "y": list(values)}
    return {**bars, "error_x": {**error, "thickness": 1.5, "width": 3}}


def upright(x: float, dash: str = "dot") -> dict[str, Any]:
    """Return a vertical line over the whole height of a figure."""
    at = {"x0": x, "x1": x, "y0": 0, "y1": 1, "yref": "paper"}
    return {"type": "line", **at, "line": {"color": QUIET, "dash": dash, "width": 1}}


def rounded(x: float, digits: int = 8) -> float:
    """Return `x` with some significant digits: a page rounds it once more, to what is printed."""
    return float(f"{x:.{digits}g}")
