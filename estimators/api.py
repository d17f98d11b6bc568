"""Interface of the estimators: a record and the vehicle's nominal parameters in, an Estimate out.

An estimate holds both wheel paths on `profile_stations(record.length)`. The estimator has access
to nothing else. It is a frozen dataclass of settings; what it learns is kept in fields excluded
from construction, comparison and repr, and `fit` returns a fitted copy.
"""

import copy
import dataclasses
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self, TypeAlias, TypeVar, runtime_checkable

import numpy as np

from road_envs.records.record import Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters

_T = TypeVar("_T")

ENTRY_POINT_GROUP = "road_envs.estimators"
"""Entry-point group in which other packages declare estimators."""

LAG = 4.79
"""Lag [m] of the fixed-lag estimators: the Defender's wheelbase and 2 m."""

Records: TypeAlias = Sequence[Record]
Profiles: TypeAlias = Sequence[Profile]
Cars: TypeAlias = Sequence[VehicleParameters]


class EstimateError(ValueError):
    """An estimate that violates the interface; the message says how."""


class NotFittedError(RuntimeError):
    """A trainable estimator was used before it was fitted."""


class Estimator(Protocol):
    """Maps a record to both wheel paths."""

    causal: ClassVar[bool]
    """True if the estimate at a station uses only samples up to the moment when the front axle has
    passed it; with a `lag` [m], when the front axle is that far beyond it.
    """

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return both wheel paths on `profile_stations(record.length)`; the record is unchanged."""


@runtime_checkable
class HasInstruments(Protocol):
    """An estimator with a model of the vehicle, and of its `instruments` (name or path)."""

    instruments: str


@runtime_checkable
class Trainable(Estimator, Protocol):
    """An estimator that is fitted to drives over known roads."""

    def fit(self, records: Records, truths: Profiles, car: VehicleParameters, seed: int) -> Self:
        """Return a fitted copy; equal arguments and `seed` give an equal copy."""

    def weights(self) -> dict[str, np.ndarray]:
        """Return everything learned, as numeric arrays by name. Raises NotFittedError."""

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return a copy with `weights` as `weights()` returned them. Raises ValueError."""


@runtime_checkable
class Pretrained(Trainable, Protocol):
    """A trainable estimator that ships with weights for all speeds and modes. `weights()` succeeds
    without `fit`, so the leaderboard does not train it. For a protocol that trains per speed and
    mode, a class with `refit_per_case` (a fit takes seconds) is created with `shipped=False` and
    fitted; other classes keep their shipped weights.
    """

    name: ClassVar[str]
    """Name of the file of weights, and of the estimator in the registry."""

    refit_per_case: ClassVar[bool]

    fitted_state: Any
    """Result of a fit; None if the shipped weights are used."""

    def training_example(self, record: Record, truth: Profile, rigid: bool = True) -> Any:
        """Return the part of a drive needed for training, as raw records would not fit in memory;
        `rigid`: the vehicle's body neither twists nor bends.
        """

    def pretrain(
        self,
        drives: Sequence[Any],
        car: VehicleParameters,
        seed: int,
        progress: Callable[[str, float], None] = ...,
        checkpoint: Any = None,
    ) -> Self:
        """Return a copy trained on examples from `training_example`. `progress` is called with a
        description and the fraction done (0 to 1). `checkpoint` has `save`, which stores an
        unfinished state (arrays by name), and `load`, which returns it.
        """


@runtime_checkable
class DeviationCalibratable(Pretrained, Protocol):
    """A pretrained estimator whose standard deviations are calibrated after training."""

    def calibrate_deviations(self, drives: Sequence[Any]) -> Self:
        """Return a copy calibrated on these examples: drives of the nominal vehicle on roads that
        were not used for training.
        """


class CalibrationError(ValueError):
    """Drives that an estimator cannot be calibrated with; the message says why."""


@dataclass(frozen=True, eq=False)
class CalibrationDrive:
    """A drive of the vehicle that is to be known better, before the drives that matter.

    `profile` is the road if it was measured, with independent survey errors of the standard
    deviation `survey_std` [m]; None over a road that nobody measured.
    """

    record: Record
    profile: Profile | None = None
    survey_std: float = 0.0005
    name: str = "the drive"


@runtime_checkable
class Calibratable(Estimator, Protocol):
    """An estimator that can be calibrated to one vehicle by drives of it. A trained one keeps its
    weights: only what belongs to vehicle and instruments is new, and not part of `weights`.
    """

    def calibrate(self, drives: Sequence[CalibrationDrive], car: VehicleParameters) -> Self:
        """Return a copy for the vehicle of these `drives`, of which `car` is the description.

        Drives over measured and unmeasured roads may be mixed. A second calibration replaces the
        first. Raises CalibrationError, ArithmeticError.
        """


_TRAINING: tuple[Any, ...] = (Trainable.fit, Trainable.weights, Trainable.with_weights)
_METHODS = (Estimator.estimate, *_TRAINING, Calibratable.calibrate)
"""Methods that must take the arguments that they have in the interface."""


