"""The page's drawings: small SVG panels without fixed colours, so that the page's style rules.

Lines are drawn in marker colours, which become CSS variables; text takes the page's font.
"""

import hashlib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.metrics import band_pass, scored_band
from leaderboard.results import Trace
from road_envs.roughness import CLASSES, N_0, dsd, smooth

VARIABLES = {
    "#010101": "currentColor",
    "#020202": "var(--faint)",
    "#030303": "var(--band)",
    "#1a0001": "var(--series-1)",
    "#1a0002": "var(--series-2)",
    "#1a0003": "var(--series-3)",
    "#1a0004": "var(--series-4)",
}
INK, FAINT, BAND, *SERIES = VARIABLES
SIDES = ("Left", "Right")
WINDOW = 20.0
"""Length [m] of a random road that an overlay shows, as in the paper's Figure 10."""

STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "roadrecon",
    "font.size": 8.0,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "path.simplify_threshold": 0.5,
}


def overlay(trace: Trace, side: int, series: int = 0) -> str:
    """Truth (solid) and estimate (dashed) of one wheel path; the paper's Figures 6 to 10.

    Heights about their median, for no accelerometer sees the datum; a random road is cut to 20 m.
    """
    y, a = (1e3 * (z[side] - np.median(z[side])) for z in (trace.z_true, trace.z_estimated))
    shown = _window(trace.s)
    error = trace.scores["level_error_left" if side == 0 else "level_error_right"]
    title = f"{SIDES[side]} wheel path, eq. 12: {_percent(error)}"
    return _overlay(trace.s[shown], y[shown], a[shown], title, "height [mm]", series)


