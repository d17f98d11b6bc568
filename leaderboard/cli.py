"""The command `road-recon`: the table of its subcommands, and error messages.

Invalid input ends with one sentence on standard error and exit code 2; `--debug` shows the
traceback.
"""

import sys
from typing import ClassVar

import typer

from leaderboard.lazy_commands import LazyGroup, Sections, new_app
from road_envs import __version__


class Roads(LazyGroup):
    """Subcommands of `road-recon roads`."""

    sections: ClassVar[Sections] = {
        "Commands": {
            "list": "roads:list_roads",
            "plot": "roads:plot_road",
            "export": "roads:export",
        }
    }


roads = new_app(cls=Roads, help="List, plot and export roads.", no_args_is_help=True)


@roads.callback()
def _roads() -> None:
    """List, plot and export roads."""


class RoadRecon(LazyGroup):
    """All subcommands."""

    sections: ClassVar[Sections] = {
        "Drives and roads": {
            "simulate": "simulate:simulate",
            "dataset": "dataset:dataset",
            "roads": roads,
            "animate": "animate:animate",
        },
        "Estimates": {
            "report": "report:report",
            "estimate": "estimate:estimate",
            "classify": "estimate:classify",
            "identify": "identify:identify",
            "train": "simulate:train",
            "observability": "observability:observability",
            "new-estimator": "scaffold:new_estimator",
            "check-estimator": "check:check_estimator",
        },
        "Leaderboard": {
            "leaderboard": "board:leaderboard",
            "run-job": "jobs:run_job",
            "verify": "verify:verify",
            "season": "hidden_seeds:season",
            "clean": "clean:clean",
        },
        "Switching policies": {
            "policies": "policies:policies",
            "new-policy": "scaffold:new_policy",
            "check-policy": "check_policy:check_policy",
            "tune-policy": "policies:tune_policy",
            "train-policy": "policies:train_policy",
        },
        "Speed and precision": {"bench": "bench:bench", "precision": "precision:precision"},
    }


HELP = "Road profile reconstruction from vehicle responses: simulate, train, estimate, evaluate."
app = new_app(cls=RoadRecon, help=HELP, no_args_is_help=True)


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
    pass


def main() -> None:
    """Run the command line; the entry point of the package."""
    try:
        app(prog_name="road-recon")
    except Exception as error:
        if "--debug" in sys.argv or not _is_input_error(error):
            raise
        sys.stderr.write(f"error: {_sentence(error)}\n")
        raise SystemExit(2) from None


def _is_input_error(error: Exception) -> bool:
    """Return whether an error is caused by invalid input, and reported without traceback."""
    from estimators.api import NotFittedError
    from road_envs.simulation.drive import SimulationError

    return isinstance(error, NotFittedError | SimulationError | ValueError | OSError)


def _sentence(error: BaseException) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    main()