def declared_lag(estimator: object) -> float:
    """Return the `lag` [m] behind the front axle that an estimator declares, 0 if it has none."""
    return float(getattr(estimator, "lag", None) or 0.0)


def uses_seed(estimator: object) -> bool:
    """Return whether the seed of `fit` makes a difference: so unless `uses_seed` denies it."""
    return getattr(estimator, "uses_seed", True) is not False


def copy_with(estimator: _T, **fields: Any) -> _T:
    """Return a copy of a frozen estimator with these learned `fields` set."""
    twin = copy.copy(estimator)
    for name, value in fields.items():
        object.__setattr__(twin, name, value)
    return twin


def require_fitted(value: _T | None, estimator: object) -> _T:
    """Return `value`, a learned field of `estimator`. Raises NotFittedError if it is None."""
    if value is None:
        name = type(estimator).__name__
        raise NotFittedError(
            f"{name} must be fitted before it can estimate: call fit(), or give the file that "
            "`road-recon train` has written"
        )
    return value


def validate_weights(
    weights: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int | None, ...]]
) -> list[np.ndarray]:
    """Return the `weights` as float arrays in the order of `shapes`, where None matches any size.
    Raises ValueError if a name is missing or unknown, or if a shape or value is invalid.
    """
    if weights.keys() != shapes.keys():
        raise ValueError(
            f"expected weights {sorted(shapes)}, got {sorted(weights)}: give the file of this "
            "estimator, or train it again"
        )
    for name, shape in shapes.items():
        _validate_array(name, weights[name], shape, ValueError)
    return [np.array(weights[name], dtype=float) for name in shapes]


def check_class(cls: Any) -> Any:
    """Return `cls` if it implements the interface. Raises TypeError that names the violation."""
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        raise TypeError("it must be a dataclass of settings")
    if not callable(getattr(cls, "estimate", None)):
        raise TypeError("it has no method estimate(record, car)")
    if not isinstance(getattr(cls, "causal", None), bool):
        raise TypeError("it does not declare causality: add causal: ClassVar[bool] = True or False")
    if not cls.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise TypeError("its settings are mutable: use @dataclass(frozen=True)")
    lag = getattr(cls, "lag", None)
    if lag is not None and not (isinstance(lag, int | float) and 0.0 <= lag < math.inf):
        raise TypeError(
            f"its lag must be a distance >= 0 in metres behind the front axle, got {lag!r}"
        )
    for wanted in _METHODS:
        method, (_, *arguments) = wanted.__name__, inspect.signature(wanted).parameters
        if (function := getattr(cls, method, None)) is None:
            continue
        try:
            inspect.signature(function).bind(cls, *arguments)
        except TypeError:
            call = f"{method}({', '.join(arguments)})"
            raise TypeError(f"it cannot be called as {call}") from None
    missing = [name for name in ("weights", "with_weights") if not hasattr(cls, name)]
    if hasattr(cls, "fit") and missing:
        raise TypeError(f"it has fit but no {' and no '.join(missing)}: a trainable needs both")
    return cls


def check_estimate(estimate: object, record: Record) -> None:
    """Raise EstimateError unless `estimate` is valid for `record`: finite heights of both wheel
    paths at the stations `profile_stations(record.length)`, in this order.
    """
    if not isinstance(estimate, Estimate):
        raise EstimateError(f"expected an Estimate, got {type(estimate).__name__}")
    stations = profile_stations(record.length)
    size = stations.size
    _validate_array("stations s", estimate.s, (size,), EstimateError)
    _validate_array("heights z", estimate.z, (2, size), EstimateError)
    if (np.diff(estimate.s) <= 0).any():
        raise EstimateError("stations s must increase strictly")
    if not np.allclose(estimate.s, stations, rtol=0.0, atol=1e-6):
        raise EstimateError(f"stations s must be profile_stations({record.length:g})")
    if estimate.z_std is not None:
        _validate_array("standard deviations z_std", estimate.z_std, (2, size), EstimateError)
        if (estimate.z_std < 0).any():
            raise EstimateError("standard deviations z_std must not be negative")
    if estimate.draws is not None:
        _validate_array("draws", estimate.draws, (None, 2, size), EstimateError)


def _validate_array(
    name: str, value: object, shape: tuple[int | None, ...], error: type[ValueError]
) -> None:
    """Raise `error` unless `value` is an array of finite real numbers of this shape."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise error(f"{name}: expected an array of real numbers, got {kind}")
    fits = value.ndim == len(shape) and all(
        expected in (None, size) for expected, size in zip(shape, value.shape, strict=True)
    )
    if not fits:
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        raise error(f"{name}: expected shape ({expected}), got {value.shape}")
    if not np.isfinite(value).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
        raise error(f"{name}: every value must be finite, got {value[where]} at index {where}")
