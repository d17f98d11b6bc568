"""Registry of classes by name: those of this package, and plug-ins of other packages.

A plug-in is an entry point that an installed package declares in the group of the registry.
"""

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Any, Generic, TypeVar

from road_envs.core.config import ConfigError, build, validate_choice

T = TypeVar("T")


class PluginWarning(UserWarning):
    """Warning that a plug-in of another package is skipped, with the reason."""


class Registry(Generic[T]):
    """Dataclasses of settings by name, of the given `kind` ("estimator") and entry-point `group`.

    `check` returns a plug-in class, or raises an exception if it has not the interface.
    """

    def __init__(
        self, kind: str, group: str, classes: Mapping[str, type[T]], check: Callable[[Any], type[T]]
    ):
        self.kind, self.group, self.classes, self.check = kind, group, classes, check

    def available(self) -> dict[str, type[T]]:
        """Return all classes by name, those of other packages included.

        A plug-in that cannot be loaded is skipped with a PluginWarning. Raises ConfigError.
        """
        classes = dict(self.classes)
        for name, entry in self._plugins().items():
            try:
                classes[name] = self.check(entry.load())
            except Exception as error:  # a faulty package must not disable the other plug-ins
                text = f"the {self.kind} {name!r} of {entry.value} is skipped"
                reason = f"{type(error).__name__}: {error}"
                warnings.warn(f"{text}: {reason}", PluginWarning, stacklevel=2)
        return classes

    def names(self) -> list[str]:
        """Return all names without loading other packages. Raises ConfigError."""
        return [*self.classes, *self._plugins()]

    def find(self, name: str) -> type[T]:
        """Return the class `name`, loading its package only. Raises ConfigError."""
        plugins = self._plugins()
        validate_choice(self.kind, name, [*self.classes, *plugins])
        if name in self.classes:
            return self.classes[name]
        try:
            return self.check(plugins[name].load())
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise ConfigError(
                f"the {self.kind} {name!r} of {plugins[name].value} cannot be used: {reason}"
            ) from error

    def entry_point(self, name: str) -> str:
        """Return "module:Class" of a plug-in, without loading it. Raises ConfigError."""
        return self._plugins()[validate_choice(self.kind, name, list(self._plugins()))].value

    def create(self, name: str, settings: Mapping[str, Any], defaults: Mapping[str, Any]) -> T:
        """Return an object with these `settings`, which override `defaults`. Raises ConfigError."""
        cls: Any = self.find(name)
        known = [field.name for field in dataclasses.fields(cls) if field.init]
        for setting in settings:
            validate_choice(f"setting of {name}", setting, known)
        return build(cls, {**defaults, **settings}, name)

    def _plugins(self) -> dict[str, metadata.EntryPoint]:
        """Entry points of other packages by name. Raises ConfigError if a name is taken."""
        plugins: dict[str, metadata.EntryPoint] = {}
        for entry in metadata.entry_points(group=self.group):
            if entry.name in self.classes or entry.name in plugins:
                other = plugins.get(entry.name)
                owner = other.value if other else self.classes[entry.name].__module__
                raise ConfigError(
                    f"the {self.kind} name {entry.name!r} of {entry.value} is already taken by "
                    f"{owner}: rename the entry point"
                )
            plugins[entry.name] = entry
        return plugins
