"""What an estimator is: it is given a record and the maker's knowledge of the car, and gives back
both wheel paths on `grid(record.length)`. It sees nothing else.

An estimator is a frozen dataclass of settings. One that learns keeps what it learnt in fields that
take no part in construction, comparison or printing; `fit` returns a fitted copy.
"""

import copy
import dataclasses
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Protocol, Self, TypeVar, runtime_checkable

import numpy as np

from road_envs.data.record import Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters

T = TypeVar("T")


class EstimateError(ValueError):
    """An estimate that cannot be judged, said in one sentence."""


class NotFittedError(RuntimeError):
    """An estimator that learns was asked before it learnt."""


class Estimator(Protocol):
    """From one record to both wheel paths."""

    causal: ClassVar[bool]
    """Whether the estimate at a station uses only what was sensed up to it; or, if it has a `lag`
    [m], up to the moment when the front axle was so much further.
    """

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Both wheel paths on `grid(record.length)`; the record is left untouched."""
        ...


@runtime_checkable
class Trainable(Estimator, Protocol):
    """An estimator that learns from drives over known roads."""

    def fit(
        self,
        records: Sequence[Record],
        truths: Sequence[Profile],
        car: VehicleParameters,
        seed: int,
    ) -> Self:
        """A fitted copy; the same arguments give the same copy."""
        ...

    def weights(self) -> dict[str, np.ndarray]:
        """All that was learnt, as arrays of numbers. Raises NotFittedError."""
        ...

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """A copy that has learnt `weights`, as `weights()` gave them. Raises ValueError."""
        ...


@runtime_checkable
class Pretrained(Trainable, Protocol):
    """An estimator taught once for all speeds and modes, from more drives than can be held.

    It comes with weights: `weights()` answers at once, and the judge does not fit it. Where a
    protocol wants a training for each speed and mode, one that `refit_per_case` in seconds is made
    with `shipped` false and fitted; any other stands there with its weights.
    """

    def training_example(self, record: Record, truth: Profile) -> Any:
        """What it keeps of a drive to learn from."""
        ...

    def pretrain(
        self,
        drives: Sequence[Any],
        car: VehicleParameters,
        seed: int,
        progress: Callable[[str, float], None] = ...,
        checkpoint: Any = None,
    ) -> Self:
        """A copy that has learnt from such drives. `progress` hears what is being done and the
        share done; a `checkpoint` can `save` an unfinished state as arrays by name and `load` it.
        """
        ...


@runtime_checkable
class Calibratable(Pretrained, Protocol):
    """An estimator whose standard deviations are made honest after it was taught."""

    def calibrate(self, drives: Sequence[Any]) -> Self:
        """A copy whose claims fit such drives, by the car as described on roads not taught."""
        ...


def copy_with(estimator: T, **fields: Any) -> T:
    """A copy of a frozen estimator whose learnt `fields` are set."""
    twin = copy.copy(estimator)
    for name, value in fields.items():
        object.__setattr__(twin, name, value)
    return twin


def require_fitted(value: T | None, estimator: object) -> T:
    """`value` if `estimator` has learnt it. Raises NotFittedError."""
    if value is None:
        name = type(estimator).__name__
        raise NotFittedError(f"{name} must be fitted before it can estimate: call fit() first")
    return value


def validate_weights(
    weights: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int | None, ...]]
) -> list[np.ndarray]:
    """The named `weights` as floats, in the order of `shapes`; None stands for any size.

    Raises ValueError if a name is missing or unknown, or if a shape or a value is impossible.
    """
    if weights.keys() != shapes.keys():
        raise ValueError(f"weights {sorted(shapes)} are wanted, got {sorted(weights)}")
    for name, shape in shapes.items():
        _validate_array(name, weights[name], shape, ValueError)
    return [np.array(weights[name], dtype=float) for name in shapes]


def check_class(cls: Any) -> Any:
    """`cls` if it has the shape of an estimator. Raises TypeError that says what it lacks."""
    if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
        raise TypeError("it must be a dataclass of settings")
    if not callable(getattr(cls, "estimate", None)):
        raise TypeError("it has no method estimate(record, car)")
    if not isinstance(getattr(cls, "causal", None), bool):
        raise TypeError("it must say whether it is causal: causal: ClassVar[bool] = ...")
    if not cls.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise TypeError("its settings must not change: @dataclass(frozen=True)")
    lag = getattr(cls, "lag", None)
    if lag is not None and not (isinstance(lag, int | float) and 0.0 <= lag < math.inf):
        raise TypeError(f"its lag must be metres behind the front axle, got {lag!r}")
    for method, arguments in {"estimate": 3, "fit": 5, "weights": 1, "with_weights": 2}.items():
        if (function := getattr(cls, method, None)) is not None:
            _check_call(function, method, arguments)
    missing = [name for name in ("weights", "with_weights") if not hasattr(cls, name)]
    if hasattr(cls, "fit") and missing:
        raise TypeError(f"it has fit, but no {' and no '.join(missing)}: it would never be trained")
    return cls


def _check_call(function: Callable, name: str, arguments: int) -> None:
    """Raise TypeError unless a method can be called with so many words, `self` among them."""
    try:
        inspect.signature(function).bind(*range(arguments))
    except TypeError:
        signatures = {"estimate": "record, car", "fit": "records, truths, car, seed"}
        parameters = signatures.get(name, "weights" if arguments > 1 else "")
        raise TypeError(f"it cannot be called as {name}({parameters})") from None


def check_estimate(estimate: object, record: Record) -> None:
    """Raise EstimateError unless `estimate` is one that can be judged against the road of `record`:
    finite heights of both wheel paths at the stations `grid(record.length)`, in this order.
    """
    if not isinstance(estimate, Estimate):
        raise EstimateError(f"an Estimate is wanted, got {type(estimate).__name__}")
    stations = profile_stations(record.length)
    size = stations.size
    _validate_array("stations s", estimate.s, (size,), EstimateError)
    _validate_array("heights z", estimate.z, (2, size), EstimateError)
    if (np.diff(estimate.s) <= 0).any():
        raise EstimateError("stations s must increase all along")
    if not np.allclose(estimate.s, stations, rtol=0.0, atol=1e-6):
        raise EstimateError(f"stations s must be grid({record.length:g}), the record's own")
    if estimate.z_std is not None:
        _validate_array("standard deviations z_std", estimate.z_std, (2, size), EstimateError)
        if (estimate.z_std < 0).any():
            raise EstimateError("standard deviations z_std must not be negative")


def _validate_array(
    name: str, value: object, shape: tuple[int | None, ...], error: type[ValueError]
) -> None:
    """Raise `error` unless `value` is an array of finite real numbers of that shape."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise error(f"{name}: an array of real numbers is wanted, got {kind}")
    fits = value.ndim == len(shape) and all(
        expected in (None, size) for expected, size in zip(shape, value.shape, strict=True)
    )
    if not fits:
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        raise error(f"{name}: shape ({expected}) is wanted, got {value.shape}")
    if not np.isfinite(value).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
        raise error(f"{name}: every value must be finite, {value[where]} stands at {where}")
