"""Speed and memory compared with other packages on the same problems.

    python -m studies.bench [--json]

Absolute times on a shared machine are unreliable, so comparisons are ratios of medians of one run.
"""

from collections.abc import Callable
from typing import Any

import typer
from rich.table import Table

from leaderboard.commands import notices, progress_bar
from leaderboard.commands.output import Output, as_command
from studies.bench import estimator_speed, side_motion, speed, start_up
from studies.bench.identification_speed import identification_speed


def bench() -> Output:
    """Measure speed and memory, compare with other packages, and print a table."""
    parts: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "integrators": speed.integrator_speed,
        "lanes": speed.fleet_throughput,
        "side motion": side_motion.side_motion_cost,
        "environment": speed.environment_overhead,
        "policies": speed.training_cost,
        "training": estimator_speed.training,
        "estimators": estimator_speed.estimator_speed,
        "board": estimator_speed.full_board,
        "passes": estimator_speed.several_passes,
        "identification": identification_speed,
        "start-up": start_up.start_up_cost,
        "memory": estimator_speed.drives_memory,
    }
    rows = []
    with progress_bar() as progress:
        for k, (name, part) in enumerate(parts.items()):
            progress(name, k / len(parts))
            rows += part()
    table = Table("what", "measured", "aim", "", title="bench", box=None)
    for row in rows:
        verdict = {True: "met", False: "MISSED", None: ""}[row["met"]]
        table.add_row(row["what"], row["measured"], row["aim"], verdict)
    for row in rows:
        if "why" in row:
            notices.print(f"{row['what']}: {row['why']}")
    return Output(facts=rows, shows=[table])


if __name__ == "__main__":
    typer.run(as_command(bench))
