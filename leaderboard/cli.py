"""The command `road-recon`: the table of its subcommands, which are imported when they are called.

The help of a group shows the docstrings of its commands as they stand in their files, so
`road-recon --help` imports no command. Invalid input ends with one sentence on standard error and
exit code 2; `--debug` shows the traceback.
"""

import ast
import codecs
import io
import re
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup

from road_envs import __version__

Sections = Mapping[str, Mapping[str, str | type]]
"""By heading of the help and name: "module:function" of `leaderboard.commands`, or a group."""

OPTION_SECTIONS = {
    "Drive": ("road", "speed_kmh", "mode", "length", "vehicle", "sensors", "grade"),
    "Measured drive": (
        "at", "track", "columns", "units", "invert", "offset", "description", "save_description",
    ),
    "Running": (
        "seed", "seeds", "workers", "dask", "plan", "again", "probes", "isolation", "time_limit",
        "memory_limit",
    ),
    "Output": ("out", "plot", "json"),
}  # fmt: skip
"""Options of all commands, by heading of the help; others come first, as "Options"."""

_SECTION_OF = {name: title for title, names in OPTION_SECTIONS.items() for name in names}


class _SectionedCommand(TyperCommand):
    """A command whose options are listed in the sections of OPTION_SECTIONS."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        sections: dict[str, list[Any]] = {x: [] for x in ("Arguments", "Options", *OPTION_SECTIONS)}
        for parameter in self.get_params(ctx):
            if (record := parameter.get_help_record(ctx)) is not None:
                is_option = parameter.param_type_name == "option"
                title = _SECTION_OF.get(parameter.name, "Options") if is_option else "Arguments"
                sections[title].append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


class _LazyGroup(TyperGroup):
    """A group of commands; a subclass sets its `sections`, and its docstring is the help."""

    sections: ClassVar[Sections] = {}

    def __init__(self, *args: Any, **settings: Any):
        super().__init__(*args, **settings)
        # names only, for listing and for suggestions: a command is imported when it is called
        self.commands: Any = {n: x for part in self.sections.values() for n, x in part.items()}

    def get_command(self, ctx: Any, name: str) -> Any:
        """Import and build a command; None if there is none of this name."""
        return _build(name, self.commands[name]) if name in self.commands else None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        for title, entries in self.sections.items():
            with formatter.section(title):
                formatter.write_dl([(name, _help_line(target)) for name, target in entries.items()])

    def invoke(self, ctx: Any) -> Any:
        """Run a command; SIGINT ends it with one sentence and exit status 130."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            typer.echo(f"interrupted: {error}" if str(error) else "interrupted", err=True)
            raise typer.Exit(130) from None  # 128 and the number of SIGINT, as shells have it


def _help_line(target: str | type) -> str:
    """Return the first paragraph of the docstring of a command, or the docstring of a group."""
    if isinstance(target, type):
        return str(target.__doc__)
    module, _, function = target.partition(":")
    path = Path(__file__).parent / "commands" / f"{module}.py"
    nodes = ast.parse(path.read_text(encoding="utf-8")).body
    texts = {n.name: ast.get_docstring(n) for n in nodes if isinstance(n, ast.FunctionDef)}
    return " ".join((texts[function] or "").partition("\n\n")[0].split())


def _build(name: str, target: str | type) -> Any:
    if isinstance(target, type):
        group = _new_app(name=name, cls=target, help=target.__doc__, no_args_is_help=True)
        group.callback()(lambda: None)
        return typer.main.get_command(group)
    module, _, function = target.partition(":")
    from leaderboard.commands.output import as_command

    app, found = _new_app(), getattr(import_module(f"leaderboard.commands.{module}"), function)
    app.command(name, cls=_SectionedCommand)(as_command(found))
    return typer.main.get_command(app)


def _new_app(**settings: Any) -> typer.Typer:
    """Return an app whose help texts keep brackets, as in units [m], which markup would eat."""
    return typer.Typer(
        add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False, **settings
    )


class _Roads(_LazyGroup):
    """List, plot and export roads."""

    sections: ClassVar[Sections] = {
        "Commands": {
            "list": "roads:list_roads",
            "plot": "roads:plot_road",
            "export": "roads:export",
        }
    }


