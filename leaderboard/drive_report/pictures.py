"""Pictures of a drive as SVG for a page that is read on a screen and on paper."""

import base64
from itertools import pairwise
from typing import Any

import numpy as np
from markupsafe import Markup

from leaderboard.drive_report.analysis import DriveResult
from leaderboard.drive_report.conditions import Conditions
from leaderboard.metrics.heights import band_pass
from leaderboard.report.plots import COLOURS, SIDES, draw_classes, inline_svg
from road_envs.records.record import scored_band
from road_envs.records.roughness import displacement_psd, smooth_psd

_CONDITION_COLOURS = ("#009E73", "#F0C000", "#D55E00", "#7B2D26", "#3D1410")
"""Colours of the categories, from the best: distinct by lightness, too."""

_ROWS, _ROW_LENGTH, _OVERLAP = 6, 50.0, 3.0
"""Largest number of rows of the strip, the least length [m] of one, and by how much [m] it begins
before the end of the last one and ends behind the begin of the next, so that no obstacle is cut.
"""

_STRIP_STEP, _STRIP_UNIT = 0.15, 0.1  # [m] and [mm] of heights in a page: 20 km have 0.7 MB


def condition_colours(conditions: Conditions) -> list[str]:
    """Return the colour of each category; the worst ones share the last."""
    last = len(_CONDITION_COLOURS) - 1
    return [_CONDITION_COLOURS[min(k, last)] for k in range(len(conditions.categories))]


def _drawn_paths(result: DriveResult) -> dict[str, str]:
    """Return the colours of the drawn wheel paths by name; the mean path has that of the first."""
    if result.is_mean_path:
        return {"mean of both paths": COLOURS[SIDES[0]]}
    return {side: COLOURS[side] for side in SIDES}


_Shown = tuple[np.ndarray, np.ndarray, np.ndarray | None]


def _shown_heights(result: DriveResult) -> _Shown:
    """Return chainage (M,) [m], heights without long waves by path (P, M) [mm], and their standard
    deviation (2, M) [mm], None where the method has none.
    """
    estimate, ds = result.estimate, result.estimate.ds
    band = (1.0 / 20.0, scored_band(result.v)[1])  # waves of up to 20 m
    z = 1e3 * band_pass(estimate.z, ds, band)
    trim = (estimate.s.size - z.shape[1]) // 2
    inside = slice(trim, trim + z.shape[1])
    std = None if estimate.z_std is None else 1e3 * estimate.z_std[:, inside]
    if estimate.draws is not None:
        errors = (band_pass(road - estimate.z, ds, band) for road in estimate.draws)
        std = 1e3 * np.sqrt(sum(error**2 for error in errors) / len(estimate.draws))
    return result.chainage + estimate.s[inside], z, std


def draw(result: DriveResult, conditions: Conditions, anchor: str) -> dict[str, Any]:
    """Return the pictures of a drive, and the heights that the page's script draws."""
    shown = _shown_heights(result)
    return {
        "strip": Markup(_profile_strip(result, shown)),
        "is_shaded": shown[2] is not None,
        "heights": _strip_data(result, shown),
        "iri": Markup(_iri_chart(result, conditions)),
        "density": Markup(_density_chart(result)),
        "map": Markup(_track_map(result, conditions, anchor)),
    }


def _strip_data(result: DriveResult, shown: _Shown) -> dict[str, Any]:
    """Return what the page's script draws below the row of a segment: heights in _STRIP_UNIT as
    base64 of 16-bit integers every `step` [m] from `begin` [m], by path with its colour.
    """
    (s, heights, _), stride = shown, max(1, round(_STRIP_STEP / result.estimate.ds))
    paths = [
        {
            "name": name,
            "colour": shade,
            "heights": base64.b64encode(
                np.clip(np.round(z[::stride] / _STRIP_UNIT), -32768, 32767).astype("<i2").tobytes()
            ).decode(),
        }
        for (name, shade), z in zip(_drawn_paths(result).items(), heights, strict=False)
    ]
    step = stride * result.estimate.ds
    return {"begin": float(s[0]), "step": step, "unit": _STRIP_UNIT, "paths": paths}


