"""The command `road-recon`: registration of subcommands, and error messages.

Invalid input ends with one sentence on standard error and exit code 2; `--debug` shows the
traceback.
"""

import sys

import typer

from estimators.api import EstimateError, NotFittedError
from leaderboard.commands import (
    animate,
    bench,
    board,
    check,
    estimate,
    hidden_seeds,
    jobs,
    observability,
    paper,
    policies,
    precision,
    roads,
    scaffold,
    simulate,
)
from road_envs import __version__
from road_envs.config import ConfigError
from road_envs.simulation.drive import SimulationError

INPUT_ERRORS = (ConfigError, EstimateError, NotFittedError, SimulationError, ValueError, OSError)
"""Errors caused by invalid input, which are reported without traceback."""

app = typer.Typer(
    help="Road profile reconstruction from vehicle responses: simulate, train, estimate, evaluate.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,  # help texts have brackets: units [m], extras road-envs[dask]
)
app.command("simulate")(simulate.simulate)
app.command("train")(simulate.train)
app.command("estimate")(estimate.estimate)
app.command("classify")(estimate.classify)
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


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"road-recon {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    debug: bool = typer.Option(False, "--debug", help="Show the traceback of an error."),
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """Road profile reconstruction from vehicle responses: simulate, train, estimate, evaluate."""


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
