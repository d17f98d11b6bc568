"""Command groups that import the module of a command when it is called, and help in sections.

The help of a group shows the docstrings of its commands as they stand in their files, so
`road-recon --help` imports no command.
"""

import ast
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup

_INTERRUPTED = 130  # exit status after SIGINT: 128 and the number of the signal, as shells have it

_PACKAGE = "leaderboard.commands"

Sections = Mapping[str, Mapping[str, str | type]]
"""Commands by name, by heading of the help: "module:function" of _PACKAGE, or a LazyGroup."""


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
        """Write the sections."""
        titles = ("Arguments", "Options", *OPTION_SECTIONS)
        sections: dict[str, list[tuple[str, str]]] = {title: [] for title in titles}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                is_option = parameter.param_type_name == "option"
                title = _SECTION_OF.get(parameter.name, "Options") if is_option else "Arguments"
                sections[title].append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


class LazyGroup(TyperGroup):
    """A group of commands; a subclass sets its `sections`, and its docstring is the help."""

    sections: ClassVar[Sections] = {}

    def __init__(self, *args: Any, **settings: Any):
        super().__init__(*args, **settings)
        # names only, for listing and for suggestions: a command is imported when it is called
        entries = {n: entry for section in self.sections.values() for n, entry in section.items()}
        self.commands: Any = entries

    def get_command(self, ctx: Any, name: str) -> Any:
        """Import and build a command; None if there is none of this name."""
        return _build(name, self.commands[name]) if name in self.commands else None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands by section."""
        for title, entries in self.sections.items():
            with formatter.section(title):
                formatter.write_dl([(name, _help_line(target)) for name, target in entries.items()])

    def invoke(self, ctx: Any) -> Any:
        """Run a command; SIGINT ends it with one sentence and exit status 130."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            typer.echo(f"interrupted: {error}" if str(error) else "interrupted", err=True)
            raise typer.Exit(_INTERRUPTED) from None


def _help_line(target: str | type) -> str:
    """Return the first paragraph of the docstring of a command, or the docstring of a group."""
    if isinstance(target, type):
        return str(target.__doc__)
    module, _, function = target.partition(":")
    path = Path(__file__).parent / _PACKAGE.rpartition(".")[2] / f"{module}.py"
    nodes = ast.parse(path.read_text(encoding="utf-8")).body
    texts = {n.name: ast.get_docstring(n) for n in nodes if isinstance(n, ast.FunctionDef)}
    return " ".join((texts[function] or "").partition("\n\n")[0].split())


def _build(name: str, target: str | type) -> Any:
    if isinstance(target, type):
        group = new_app(name=name, cls=target, help=target.__doc__, no_args_is_help=True)
        group.callback()(lambda: None)
        return typer.main.get_command(group)
    module, _, function = target.partition(":")
    from leaderboard.commands.output import as_command

    app, found = new_app(), getattr(import_module(f"{_PACKAGE}.{module}"), function)
    app.command(name, cls=_SectionedCommand)(as_command(found))
    return typer.main.get_command(app)


def new_app(**settings: Any) -> typer.Typer:
    """Return a Typer app without completion, markup and decorated tracebacks.

    Help texts have brackets, as in units [m] and extras road-envs[dask], which markup would eat.
    """
    return typer.Typer(
        add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False, **settings
    )