def _profile_strip(result: DriveResult, shown: _Shown) -> str:
    """Return the heights of both wheel paths over the chainage, with their 95 % interval."""
    (s, z, std), ds = shown, result.estimate.ds
    rows = int(np.clip(np.ceil((s[-1] - s[0]) / _ROW_LENGTH), 1, _ROWS))
    limit = 1.1 * float(np.abs(z).max()) + 1.0

    def paint(figure: Any) -> None:
        panels = np.atleast_1d(figure.subplots(rows, 1, sharey=True))
        for axes, core in zip(panels, np.array_split(np.arange(s.size), rows), strict=True):
            step, more = max(1, core.size // 1500), round(_OVERLAP / ds)  # about 1500 points
            part = np.arange(max(0, core[0] - more), min(s.size, core[-1] + 1 + more), step)
            for k, (name, shade) in enumerate(_drawn_paths(result).items()):
                axes.plot(s[part], z[k, part], color=shade, lw=0.9, label=name)
                if std is not None:
                    low, high = (z[k, part] + f * std[k, part] for f in (-1.96, 1.96))
                    axes.fill_between(s[part], low, high, color=shade, alpha=0.2, lw=0)
            for obstacle in result.obstacles:
                if s[core[0]] <= (station := obstacle["station_m"]) <= s[core[-1]]:
                    text, look = f"{obstacle['height_mm']:+.0f} mm", {"ha": "center", "va": "top"}
                    axes.annotate(text, (station, 1.35 * limit), fontsize=8, **look)
            axes.set(xlim=(s[part[0]], s[part[-1]]), ylim=(-limit, 1.4 * limit))
            axes.grid(color="0.9", lw=0.5)
        panels[0].legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0.0, 1.0))
        panels[rows // 2].set_ylabel("height [mm]")
        panels[-1].set_xlabel("chainage [m]")

    return inline_svg(paint, (8.0, 0.6 + 1.15 * rows))


def _iri_chart(result: DriveResult, conditions: Conditions) -> str:
    """Return the IRI of the segments along the road, with intervals, over the categories."""

    def paint(figure: Any) -> None:
        axes, segments = figure.subplots(), result.segments
        edges = [row["begin_m"] for row in segments] + [segments[-1]["end_m"]]
        shown = ("mean",) if result.is_mean_path else ("left", "right")
        keys = [f"iri_{path}{limit}" for path in shown for limit in ("", "_high")]
        top = 1.15 * np.nanmax([[row[key] for key in keys] for row in segments])
        limits = (0.0, *conditions.limits, max(top, 1.2 * conditions.limits[-1]))
        categories = zip(conditions.categories, condition_colours(conditions), strict=True)
        for (low, high), (name, shade) in zip(pairwise(limits), categories, strict=True):
            axes.axhspan(low, high, color=shade, alpha=0.10, lw=0)
            if min(high, top) - low > 0.07 * top:  # there is room for its name
                axes.annotate(
                    name, (edges[-1], low), (-3, 2), ha="right", va="bottom",
                    textcoords="offset points", color="0.35", fontsize=8, zorder=5,
                    bbox={"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 1},
                )  # fmt: skip
        for name, shade in _drawn_paths(result).items():
            key, label = ("hri", "HRI") if result.is_mean_path else (f"iri_{name}", name)
            values = [row[key] for row in segments]
            axes.stairs(values, edges, baseline=None, color=shade, lw=1.2, label=label)
        middle = [0.5 * (row["begin_m"] + row["end_m"]) for row in segments]
        mean = np.array([row["iri_mean"] for row in segments])
        low, high = (np.array([row[f"iri_mean_{x}"] for row in segments]) for x in ("low", "high"))
        axes.errorbar(
            middle, mean, [mean - low, high - mean], fmt="o", ms=3, color="0.1", lw=1.0,
            capsize=2, label="IRI with 95 % interval",
        )  # fmt: skip
        axes.set(xlabel="chainage [m]", ylabel="IRI [mm/m]", xlim=(edges[0], edges[-1]))
        axes.set_ylim(0.0, top)
        axes.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))

    return inline_svg(paint, (8.0, 3.0))


def _density_chart(result: DriveResult) -> str:
    """Return the displacement spectral density of both wheel paths over the ISO 8608 classes."""
    band = scored_band(result.v)

    def paint(figure: Any) -> None:
        axes = figure.subplots()
        draw_classes(axes)
        for (name, shade), z in zip(_drawn_paths(result).items(), result.estimate.z, strict=False):
            n, G = smooth_psd(*displacement_psd(z, result.estimate.ds))
            inside = (n >= 0.5 * band[0]) & (n <= band[1])
            axes.plot(n, G, color=shade, lw=0.7, alpha=0.5)
            axes.plot(n[inside], G[inside], color=shade, lw=1.6, label=name)
        for outside in ((0.02, 0.5 * band[0]), (band[1], 10.0)):
            axes.axvspan(*outside, color="0.5", alpha=0.12, lw=0)
        axes.legend(frameon=False)

    return inline_svg(paint, (4.6, 3.6))


def _track_map(result: DriveResult, conditions: Conditions, anchor: str) -> str:
    """Return the track with segments in the colour of their category; empty without positions.

    Segment k leads to the element `anchor`-k of the page, and shows its IRI under the pointer.
    """
    if result.measured.position is None:
        return ""
    lat, lon = result.measured.position
    north = 111_195.0 * (lat - lat[0])
    east = 111_195.0 * np.cos(np.radians(lat[0])) * (lon - lon[0])
    station = result.chainage + result.measured.record.s

    def paint(figure: Any) -> None:
        axes, colours = figure.subplots(), condition_colours(conditions)
        axes.plot(east, north, color="0.8", lw=6, solid_capstyle="round", zorder=1)
        for k, row in enumerate(result.segments):
            part = np.flatnonzero((station >= row["begin_m"]) & (station <= row["end_m"]))
            part = part[:: max(1, part.size // 200)]
            shade = colours[conditions.level(row["iri_mean"])]
            axes.plot(east[part], north[part], color=shade, lw=4.5, zorder=2, url=f"#{anchor}-{k}")
        for obstacle in result.obstacles:
            x, y = (np.interp(obstacle["station_m"], station, q) for q in (east, north))
            mark = "^" if obstacle["height_mm"] > 0.0 else "v"
            axes.plot(x, y, mark, color="0.1", ms=7, zorder=3)
            axes.annotate(
                f"{obstacle['height_mm']:+.0f} mm", (x, y), (9, -3),
                textcoords="offset points", fontsize=8,
            )  # fmt: skip
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.12)
        axes.set(xlabel="east of the start [m]", ylabel="north of the start [m]")
        axes.grid(color="0.92", lw=0.5)

    drawn = inline_svg(paint, (4.6, 3.6))
    for k, row in enumerate(result.segments):
        known = np.isfinite(row["iri_mean_high"])
        interval = " ({iri_mean_low:.2f} to {iri_mean_high:.2f})" if known else ""
        iri = "IRI {iri_mean:.2f}" + interval + " mm/m"
        title = ("{begin_m:.0f} to {end_m:.0f} m: " + iri + ", {condition}").format_map(row)
        link = f'<a xlink:href="#{anchor}-{k}"'
        drawn = drawn.replace(f'{link} target="_blank">', f"{link}><title>{title}</title>")
    return drawn
