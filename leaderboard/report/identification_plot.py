"""Picture of an identification: what stays unexplained, and parameters within their tolerances."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estimators.map_smoother.identification import IdentificationResult
from leaderboard.report.plots import COLOURS, write_figure


def draw_identification(result: IdentificationResult, drives: Sequence[str], path: Path) -> None:
    """Draw the unexplained spectra of the held-out readings, and the parameters with intervals."""

    def paint(figure: Any) -> None:
        spectrum, parameters = figure.subplots(1, 2, width_ratios=(1, 1.1))
        for k, (described, fitted) in enumerate(result.unexplained):
            for part, colour, what in (
                (described, COLOURS["right"], "described"),
                (fitted, COLOURS["left"], "identified"),
            ):
                label = f"{what} vehicle" if k == 0 else None
                spectrum.plot(part.f[1:], part.spectrum[1:], color=colour, lw=1.2, label=label)
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

    write_figure(paint, (12.0, 6.0), path)
