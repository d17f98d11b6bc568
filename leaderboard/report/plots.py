"""Plots for the command line and for pages; matplotlib is imported on use.

The colours are those of Okabe & Ito (2008), which colour-blind readers can distinguish.
"""

import hashlib
import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from leaderboard.metrics.heights import band_pass
from road_envs.analysis.information_bound import Posterior
from road_envs.core.atomic_io import atomic_write
from road_envs.core.extras import optional_import
from road_envs.records.record import Estimate, Profile, Record, scored_band
from road_envs.records.roughness import CLASSES, N_0, displacement_psd, smooth_psd
from road_envs.roads import Surface

if TYPE_CHECKING:
    from estimators.map_smoother.identification_result import IdentificationResult

COLOURS = {"left": "#0072B2", "right": "#D55E00", "truth": "#222222", "sensor": "#009E73"}
SIDES = ("left", "right")
_LINE_STYLES = (("#D55E00", "-"), ("#0072B2", "--"), ("#009E73", "-."), ("#CC79A7", ":"))

_SVG_STYLE: Any = {  # of the figures of a page
    "svg.fonttype": "none", "svg.hashsalt": "roadrecon", "font.size": 8.5, "axes.linewidth": 0.6,
    "axes.titlesize": 9.0, "axes.titlelocation": "left", "path.simplify_threshold": 0.5,
}  # fmt: skip


def draw_road(surface: Surface, path: Path) -> None:
    """Plot both wheel paths over distance, and their densities over the ISO 8608 classes."""
    with new_figure((11.0, 4.0)) as figure:
        heights, density = figure.subplots(1, 2, width_ratios=(2, 1))
        for side, z in zip(SIDES, surface.z, strict=True):
            heights.plot(surface.s, 1000 * z, color=COLOURS[side], lw=0.9, label=side)
            if z.any():  # a level road has no density on log axes
                n, G = smooth_psd(*displacement_psd(z, surface.ds))
                density.plot(n, G, color=COLOURS[side], lw=1.4)
        heights.set(xlabel="distance [m]", ylabel="height [mm]", title=surface.name)
        heights.legend(frameon=False)
        draw_classes(density)
        density.set_title("over the ISO 8608 classes")
    save_figure(figure, path)


def draw_classes(axes: Any) -> None:
    """Set up the axes of a density plot with the ISO 8608 classes as bands and letters."""
    n = np.array([0.02, 10.0])
    for letter, mean in CLASSES.items():
        level = mean * (n / N_0) ** -2.0
        if letter in "ACEG":
            axes.fill_between(n, 0.5 * level, 2.0 * level, color="0.93", lw=0, zorder=0)
        look = {"textcoords": "offset points", "va": "center", "color": "0.4", "fontsize": 8}
        axes.annotate(letter, (n[1], level[1]), (3, 0), **look)
    axes.set(xscale="log", yscale="log", xlim=n, ylim=(1e-10, 1e-1))
    axes.set_xlabel("spatial frequency [cycles/m]")
    axes.set_ylabel("displacement spectral density [m³]")


def draw_drive(record: Record, truth: Profile, path: Path) -> None:
    """Plot the road and the signals of the accelerometers over the front axle's station."""
    with new_figure((11.0, 1.75 * (1 + len(record.a)))) as figure:
        panels = figure.subplots(1 + len(record.a), 1, sharex=True)
        for side, z in zip(SIDES, truth.z, strict=True):
            panels[0].plot(truth.s, 1000 * z, color=COLOURS[side], lw=0.9, label=side)
        panels[0].set(ylabel="road [mm]")
        panels[0].legend(frameon=False, ncols=2, loc="upper right")
        for axes, name, a in zip(panels[1:], record.channels, record.a, strict=True):
            axes.plot(record.s, a, color=COLOURS["sensor"], lw=0.6)
            axes.set(ylabel=f"{name} [m/s²]")
        panels[-1].set(xlabel="station of the front axle [m]")
        panels[0].set_title(f"{record.v[0] * 3.6:.1f} km/h")
    save_figure(figure, path)


def estimate_figure(truth: Profile | None, estimate: Estimate, v: float) -> Any:
    """Plot both estimated wheel paths (dashed) over the truth (solid), if known: whole, and inside
    the scored band at `v` [m/s], there with the 90 % interval if it has a standard deviation.
    """
    band = scored_band(v)

    def part(profile: Profile, z: np.ndarray, inside: bool) -> tuple[np.ndarray, np.ndarray]:
        """Stations and heights of a whole path, or of what the band-pass leaves of it."""
        z = band_pass(z, profile.ds, band) if inside else z
        trim = (profile.s.size - z.size) // 2
        return profile.s[trim : trim + z.size], z

    with new_figure((11.0, 8.5)) as figure:
        panels = figure.subplots(4, 1, sharex=True)
        for axes, (side, inside) in zip(panels, product((0, 1), (False, True)), strict=True):
            colour = COLOURS[SIDES[side]]
            if truth is not None:
                s, z = part(truth, truth.z[side], inside)
                axes.plot(s, 1000 * z, color=COLOURS["truth"], lw=1.0, label="truth")
            s, z = part(estimate, estimate.z[side], inside)
            axes.plot(s, 1000 * z, "--", color=colour, lw=1.1, label="estimate")
            if inside and estimate.z_std is not None:
                # 1.645 standard deviations: 90 % of a normal distribution
                std = 1.645 * np.interp(s, estimate.s, estimate.z_std[side])
                low, high = 1000 * (z - std), 1000 * (z + std)
                axes.fill_between(s, low, high, color=colour, alpha=0.2, lw=0, label="90 %")
            axes.set(ylabel=f"{SIDES[side]}{', in band' if inside else ''} [mm]")
        for axes in panels[:2]:
            axes.legend(frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 0.98))
        panels[-1].set(xlabel="distance [m]")
        low, high = band
        panels[0].set_title(f"scored band: {low:g} to {high:.2g} cycles/m", loc="left", fontsize=10)
    return figure


