"""Vehicle parameters as a vector in units of their tolerances.

A parameter is named by its path in `parameters.VehicleParameters`; the last part of a value per
wheel is the wheel, of a value per axle the axle:

    m_b    front.I_xx    strut.friction    variation.damper.FL    variation.frame.f

With y the value that the description gives, the component x of the vector stands for

    y exp(s x),    s: the tolerance's `relative` standard deviation,

so that values stay positive, and x is standard normal among vehicles of one description. A path to
a curve, or to several, scales their forces. Identification, randomised training vehicles and the
perturbed test vehicles all change a vehicle by `scale_parameters`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import reduce
from typing import Any

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.parameters import BendingMode, Tolerance, TorsionalFrame, VehicleParameters
from road_envs.vehicle.suspension import WHEELS
from road_envs.vehicle.tyres import tyre_constants

AXLES = ("front", "rear")
MODES = {"frame": TorsionalFrame, "bending": BendingMode}
"""Elements that are left out as a whole, by their names in `VehicleVariation`."""


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """The P parameters of `car` that have a tolerance; the vector 0 is `car` itself."""

    car: VehicleParameters
    names: tuple[str, ...]
    std: np.ndarray  # (P,): standard deviations of the logarithms

    @property
    def size(self) -> int:
        """Number of parameters P."""
        return len(self.names)

    def from_vector(self, x: np.ndarray) -> VehicleParameters:
        """Return the vehicle of a vector `x` (P,). Raises ArithmeticError if there is none."""
        factors = np.exp(self.std * x).tolist()
        return varied_car(self.car, dict(zip(self.names, factors, strict=True)))

    def to_vector(self, car: VehicleParameters) -> np.ndarray:
        """Return the vector (P,) of a vehicle that differs from `self.car` in these parameters."""
        return (log_values(car, self.names) - log_values(self.car, self.names)) / self.std

    def draw(self, rng: np.random.Generator) -> VehicleParameters:
        """Return a random vehicle within the tolerances."""
        return self.from_vector(rng.standard_normal(self.size))


def parameter_space(car: VehicleParameters, structure: bool = False) -> ParameterSpace:
    """Return the space of the parameters that `car.tolerances` names.

    With `structure` the vehicle also gets the elements that its description leaves out but whose
    tolerances say what they are about: a torsional frame, bushings with a roll stiffness,
    progressive tyres. Without, these are no parameters. Raises ConfigError if a name is unknown, or
    if there is no tolerance.
    """
    absent = {path: t.about for path, t in car.tolerances.items() if _is_absent(car, path)}
    if missing := [path for path, about in absent.items() if about is None]:
        raise ConfigError(
            f"{car.name}: {missing[0]} is absent or 0, so a relative tolerance has no value to "
            "refer to: give the tolerance a key 'about', the value that it must say"
        )
    if structure:
        car = _with_elements(car, {path: about for path, about in absent.items() if about})
    used = {p: t.relative for p, t in car.tolerances.items() if structure or p not in absent}
    std = {name: relative for path, relative in used.items() for name in _components(car, path)}
    if not std:
        raise ConfigError(f"{car.name}: the vehicle's file names no tolerances of its parameters")
    return ParameterSpace(car, tuple(std), np.array(list(std.values())))


def has_absent_elements(car: VehicleParameters) -> bool:
    """Return whether a tolerance is that of an element that the description leaves out."""
    return any(_is_absent(car, path) for path in car.tolerances)


def stated_values(
    car: VehicleParameters, tolerances: Mapping[str, Tolerance]
) -> dict[str, Tolerance]:
    """Return those of the `tolerances` that `car` has a value for, or that say their own."""
    stated = {}
    for path, tolerance in tolerances.items():
        try:
            absent = _is_absent(car, path)
        except ConfigError:  # another kind of axle, spring or strut
            continue
        if not absent or tolerance.about is not None:
            stated[path] = tolerance
    return stated


def scale_parameters(car: VehicleParameters, factors: Mapping[str, float]) -> VehicleParameters:
    """Return `car` with the parameter of each path multiplied by its factor."""
    return reduce(lambda c, item: _scale_at(c, item[0].split("."), item[1]), factors.items(), car)


def varied_car(car: VehicleParameters, factors: Mapping[str, float]) -> VehicleParameters:
    """Return `scale_parameters` of a fit. Raises ArithmeticError if no vehicle has such values."""
    try:
        varied = scale_parameters(car, factors)
        tyre_constants(varied)
    except ValueError as error:
        raise ArithmeticError(f"a fitted vehicle is none: {error}") from None
    return varied


def log_values(car: VehicleParameters, names: tuple[str, ...]) -> np.ndarray:
    """Return the logarithms (P,) of the parameters; of a curve, that of its greatest force."""
    values = (_value_at(car, name) for name in names)
    sizes = [max(map(abs, _curves(x)[0].F)) if is_dataclass(x) else float(x) for x in values]
    return np.log(sizes)


def _index(part: str, size: int) -> int:
    return (WHEELS if size == len(WHEELS) else AXLES).index(part)


def _value_at(car: VehicleParameters, path: str) -> Any:
    """Return the value at a path, None below an element that is left out. Raises ConfigError."""
    value: Any = car
    for part in path.split("."):
        try:
            if isinstance(value, tuple):
                value = value[_index(part, len(value))]
            elif value is not None:
                if part not in {f.name for f in fields(value)}:  # a property follows from others
                    raise AttributeError
                value = getattr(value, part)
        except (AttributeError, ValueError):
            raise ConfigError(f"{car.name}: unknown parameter {path!r} of a tolerance") from None
    if isinstance(value, str | dict) or (is_dataclass(value) and not _curves(value)):
        raise ConfigError(
            f"{car.name}: {path!r} of a tolerance is neither a number nor a force curve"
        )
    return value


def _curves(value: Any) -> list[Curve]:
    """Return the curves of a dataclass that holds nothing else, and otherwise nothing."""
    if isinstance(value, Curve):
        return [value]
    parts = [getattr(value, f.name) for f in fields(value)]
    return parts if all(isinstance(part, Curve) for part in parts) else []


def _is_absent(car: VehicleParameters, path: str) -> bool:
    value = _value_at(car, path)
    return value is None or (not is_dataclass(value) and not np.all(np.asarray(value) > 0.0))


def _with_elements(car: VehicleParameters, about: Mapping[str, float]) -> VehicleParameters:
    """Return `car` with the elements that it lacks, of the values `about`."""
    variation = car.variation
    for mode, cls in MODES.items():
        values = {f.name: about.get(f"variation.{mode}.{f.name}") for f in fields(cls)}
        if getattr(variation, mode) is None and all(values.values()):
            variation = replace(variation, **{mode: cls(**values)})
    for path, value in about.items():
        name = path.removeprefix("variation.")
        if name.partition(".")[0] not in MODES:
            old = getattr(variation, name)
            new: Any = (value,) * len(old) if isinstance(old, tuple) else value
            variation = replace(variation, **{name: new})
    return replace(car, variation=variation)


def _components(car: VehicleParameters, path: str) -> list[str]:
    """Return the names of the numbers at a path: one, or one for each wheel or axle."""
    value = _value_at(car, path)
    if not isinstance(value, tuple):
        return [path]
    return [f"{path}.{part}" for part in (WHEELS if len(value) == len(WHEELS) else AXLES)]


def _scale_at(owner: Any, path: list[str], factor: float) -> Any:
    if path and isinstance(owner, tuple):
        i = _index(path[0], len(owner))
        return (*owner[:i], _scale_at(owner[i], path[1:], factor), *owner[i + 1 :])
    if path:
        return replace(owner, **{path[0]: _scale_at(getattr(owner, path[0]), path[1:], factor)})
    if isinstance(owner, Curve):
        return owner.scaled(factor)
    if is_dataclass(owner) and not isinstance(owner, type):
        scaled = {f.name: getattr(owner, f.name).scaled(factor) for f in fields(owner)}
        return replace(owner, **scaled)
    return tuple(factor * v for v in owner) if isinstance(owner, tuple) else factor * owner
