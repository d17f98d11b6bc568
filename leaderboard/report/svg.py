"""A matplotlib figure as an SVG element that stands inside a page and takes the page's font."""

import hashlib
import io
import re
from typing import Any

from road_envs._extras import optional_import

STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "roadrecon",
    "font.size": 8.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "path.simplify_threshold": 0.5,
}
"""How figures of a report look, on paper as in a page."""


def inline_svg(figure: Any) -> str:
    """The SVG of a figure: the same figure, the same text, with no size or fonts of its own."""
    with optional_import("a figure"):
        import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = re.sub(r"\s+", " ", svg[svg.index("<svg") :]).replace("> <", "><")
    svg = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", svg)
    svg = re.sub(r'width="[\d.]+pt" height="[\d.]+pt" ', "", svg, count=1)
    svg = re.sub(r"font-family: [^;\"]*;? ?|(?<=<g) id=\"[^\"]*\"", "", svg)
    svg = re.sub(r"(\d\.\d\d)\d+", r"\1", svg)
    unique = hashlib.sha256(svg.encode()).hexdigest()[
        :8
    ]  # names of parts, of which a page has many
    return re.sub(r'((?:id="|#)[mph])([0-9a-f]{10})', rf"\g<1>{unique}\g<2>", svg)
