"""The figures of the paper, with the same line styles.

Figures 10, 11 and A.1 to A.6 each show the four networks of one training session. Sessions are
selected by the largest of their four errors (equation 12 as printed): the smallest for Figures 10
and 11, as the paper shows its near-optimal session; then the median (A.1, A.2), the upper quartile
(A.3, A.4) and the worst (A.5, A.6). Figures 10 and 11 are repeated for the car of the training on
the same road, with the session that is best there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from leaderboard.metrics.level import EQ_12_RAW, STATE_LIMITS
from leaderboard.report.plots import COLOURS, draw_classes
from road_envs.records.roughness import displacement_psd, smooth_psd
from road_envs.roads.obstacles import LAYOUTS, SIDES, Bumps
from studies.paper.study import PaperScenario, Study, training_state

OVERLAY_LENGTH = 20.0
"""Length [m] of paving shown in an overlay of profiles."""

PANEL_LETTERS = "abcdefgh"
WHEEL_PATHS = ("left", "right")
Paint = Callable[[Any], None]


@dataclass(frozen=True)
class PaperFigure:
    """A figure: `paint` fills a matplotlib figure of `size` [inch]."""

    name: str
    caption: str
    paint: Paint
    size: tuple[float, float] = (8.0, 5.6)


def paper_figures(study: Study) -> list[PaperFigure]:
    """Return all figures in the order of the paper, then the spread of the trainings."""
    sessions = dict(zip(("10", "A.1", "A.3", "A.5"), select_sessions(study), strict=True))
    bumps = [
        _bumps(scenario, f"{number}") for number, scenario in zip("6789", study.bumps, strict=True)
    ]
    paving = [
        figure
        for (name, session), second in zip(
            sessions.items(), ("11", "A.2", "A.4", "A.6"), strict=True
        )
        for figure in (_profiles(study, name, session), _densities(study, second, session))
    ]
    own = select_sessions(study, nominal=True)[0]
    on_nominal = [_profiles(study, "10", own, True), _densities(study, "11", own, True)]
    return [
        _struts(study),
        _layouts(),
        _paving(study),
        *bumps,
        *paving,
        *on_nominal,
        _spread(study),
    ]


def select_sessions(study: Study, nominal: bool = False) -> list[int]:
    """Return the numbers of the best, median, upper-quartile and worst session."""
    # a session is as good as the worst of its four networks
    worst = np.max([scenario.score_values(EQ_12_RAW, nominal) for scenario in study.paving], axis=0)
    order, last = np.argsort(worst, kind="stable"), len(worst) - 1
    return [int(order[k]) for k in (0, last // 2, (3 * last) // 4, last)]


def _struts(study: Study) -> PaperFigure:
    strut: Any = study.scenarios[0].task.vehicle.strut

    def paint(figure: Any) -> None:
        panels = figure.subplots(2, 2).ravel()
        v, x = np.linspace(-1.5, 1.5, 601), np.linspace(-0.155, 0.155, 601)
        slow = np.linspace(-0.2, 0.2, 801)
        for mode, style in (("ride", "--"), ("handling", "-")):
            panels[0].plot(v, getattr(strut.damper, mode)(v)[0], style, color="k", label=mode)
            panels[1].plot(slow, getattr(strut.friction, mode)(slow)[0], style, color="k")
        inside = x[(x > -0.15) & (x < 0.11)]
        panels[2].plot(inside, strut.bushing(inside)[0], "-", color="k")
        for axle, style in (("front", "-"), ("rear", "--")):
            panels[3].plot(x, getattr(strut.bump_stop, axle)(x)[0], style, color="k", label=axle)
        titles = ("damping", "friction", "bushing", "bump stop")
        for k, (axes, title) in enumerate(zip(panels, titles, strict=True)):
            across = "rate of extension [m/s]" if k < 2 else "extension [m]"
            axes.set(title=f"({PANEL_LETTERS[k]}) {title}", xlabel=across, ylabel="force [N]")
        panels[0].legend(frameon=False)
        panels[3].legend(frameon=False)

    caption = (
        "The strut's forces over the rate of extension and the extension: (a) damping, ride "
        "dashed and handling solid; (b) friction of both; (c) bushing; (d) bump stop, front solid "
        "and rear dashed. The values are assumed: the paper only plots its curves."
    )
    return PaperFigure("Figure 1", caption, paint)


def _layouts() -> PaperFigure:
    def paint(figure: Any) -> None:
        for k, (axes, layout) in enumerate(zip(figure.subplots(3, 1), LAYOUTS, strict=True)):
            road = Bumps(layout=layout)
            for block, middle, (_, side) in zip(
                road.blocks, road.middles, LAYOUTS[layout], strict=True
            ):
                for path in SIDES[side]:
                    s = middle + np.array([-1, -1, 1, 1]) * (
                        0.5 * block.top + np.array([block.ramp, 0, 0, block.ramp])
                    )
                    # the left path is drawn above the right one
                    z = 1000 * block.height * np.array([0, 1, 1, 0])
                    axes.fill(
                        s,
                        z / 1000 + 0.25 * (1 - path),
                        color=COLOURS[WHEEL_PATHS[path]],
                        alpha=0.85,
                    )
                axes.annotate(
                    f"{1000 * block.height:.0f} mm", (middle, 0.45), ha="center", fontsize=8
                )
            if len(road.middles) > 1:
                first, second = road.middles
                axes.annotate(
                    "", (first, -0.06), (second, -0.06), arrowprops={"arrowstyle": "<->", "lw": 0.8}
                )
                axes.annotate(
                    f"{second - first:.1f} m",
                    (0.5 * (first + second), -0.12),
                    ha="center",
                    va="top",
                    fontsize=8,
                )
            axes.set(
                title=f"({PANEL_LETTERS[k + 1]}) {layout.replace('_', ', then ')}",
                xlim=(8.0, 24.0),
                ylim=(-0.22, 0.6),
            )
            axes.set_yticks([0.0, 0.25], ["right", "left"])
        axes.set_xlabel("distance [m], heights to the same scale")

    caption = "Layouts of the bumps, seen from the side, left wheel path above the right one."
    return PaperFigure("Figure 2", caption, paint)


def _paving(study: Study) -> PaperFigure:
    truth = study.paving[0].truth

    def paint(figure: Any) -> None:
        axes = figure.subplots()
        draw_classes(axes)
        for path, z in zip(WHEEL_PATHS, truth.z, strict=True):
            axes.plot(
                *smooth_psd(*displacement_psd(z, truth.ds)), color=COLOURS[path], lw=1.4, label=path
            )
        axes.axvline(6.0, color="0.4", lw=0.8, ls=":")
        axes.annotate("cobbles", (6.0, 1e-3), (4, 0), textcoords="offset points", fontsize=8)
        axes.legend(frameon=False)

    caption = (
        "(b) Displacement spectral density of the Belgian paving over the ISO 8608 classes; its "
        "cobbles cause the peak near 6 cycles/m. Modelled on the measured cobbles of the OpenCRG "
        "sample, since the profile of the paper is not published."
    )
    return PaperFigure("Figure 3", caption, paint, (6.0, 4.2))


def _bumps(scenario: PaperScenario, number: str) -> PaperFigure:
    training = scenario.median_run()

    def paint(figure: Any) -> None:
        for side, axes in enumerate(figure.subplots(1, 2, sharey=True)):
            axes.plot(scenario.truth.s, scenario.truth.z[side], "-", color=COLOURS["truth"], lw=1.1)
            axes.plot(
                scenario.truth.s, training.z[side], "--", color=COLOURS[WHEEL_PATHS[side]], lw=1.2
            )
            error = training.scores[f"nrmse_{WHEEL_PATHS[side]}"]
            title = f"({PANEL_LETTERS[side]}) {WHEEL_PATHS[side]}, in-band error {error:.2f}"
            axes.set(title=title, xlabel="distance [m]", ylabel="height [m]")

    caption = (
        f"Bumps of scenario {scenario.number} ({scenario.condition}): actual solid, reconstructed "
        f"dashed, by the median training of {len(scenario.trainings)} (seed {training.seed}; "
        f"equation 12 {100 * training.scores[EQ_12_RAW]:.1f} %, {training.state})."
    )
    return PaperFigure(f"Figure {number}", caption, paint, (8.0, 3.0))


def _profiles(study: Study, number: str, session: int, nominal: bool = False) -> PaperFigure:
    def panel(axes: Any, scenario: PaperScenario, z: np.ndarray) -> None:
        s = scenario.truth.s
        shown = np.abs(s - 0.5 * s[-1]) < 0.5 * OVERLAY_LENGTH
        axes.plot(s[shown], 1e3 * scenario.truth.z[0, shown], "-", color=COLOURS["truth"], lw=1.0)
        axes.plot(s[shown], 1e3 * z[0, shown], "--", color=COLOURS["left"], lw=1.1)
        axes.set(xlabel="distance [m]", ylabel="height [mm]")

    return PaperFigure(
        _name(number, nominal),
        _caption(study, session, "Profiles (left wheel path, 20 m of 100 m)", nominal),
        _panels(study, session, panel, nominal),
    )


def _densities(study: Study, number: str, session: int, nominal: bool = False) -> PaperFigure:
    def panel(axes: Any, scenario: PaperScenario, z: np.ndarray) -> None:
        draw_classes(axes)
        ds = scenario.truth.ds
        axes.plot(*_mean_density(scenario.truth.z, ds), "-", color=COLOURS["truth"], lw=1.1)
        axes.plot(*_mean_density(z, ds), "--", color=COLOURS["left"], lw=1.2)
        axes.set(ylabel="density [m³]")

    return PaperFigure(
        _name(number, nominal),
        _caption(study, session, "Densities (mean of both wheel paths)", nominal),
        _panels(study, session, panel, nominal),
    )


def _name(number: str, nominal: bool) -> str:
    return f"Figure {number}{', on the car of the training' if nominal else ''}"


def _panels(
    study: Study,
    session: int,
    panel: Callable[[Any, PaperScenario, np.ndarray], None],
    nominal: bool,
) -> Paint:
    def paint(figure: Any) -> None:
        for k, (axes, scenario) in enumerate(
            zip(figure.subplots(2, 2).ravel(), study.paving, strict=True)
        ):
            training = scenario.trainings[session]
            panel(axes, scenario, training.nominal_z if nominal else training.z)
            driven = scenario.drive_label if nominal else scenario.condition
            error = scenario.score_values(EQ_12_RAW, nominal)[session]
            axes.set_title(f"({PANEL_LETTERS[k]}) {driven}: {100 * error:.1f} %", fontsize=9)

    return paint


def _caption(study: Study, session: int, what: str, nominal: bool) -> str:
    states = [
        training_state(scenario.score_values(EQ_12_RAW, nominal)[session])
        for scenario in study.paving
    ]
    return (
        f"{what}, actual solid and reconstructed dashed, of session {session + 1} of "
        f"{len(study.paving[0].trainings)}; equation 12 as printed is in each title. By it "
        f"the trainings are {', '.join(states)}."
    )


def _mean_density(z: np.ndarray, ds: float) -> tuple[np.ndarray, np.ndarray]:
    n, G = smooth_psd(*displacement_psd(z, ds))
    return n, G.mean(axis=0)


def _spread(study: Study) -> PaperFigure:
    def paint(figure: Any) -> None:
        level, shape = figure.subplots(1, 2, sharey=True)
        cars = ((False, COLOURS["left"]), (True, "0.55"))
        for k, scenario in enumerate(study.scenarios):
            for (nominal, colour), up in zip(cars, (-0.12, 0.12), strict=True):
                for axes, score, factor in ((level, EQ_12_RAW, 100.0), (shape, "nrmse", 1.0)):
                    x = np.clip(
                        factor * scenario.score_values(score, nominal), *axes_of(axes is level)
                    )
                    # the axis of scenarios is inverted: the field car is above
                    y = _jittered(k + up, x.size)
                    axes.plot(x, y, "o", color=colour, ms=3.5, alpha=0.7)
            if scenario.task.claimed_level_error is not None:
                claimed = 100 * scenario.task.claimed_level_error
                level.plot(claimed, k, "D", color=COLOURS["right"], ms=7)
            if scenario.drive_label in study.new_road:
                shape.plot(
                    study.new_road_score(scenario, "nrmse"), k, "s", color=COLOURS["right"], ms=6
                )
        for limit in STATE_LIMITS:
            level.axvline(100 * limit, color="0.6", lw=0.8, ls=":")
        shape.axvline(1.0, color="0.6", lw=0.8, ls=":")
        for axes, label in ((level, "equation 12 [%]"), (shape, "in-band NRMSE")):
            low, high = axes_of(axes is level)
            axes.set(xlabel=label, xscale="log", xlim=(0.9 * low, 1.1 * high))
            axes.xaxis.set_major_formatter("{x:g}")
        level.set_ylabel("scenario")
        level.set_yticks(
            range(len(study.scenarios)),
            [f"{scenario.number}: {scenario.drive_label}" for scenario in study.scenarios],
        )
        level.invert_yaxis()

    def axes_of(level: bool) -> tuple[float, float]:
        return (0.5, 1000.0) if level else (0.2, 20.0)

    caption = (
        "The spread of the trainings, on the field car (above) and on the car of the training "
        "(below, grey). Left: equation 12 as printed; diamonds: values of the paper; dotted: 15 "
        "and 25 %. Right: in-band error; squares: the network on new roads; dotted: a flat road. "
        "Values beyond the axes are drawn at their ends."
    )
    return PaperFigure("Spread", caption, paint, (9.0, 4.8))


def _jittered(k: float, size: int) -> np.ndarray:
    """Return positions spread around `k`, so that points do not hide each other."""
    return k + 0.1 * np.linspace(-1.0, 1.0, size)
