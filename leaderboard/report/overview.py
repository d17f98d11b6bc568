"""Charts of the first screen of the index: the ranking as bars, one strip of road."""

from collections.abc import Iterable, Sequence

from leaderboard.evaluation.results import Result
from leaderboard.report import figures as fig
from leaderboard.report.board_definitions import BOUND_ROW, COLUMNS, ranked_kind
from leaderboard.report.charts import HEIGHT_AXES, height_lines
from leaderboard.report.rendering import file_name
from leaderboard.report.sentences import PAPER_NETWORK, scored_rows, unrelated_level_errors
from leaderboard.report.tables import Section, interval_text

_LABEL_HEIGHT = 15  # height of the label of a line [pixels]

_MARK_LABEL = {
    "y": 1, "yref": "paper", "xanchor": "right", "xshift": -2, "showarrow": False,
    "font": {"color": fig.QUIET, "size": 11}, "yanchor": "bottom",
}  # fmt: skip


def ranking_chart(section: Section) -> fig.Chart | None:
    """Return the 16 best as bars with intervals, bound and baselines as lines; None if empty."""
    if not (rows := scored_rows(section)[:16]):
        return None
    definition = section.task.board_definition
    key = definition.ranks_by
    score = COLUMNS[key]
    marks = _marked_values(section, key)
    values = [row.values[key] or 0.0 for row in rows]
    drawn = [x for x in (*values, *marks.values()) if x <= definition.scale]
    limit = min(1.08 * max(drawn, default=definition.scale), definition.scale)
    ends = [(row.values.get("low"), row.values.get("high")) for row in rows]
    labels = {
        f'<a href="estimators/{file_name(row.name)}">{row.name}</a>  '
        f"<b>{score.format_value(x)}</b>": x
        for row, x in zip(rows, values, strict=True)
    }
    pattern = {"shape": ["/" if row.causal else "" for row in rows], "fillmode": "replace"}
    bars = {
        **fig.interval_bars("entries", labels, ends, score.factor),
        "marker": {"color": [fig.colour(row.name) for row in rows], "pattern": pattern},
        "hovertext": [
            f"{row.name}: {score.text(x)}"
            + ("" if low is None else f", 95 %: {interval_text(low, high, score)}")
            for row, x, (low, high) in zip(rows, values, ends, strict=True)
        ],
        "hovertemplate": "%{hovertext}<extra></extra>",
    }
    top = 34 + _LABEL_HEIGHT * len(marks)  # [pixels] of the buttons, and of the labels below them
    label = "error" if key == "nrmse" else score.heading
    layout = {
        "height": 19 * len(rows) + top + 44,  # of bars with their gaps
        "margin": {"l": 8, "r": 12, "t": top, "b": 44},
        "showlegend": False,
        "bargap": 0.25,
        "xaxis": fig.axis(label, 0.0, fig.rounded(score.factor * limit, 4)),
        "yaxis": fig.axis("", autorange="reversed", ticks="", showgrid=False, fixedrange=True),
        "shapes": [fig.upright(score.factor * x, "dash") for x in marks.values()],
        "annotations": [  # left of its line, above the names, where there is room on any screen
            {"text": text, "x": score.factor * x, "yshift": _LABEL_HEIGHT * level, **_MARK_LABEL}
            for level, (text, x) in enumerate(marks.items())
        ],
    }
    title = f"{section.task.heading}: error of every {ranked_kind(definition)}, with 95 % intervals"
    return fig.chart(title, {"": {"data": [bars]}}, layout)


def _marked_values(section: Section, key: str) -> dict[str, float]:
    """Return bound and baselines by label, smallest first; equal ones share a label."""
    found: dict[str, tuple[list[str], float]] = {}
    for row in section.rows:
        value = row.values.get(key)
        if value is not None and row.state == "baseline":
            text = "linear bound" if row.name == BOUND_ROW else row.name.replace("_", " ")
            found.setdefault(COLUMNS[key].format_value(value), ([], value))[0].append(text)
    marks = {f"{', '.join(names)} {text}": fig.rounded(x) for text, (names, x) in found.items()}
    return dict(sorted(marks.items(), key=lambda item: item[1]))


def strip_chart(section: Section, results: Iterable[Result]) -> fig.Chart | None:
    """Return the truth against the best estimate and the paper's network; None without traces."""
    by_name = {result.estimator: result for result in results if result.traces}
    order = [row.name for row in scored_rows(section) if row.name in by_name]
    chosen = dict.fromkeys([*order[:1], *(n for n in order if n == PAPER_NETWORK), *order[1:2]])
    traces = {name: by_name[name].traces[0] for name in list(chosen)[:2]}
    if not traces:
        return None
    trace = next(iter(traces.values()))
    lines = height_lines(traces, side=0, kind="inside")
    shown = [fig.rounded(lines[0]["x0"] + x) for x in (0.0, 30.0)]  # [m] at first
    layout = {"height": 310, "margin": {"l": 56, "r": 8, "t": 34, "b": 44}, **HEIGHT_AXES}
    layout["xaxis"] = layout["xaxis"] | {"range": shown}
    driven = f"Left wheel path of {trace.road} at {trace.speed_kmh:g} km/h"
    caption = f"{driven}, in the band that the sensors observe"
    title = "Truth, best estimate and the paper's network along a road"
    return fig.chart(title, {"": {"data": lines, "caption": caption}}, layout)


def levels_chart(claims: Sequence[float]) -> fig.Chart:
    """Return the distribution of eq. 12 over unrelated roads, with errors that the paper claims."""
    errors, _ = unrelated_level_errors()
    x = [fig.rounded(error, 4) for error in sorted((100.0 * errors).tolist())]
    y = [fig.rounded(100.0 * (k + 1) / len(x), 4) for k in range(len(x))]
    hover = "%{y:.0f} % below %{x:.1f} %<extra></extra>"
    line = fig.curve("unrelated roads", x, y, line={"color": "var(--line-1)"}, hovertemplate=hover)
    layout = {
        "height": 280,
        "showlegend": False,
        "xaxis": fig.axis("level error, eq. 12 [%]", 0.0, 40.0),
        "yaxis": fig.axis("unrelated roads below [%]", 0.0, 100.0),
        "shapes": [fig.upright(100.0 * claim) for claim in claims],
    }
    return fig.chart("Level error of unrelated roads", {"": {"data": [line]}}, layout)
