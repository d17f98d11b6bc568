"""Matplotlib figures as inline SVG elements that use the font of the page."""

import hashlib
import io
import re
from collections.abc import Callable
from typing import Any

from leaderboard.report.plots import make_figure
from road_envs.core.extras import optional_import

STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "roadrecon",
    "font.size": 8.5,
    "axes.linewidth": 0.6,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "path.simplify_threshold": 0.5,
}
"""Matplotlib style of the figures of a page."""


def _page_figure(paint: Callable[[Any], None], size: tuple[float, float]) -> Any:
    """Return a figure of `size` [inch] that `paint` has filled, in the STYLE of a page."""
    with optional_import("a figure"):
        import matplotlib

    with matplotlib.rc_context(STYLE):
        return make_figure(paint, size)


def inline_svg(paint: Callable[[Any], None], size: tuple[float, float]) -> str:
    """Return `_page_figure` as SVG, without size and fonts; equal figures give equal text."""
    figure, buffer = _page_figure(paint, size), io.StringIO()
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = re.sub(r"\s+", " ", svg[svg.index("<svg") :]).replace("> <", "><")
    svg = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", svg)
    svg = re.sub(r'width="[\d.]+pt" height="[\d.]+pt" ', "", svg, count=1)
    svg = re.sub(r"font-family: [^;\"]*;? ?|(?<=<g) id=\"[^\"]*\"", "", svg)
    svg = re.sub(r"(\d\.\d\d)\d+", r"\1", svg)  # two decimals are enough for a screen
    # ids must be unique in a page with several figures
    unique = hashlib.sha256(svg.encode()).hexdigest()[:8]
    return re.sub(r'((?:id="|#)[mph])([0-9a-f]{10})', rf"\g<1>{unique}\g<2>", svg)