class _RoadRecon(_LazyGroup):
    """All subcommands."""

    sections: ClassVar[Sections] = {
        "Drives and roads": {
            "simulate": "simulate:simulate",
            "dataset": "dataset:dataset",
            "roads": _Roads,
            "animate": "animate:animate",
        },
        "Names": {"list": "listing:list_names"},
        "Estimates": {
            "report": "report:report",
            "iri": "roads:iri",
            "export": "roads:export_heights",
            "estimate": "estimate:estimate",
            "classify": "estimate:classify",
            "identify": "identify:identify",
            "new-vehicle": "new:new_vehicle",
            "train": "train:train",
            "observability": "observability:observability",
            "new-estimator": "new:new_estimator",
            "check-estimator": "check:check_estimator",
        },
        "Leaderboard": {
            "leaderboard": "board:leaderboard",
            "run-job": "results:run_job",
            "verify": "results:verify",
            "score": "results:score",
            "season": "results:season",
            "cite": "results:cite",
            "clean": "results:clean",
        },
        "Results repositories": {
            "submit": "submit:submit",
            "verify-submission": "submit:verify_one",
            "new-results-repo": "submit:new_results_repo",
            "results-site": "submit:results_site",
        },
        "Switching policies": {
            "policies": "policies:policies",
            "new-policy": "new:new_policy",
            "check-policy": "check:check_policy",
            "train-policy": "policies:train_policy",
        },
    }


_HELP = "Road profile reconstruction from vehicle responses: simulate, train, estimate, evaluate."
app = _new_app(cls=_RoadRecon, help=_HELP, no_args_is_help=True)


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
    for stream in (sys.stdout, sys.stderr):  # in the locale C: sentences and tables need more
        if isinstance(stream, io.TextIOWrapper) and codecs.lookup(stream.encoding).name == "ascii":
            stream.reconfigure(encoding="utf-8")
    try:
        status = app(prog_name="road-recon", standalone_mode=False)
    except Exception as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()  # type: ignore[attr-defined]
        elif isinstance(error, typer.Abort):
            sys.stderr.write("error: a question was left open: give its answer as an option\n")
        elif isinstance(error, _USAGE_ERROR):
            sys.stderr.write(f"error: {_usage_sentence(error)}\n")
        elif "--debug" in sys.argv or not _is_input_error(error):
            raise
        else:
            said = "".join(c if c.isprintable() else " " for c in _sentence(error))
            sys.stderr.write(f"error: {said}\n")  # names in files may hold commands of a terminal
        raise SystemExit(2) from None
    raise SystemExit(status or 0)


_USAGE_ERROR: Any = typer.BadParameter.__mro__[1]  # of a command line's words; Typer hides it

_PARSER_WORDS = (
    (r"Input should be a valid integer.*|.* is not a valid int.*", "must be a whole number"),
    (r"Input should be a valid number.*|.* is not a valid float.*", "must be a number"),
    (r"Input should be greater than or equal to (\S+)", r"must be at least \1"),
    (r"\S+ is not in the range x>=(\S+)", r"must be at least \1"),
    (r"Input should be less than or equal to (\S+)", r"must be at most \1"),
    (r"\S+ is not in the range (\S+)<=x<=(\S+)", r"must be from \1 to \2"),
    (r"Input should be (.*)", r"must be \1"),
)
"""What Typer writes of a value, by its version, and the words of this package's messages."""


def _usage_sentence(error: Any) -> str:
    """Return one sentence on words that the command line does not understand."""
    text = " ".join(error.format_message().split()).removesuffix(".")
    text = text.replace("'. Did you mean", "': did you mean")
    text = text[:1].lower() + text[1:]
    if found := re.fullmatch(r"invalid value for '(.+?)'(?: /.*?)?: (.*)", text):
        option, text = found[1], found[2]
        for pattern, words in _PARSER_WORDS:
            text = re.sub(pattern, words, text)
        text = f"{option} {text}" + _given(option)
    context = getattr(error, "ctx", None)
    command = context.command_path if context else "road-recon"
    return f"{text}; try '{command} --help'"


def _given(option: str) -> str:
    """Return what was given for an option; empty if it cannot be found."""
    words = sys.argv[1:]
    for k, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name == option and (equals or k + 1 < len(words)):
            return f", got {(value if equals else words[k + 1])!r}"
    return ""


def _is_input_error(error: Exception) -> bool:
    """Return whether an error is caused by invalid input, and reported without traceback."""
    from estimators.api import NotFittedError
    from road_envs.core.extras import MissingExtraError
    from road_envs.simulation.drive import SimulationError

    known = NotFittedError | SimulationError | MissingExtraError | ValueError | OSError
    return isinstance(error, known | MemoryError)


def _sentence(error: BaseException) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    said = " ".join(str(error).split())
    if isinstance(error, OSError):
        return f"the operating system refused a request: {error.strerror or said}"
    if isinstance(error, MemoryError):
        return f"not enough memory ({said or 'no size given'}): give less data, or fewer --workers"
    return said


if __name__ == "__main__":
    main()
