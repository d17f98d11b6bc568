"""Estimators by name, file, class or object; notes on what their weights were trained on."""

import importlib
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

from estimators import pretrained_weights, registry, weights_io
from estimators.api import Estimator, Pretrained, check_class
from road_envs.core.config import ConfigError, build
from road_envs.records.record import Record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

# Vehicle of the drives that the shipped weights were trained on
TRAINING_VEHICLE = "land_rover_defender_110"
_TRAINING_INSTRUMENTS = "paper"  # instruments of these drives

FILE_SUFFIXES = (".npz", pretrained_weights.SUFFIX)


def make_estimator(reference: str | Path, **settings: Any) -> Estimator:
    """Return an estimator by registered name or "module:Class", with `settings`, or from a file of
    `train`, which has its own. Raises ConfigError, StorageError, and whatever the code of another
    package raises when it is imported.
    """
    if Path(reference).suffix in FILE_SUFFIXES:
        if settings:
            raise ConfigError(f"{reference} was trained with its settings and takes no others")
        return weights_io.load(reference)
    name = str(reference)
    if ":" not in name:
        return registry.create(name, **settings)
    module, _, qualified_name = name.partition(":")
    try:
        imported = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # one that the module imports
        raise ConfigError(f"{name}: no module {error.name!r} in this folder or installed") from None
    try:
        cls: Any = attrgetter(qualified_name)(imported)
    except AttributeError:
        raise ConfigError(f"{name}: the module {module} has no {qualified_name}") from None
    return build(check_class(cls), settings, qualified_name)


def resolve_estimator(reference: str | Path | Estimator, settings: Mapping[str, Any]) -> Estimator:
    """Return an estimator given as an object, or by what `make_estimator` takes with `settings`."""
    if isinstance(reference, str | Path):
        return make_estimator(reference, **settings)
    if not callable(getattr(reference, "estimate", None)):
        raise TypeError(
            "an estimator is a name, a file, 'module:Class' or an object with estimate(record, "
            f"car); this is a {type(reference).__name__}"
        )
    if settings:
        raise ConfigError(f"settings {sorted(settings)} need an estimator by name, not an object")
    return reference


_place = attrgetter("mounted", "axle", "ahead", "y")


def training_notes(estimator: Estimator, record: Record, car: VehicleParameters) -> tuple[str, ...]:
    """Return notes if shipped weights are of another vehicle or other places of the sensors."""
    if not isinstance(estimator, Pretrained) or estimator.fitted_state is not None:
        return ()
    weights, notes = f"the shipped weights of {type(estimator).name}", []
    trained_on = load_vehicle(TRAINING_VEHICLE)
    if car != trained_on:
        notes.append(
            f"{weights} were trained on {trained_on.name}; that the vehicle is {car.name} makes "
            "no difference to this estimate"
        )
    places, sensors = load_instruments(_TRAINING_INSTRUMENTS).accelerometers, record.sensors or {}
    moved = [x for x in places if x in sensors and _place(sensors[x]) != _place(places[x])]
    if moved:
        notes.append(
            f"{weights} were trained with {', '.join(moved)} at other places; that they differ "
            "makes no difference to this estimate"
        )
    return tuple(notes)
