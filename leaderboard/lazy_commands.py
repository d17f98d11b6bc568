"""Command groups that import the module of a command when it is called, and help in sections.

The help of a group is read from its table, so `road-recon --help` imports no command.
"""

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any, ClassVar, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

INTERRUPTED = 130
"""Exit status after SIGINT: 128 and the number of the signal, as shells have it."""


class CommandEntry(NamedTuple):
    """A command of a group: "module:function" or a Typer app, and its line in the help."""

    target: str | typer.Typer
    help: str


OPTION_SECTIONS = {
    "Drive": ("road", "speed_kmh", "mode", "length", "vehicle", "sensors", "grade"),
    "Running": (
        "seed", "seeds", "workers", "dask", "plan", "again", "probes", "isolation", "time_limit",
        "memory_limit", "checkpoint", "log",
    ),
    "Output": ("out", "plot", "wide", "json"),
}  # fmt: skip
"""Options of all commands, by heading of the help; others come first, as "Options"."""

_SECTION_OF = {name: title for title, names in OPTION_SECTIONS.items() for name in names}


class SectionedCommand(TyperCommand):
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


class _Commands(Mapping):
    """Commands by name, each imported and built when it is looked up."""

    def __init__(self, entries: Mapping[str, CommandEntry]):
        self._entries, self._built = entries, dict[str, Any]()

    def __getitem__(self, name: str) -> Any:
        if name not in self._built:
            self._built[name] = _build(name, self._entries[name].target)
        return self._built[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


class LazyGroup(TyperGroup):
    """A group of commands from a table; a subclass sets `sections`."""

    sections: ClassVar[Mapping[str, Mapping[str, CommandEntry]]] = {}
    """Commands by name, by heading of the help."""

    def __init__(self, *args: Any, **settings: Any):
        super().__init__(*args, **settings)
        entries = {n: entry for section in self.sections.values() for n, entry in section.items()}
        self.commands: Any = _Commands(entries)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands, without importing them."""
        return list(self.commands)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands by section."""
        for title, entries in self.sections.items():
            with formatter.section(title):
                formatter.write_dl([(name, entry.help) for name, entry in entries.items()])

    def invoke(self, ctx: Any) -> Any:
        """Run a command; SIGINT ends it with one sentence and exit status 130."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            typer.echo(f"interrupted: {error}" if str(error) else "interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from None


def _build(name: str, target: str | typer.Typer) -> Any:
    if isinstance(target, typer.Typer):
        command = typer.main.get_command(target)
        command.name = name
        return command
    module, _, function = target.partition(":")
    app = new_app()
    app.command(name, cls=SectionedCommand)(getattr(import_module(module), function))
    return typer.main.get_command(app)


def new_app(**settings: Any) -> typer.Typer:
    """Return a Typer app without completion, markup and decorated tracebacks.

    Help texts have brackets, as in units [m] and extras road-envs[dask], which markup would eat.
    """
    return typer.Typer(
        add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False, **settings
    )
