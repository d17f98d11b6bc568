"""The command `road-recon`: its subcommands, and how an error is said.

Bad input ends with one sentence on standard error and exit code 2; `--debug` adds the traceback.
"""

import sys

import typer

from estimators.api import EstimateError, NotFittedError
from leaderboard.commands import (
    animate,
    bench,
    board,
    check,
    hidden_seeds,
    jobs,
    observability,
    paper,
    policies,
    precision,
    roads,
    scaffold,
)
from leaderboard.commands import (
    estimate as reconstruct,
)
from leaderboard.commands import (
    simulate as drives,
)
from road_envs.config import ConfigError
from road_envs.simulation.drive import SimulationError

INPUT_ERRORS = (ConfigError, EstimateError, NotFittedError, SimulationError, ValueError, OSError)
"""Errors that are about the input, not about the program."""

app = typer.Typer(
    help="Road profile reconstruction from vehicle responses: simulate, train, estimate, judge.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command("simulate")(drives.simulate)
app.command("train")(drives.train)
app.command("estimate")(reconstruct.estimate)
app.command("classify")(reconstruct.classify)
app.command("leaderboard")(board.leaderboard)
app.command("paper")(paper.paper)
app.command("season")(hidden_seeds.season)
app.command("run-job")(jobs.run_job)
app.command("policies")(policies.policies)
app.command("tune-policy")(policies.tune_policy)
app.command("train-policy")(policies.train_policy)
app.add_typer(roads.app, name="roads")
app.command("animate")(animate.animate)
app.command("bench")(bench.bench)
app.command("precision")(precision.precision)
app.command("observability")(observability.observability)
app.command("new-estimator")(scaffold.new_estimator)
app.command("check-estimator")(check.check_estimator)


@app.callback()
def _options(
    debug: bool = typer.Option(False, "--debug", help="Show the traceback of an error."),
) -> None:
    """Road profile reconstruction from vehicle responses: simulate, train, estimate, judge."""


def main() -> None:
    """Run the command line; the entry point of the package."""
    try:
        app(prog_name="road-recon")
    except INPUT_ERRORS as error:
        if "--debug" in sys.argv:
            raise
        sys.stderr.write(f"error: {_sentence(error)}\n")
        raise SystemExit(2) from None


def _sentence(error: BaseException) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    main()
