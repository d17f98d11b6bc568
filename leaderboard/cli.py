"""The command `road-recon`: the table of its subcommands, and error messages.

Invalid input ends with one sentence on standard error and exit code 2; `--debug` shows the
traceback.
"""

import sys
from collections.abc import Mapping
from typing import ClassVar

import typer

from leaderboard.lazy_commands import CommandEntry, LazyGroup, new_app
from road_envs import __version__

PACKAGE = "leaderboard.commands"


def _entry(target: str, text: str) -> CommandEntry:
    return CommandEntry(f"{PACKAGE}.{target}", text)


class Roads(LazyGroup):
    """Subcommands of `road-recon roads`."""

    sections: ClassVar[Mapping[str, Mapping[str, CommandEntry]]] = {
        "Commands": {
            "list": _entry(
                "roads:list_roads", "List the shipped roads, each realised with seed 1."
            ),
            "plot": _entry(
                "roads:plot_road",
                "Plot both wheel paths of a road, and their PSD over the ISO 8608 classes.",
            ),
            "export": _entry(
                "roads:export",
                "Write both wheel paths of a road to a file that can be read back as a road.",
            ),
        }
    }


roads = new_app(cls=Roads, help="List, plot and export roads.", no_args_is_help=True)


@roads.callback()
def _roads() -> None:
    """List, plot and export roads."""


class RoadRecon(LazyGroup):
    """All subcommands, with the first sentence of their docstrings."""

    sections: ClassVar[Mapping[str, Mapping[str, CommandEntry]]] = {
        "Drives and roads": {
            "simulate": _entry(
                "simulate:simulate",
                "Simulate a drive over a road and record the signals of the instruments.",
            ),
            "dataset": _entry(
                "dataset:dataset",
                "Write simulated drives with true roads as Parquet: splits, card, licence, "
                "checksums.",
            ),
            "roads": CommandEntry(roads, "List, plot and export roads."),
            "animate": _entry(
                "animate:animate",
                "Draw the vehicle on its road: ride for the first half, handling for the second.",
            ),
        },
        "Estimates": {
            "report": _entry(
                "report:report",
                "Report IRI, ISO class, condition and obstacles of a driven road: a page, CSV, "
                "GeoJSON.",
            ),
            "estimate": _entry(
                "estimate:estimate",
                "Reconstruct both wheel paths of a record; score them if the truth is given.",
            ),
            "classify": _entry(
                "estimate:classify",
                "Estimate the ISO 8608 class of the road of a record, with its probability.",
            ),
            "identify": _entry(
                "identify:identify",
                "Identify a vehicle's parameters from calibration drives, and write its file.",
            ),
            "train": _entry(
                "simulate:train", "Train an estimator on simulated or own drives and store it."
            ),
            "observability": _entry(
                "observability:observability",
                "Compute bounds on the error of an estimate by mode and speed, and plot them over "
                "frequency.",
            ),
            "new-estimator": _entry(
                "scaffold:new_estimator", "Write a small working package with a new estimator."
            ),
            "check-estimator": _entry(
                "check:check_estimator",
                "Check whether an estimator is ready for a board; exit status 1 if a check fails.",
            ),
        },
        "Leaderboard": {
            "leaderboard": _entry(
                "board:leaderboard",
                "Evaluate estimators: a result file per task and estimator, tables, and a site.",
            ),
            "run-job": _entry(
                "jobs:run_job",
                "Run one job and store its results for the next `leaderboard --out`.",
            ),
            "season": _entry(
                "hidden_seeds:season",
                "Publish the hash of a hidden test set, and later, with --reveal, its seeds.",
            ),
            "paper": _entry(
                "paper:paper",
                "Reproduce the paper: a page with its figures, and all numbers as JSON.",
            ),
        },
        "Switching policies": {
            "policies": _entry(
                "policies:policies",
                "Compare policies by comfort, handling and estimation error on held-out roads.",
            ),
            "new-policy": _entry(
                "scaffold:new_policy", "Write a small working package with a new switching policy."
            ),
            "check-policy": _entry(
                "check_policy:check_policy",
                "Check whether a policy is ready for a comparison; exit status 1 if a check fails.",
            ),
            "tune-policy": _entry(
                "policies:tune_policy", "Search the settings of a policy on training roads only."
            ),
            "train-policy": _entry(
                "policies:train_policy",
                "Train a policy with Stable-Baselines3 on training roads, evaluate it on "
                "held-out ones.",
            ),
        },
        "Speed and precision": {
            "bench": _entry(
                "bench:bench",
                "Measure speed and memory, compare with other packages, and print a table.",
            ),
            "precision": _entry(
                "precision:precision",
                "Measure error over cost of the integrators and of other packages on one drive.",
            ),
        },
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