def band_overlay(trace: Trace, side: int, name: str, series: int = 0) -> str:
    """As `overlay`, after the band-pass in which an estimate is judged."""
    band = scored_band(trace.speed_kmh / 3.6)
    y, a = (1e3 * band_pass(z, trace.ds, band)[side] for z in (trace.z_true, trace.z_estimated))
    s = trace.s[(trace.s.size - y.size) // 2 :][: y.size]
    shown = _window(s)
    r, error = trace.scores["r"], trace.scores["nrmse"]
    title = f"{name}: error {_number(error)}, r {_number(r)}"
    return _overlay(s[shown], y[shown], a[shown], title, "height in band [mm]", series)


def spectra(traces: Mapping[str, Trace]) -> str:
    """Densities of the truth (solid) and of the named estimates (dashed) over the ISO 8608 classes.

    The paper's Figure 11; each is the mean of both wheel paths, smoothed as ISO 8608 says.
    """
    first = next(iter(traces.values()))
    band = scored_band(first.speed_kmh / 3.6)

    def paint(axes: Any) -> None:
        _draw_classes(axes)
        for edge in band:
            axes.axvline(edge, color=FAINT, lw=0.6, ls=":")
        axes.loglog(*_density(first.z_true, first.ds), color=INK, lw=1.2, label="truth")
        for k, (name, trace) in enumerate(traces.items()):
            n, G = _density(trace.z_estimated, trace.ds)
            axes.loglog(n, G, color=SERIES[k], lw=1.2, ls=(0, (4, 1.5)), label=name)
        axes.legend(frameon=False, fontsize=7, loc="lower left", handlelength=2.4)
        axes.set_title(first.condition)

    return _svg(paint, (3.6, 2.5))


def levels(errors: np.ndarray, claims: Sequence[float]) -> str:
    """Share of unrelated roads below each level error, and the paper's claims on the same axis."""

    def paint(axes: Any) -> None:
        x = 100.0 * np.sort(errors)
        share = np.arange(1, x.size + 1) / x.size
        axes.plot(x, 100.0 * share, color=SERIES[0], lw=1.6)
        for claim in claims:
            axes.axvline(100.0 * claim, color=INK, lw=0.8)
        if claims:
            low, high = 100.0 * min(claims), 100.0 * max(claims)
            axes.text(high + 0.7, 8.0, f"paper: {low:.1f} to {high:.1f} %", fontsize=7.5)
        axes.set(
            xlabel="level error, eq. 12 [%]",
            ylabel="unrelated roads below [%]",
            xlim=(0.0, 40.0),
            ylim=(0.0, 100.0),
        )

    return _svg(paint, (3.8, 2.6))


def _overlay(
    s: np.ndarray, y: np.ndarray, a: np.ndarray, title: str, label: str, series: int
) -> str:
    def paint(axes: Any) -> None:
        axes.plot(s, y, color=INK, lw=1.1)
        axes.plot(s, a, color=SERIES[series], lw=1.2, ls=(0, (4, 1.5)))
        axes.set(xlabel="distance [m]", ylabel=label, title=title, xlim=(s[0], s[-1]))
        axes.locator_params(axis="x", nbins=6, integer=True)
        reach = 1.15 * max(np.ptp(y), 1e-9)
        middle = 0.5 * (y.max() + y.min())
        low, high = max(a.min(), middle - 1.5 * reach), min(a.max(), middle + 1.5 * reach)
        axes.set_ylim(min(low, middle - 0.6 * reach), max(high, middle + 0.6 * reach))

    return _svg(paint, (3.6, 2.5))


def _window(s: np.ndarray) -> slice:
    """The middle 20 m of a long stretch; all of a short one, such as a road with bumps."""
    ds = s[1] - s[0]
    if s.size * ds < 2.5 * WINDOW:
        return slice(None)
    first = int((0.5 * s.size * ds - 0.5 * WINDOW) / ds)
    return slice(first, first + int(WINDOW / ds))


def _density(z: np.ndarray, ds: float) -> tuple[np.ndarray, np.ndarray]:
    n, G = smooth(*dsd(z, ds))
    G = G.mean(axis=0)
    return n[G > 0.0], G[G > 0.0]


def _draw_classes(axes: Any) -> None:
    """Every other class as a band, and the letters of all at the right end of the axes."""
    n = np.array([0.05, 8.0])
    for k, (letter, mean) in enumerate(CLASSES.items()):
        level = mean * (n / N_0) ** -2.0
        if k % 2 == 0:
            axes.fill_between(n, 0.5 * level, 2.0 * level, color=BAND, lw=0)
        axes.text(n[1] * 1.1, level[1], letter, fontsize=7, ha="left", va="center")
    axes.set(
        xlabel="spatial frequency [cycles/m]",
        ylabel="density [m³]",
        xlim=n,
        ylim=(1e-9, 1e-1),
    )


def _svg(paint: Callable[[Any], None], size: tuple[float, float]) -> str:
    """What `paint` draws on axes of `size` [inch], as an SVG element to stand inside a page."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    buffer = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure = Figure(size, layout="constrained")
        FigureCanvasSVG(figure)
        paint(figure.subplots())
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    return _for_page(buffer.getvalue())


def _for_page(svg: str) -> str:
    """An SVG file as an element: no size, fonts, styles or names of its own, two decimals."""
    svg = re.sub(r"\s+", " ", svg[svg.index("<svg") :]).replace("> <", "><")
    svg = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", svg)
    svg = re.sub(r'width="[\d.]+pt" height="[\d.]+pt" ', "", svg, count=1)
    svg = re.sub(r"font-family: [^;\"]*;? ?|(?<=<g) id=\"[^\"]*\"", "", svg)
    svg = re.sub(r"(\d\.\d\d)\d+", r"\1", svg)
    unique = hashlib.sha256(svg.encode()).hexdigest()[:8]
    svg = re.sub(r'((?:id="|#)[mph])([0-9a-f]{10})', rf"\g<1>{unique}\g<2>", svg)
    for marker, variable in VARIABLES.items():
        svg = svg.replace(marker, variable)
    return svg


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100.0 * value:.1f} %"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