def draw_observability(
    curves: Sequence[tuple[str, float, Posterior, float]], title: str, path: Path
) -> None:
    """Plot the relative error of the amplitude over n, for mean and difference of the wheel paths;
    a column for each speed, a line for each (mode, km/h, posterior, in-band NRMSE).
    """
    speeds = list(dict.fromkeys(speed for _, speed, _, _ in curves))

    with new_figure((5.5 * len(speeds) + 0.5, 7.0)) as figure:
        panels = figure.subplots(2, len(speeds), sharex=True, sharey=True, squeeze=False)
        for column, speed in zip(panels.T, speeds, strict=True):
            lines = [(mode, x, error) for mode, v, x, error in curves if v == speed]
            for axes, which in zip(column, ("mean", "difference"), strict=True):
                axes.axvspan(*scored_band(speed / 3.6), color="0.94", lw=0)
                for k, (mode, posterior, nrmse) in enumerate(lines):
                    colour, style = _LINE_STYLES[k % len(_LINE_STYLES)]
                    label = f"{mode}: {nrmse:.3f}"
                    error = posterior.relative_error(which)
                    axes.loglog(posterior.n, error, style, color=colour, lw=1.4, label=label)
                axes.grid(which="major", color="0.85", lw=0.6)
                axes.set_title(f"{which} of the wheel paths, {speed:g} km/h", fontsize=10)
            column[0].legend(
                frameon=False, fontsize=8, loc="upper left", title="front / rear: in-band NRMSE"
            )
            column[1].set_xlabel("spatial frequency [cycles/m]; scored band in grey")
        for axes in panels[:, 0]:
            axes.set(ylabel="relative error of amplitude [-]", ylim=(1e-3, 1.3))
        figure.suptitle(f"Least error with the accelerometers: {title}", fontsize=11)
    save_figure(figure, path)


def draw_identification(result: "IdentificationResult", drives: Sequence[str], path: Path) -> None:
    """Draw the unexplained spectra of the held-out readings, and the parameters with intervals."""
    with new_figure((12.0, 6.0)) as figure:
        spectrum, parameters = figure.subplots(1, 2, width_ratios=(1, 1.1))
        looks = ((COLOURS["right"], "described vehicle"), (COLOURS["left"], "identified vehicle"))
        for k, pair in enumerate(result.unexplained):
            for part, (colour, label) in zip(pair, looks, strict=True):
                own = {"color": colour, "lw": 1.2, "label": label if k == 0 else None}
                spectrum.plot(part.f[1:], part.spectrum[1:], **own)
        spectrum.set(
            xscale="log", yscale="log", xlabel="frequency [Hz]",
            ylabel="unexplained power per Hz / noise variance",
            title="held-out readings of " + ", ".join(drives),
        )  # fmt: skip
        spectrum.legend(frameon=False)
        size = result.fit.space.size
        x, std, rows = result.fit.x[:size], result.std[:size], np.arange(size)
        parameters.axvspan(-1.0, 1.0, color="0.93", lw=0)
        parameters.errorbar(x, rows, xerr=2.0 * std, fmt="o", ms=3.5, color=COLOURS["left"], lw=1.0)
        parameters.set(
            xlabel="deviation from the description, in tolerances (± 2 standard deviations)",
            ylim=(size - 0.5, -0.5), xlim=(-5.0, 5.0),
        )  # fmt: skip
        parameters.set_yticks(rows, result.names[:size], fontsize=7)
        parameters.set_title("parameters; grey: within one tolerance")
    save_figure(figure, path)


@contextmanager
def new_figure(size: tuple[float, float]) -> Iterator[Any]:
    """Yield an empty matplotlib figure of `size` [inch]."""
    with optional_import("a figure"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    yield figure
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)


def write_figure(paint: Callable[[Any], None], size: tuple[float, float], path: Path) -> None:
    """Call `paint` on a figure of `size` [inch] and write it atomically."""
    with new_figure(size) as figure:
        paint(figure)
    save_figure(figure, path)


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure in the format of the path's suffix, whole or not at all."""
    with atomic_write(path) as partial:
        figure.savefig(partial, format=path.suffix.removeprefix("."))


def inline_svg(paint: Callable[[Any], None], size: tuple[float, float]) -> str:
    """Return a figure of `size` [inch] that `paint` has filled as SVG in the _SVG_STYLE of a page,
    without size and fonts; equal figures give equal text.
    """
    with optional_import("a figure"):
        import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context(_SVG_STYLE):
        with new_figure(size) as figure:
            paint(figure)
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
