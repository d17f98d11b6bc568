"""Estimators by name: one file each; none knows another, none knows the simulator.

To add one here: write a file beside this one, import it below, add its line, run `pytest`. To add
one from another package, declare it there as an entry point, and it appears as `my_estimator`:

    [project.entry-points."road_envs.estimators"]
    my_estimator = "my_package.my_module:MyEstimator"
"""

import dataclasses
import warnings
from importlib import metadata
from typing import Any

from estimators.api import Estimator, check_class
from estimators.baselines.flat import Flat
from estimators.baselines.mean import Mean
from estimators.baselines.random_road import UnrelatedRoad
from estimators.kalman.estimators import Kalman, KalmanLag, KalmanRts
from estimators.linear.fir_ridge import FirRidge
from estimators.linear.inverse_quarter_car import InverseQuarterCar
from estimators.map_smoother.estimator import MapSmoother
from estimators.networks.gru import Gru, GruCausal
from estimators.networks.narx import Narx
from estimators.networks.static_lm import StaticLm
from estimators.networks.tcn import Tcn, TcnCausal
from estimators.pretrained_weights import load_pretrained
from estimators.wiener.iterated_wiener import IteratedWiener
from estimators.wiener.wiener import Wiener
from road_envs.config import ConfigError, build, validate_choice

ENTRY_POINT_GROUP = "road_envs.estimators"
"""Entry-point group under which other packages offer estimators."""

REGISTRY: dict[str, type[Estimator]] = {
    "flat": Flat,
    "mean": Mean,
    "unrelated_road": UnrelatedRoad,
    "static_lm": StaticLm,
    "narx": Narx,
    "inverse_quarter_car": InverseQuarterCar,
    "fir_ridge": FirRidge,
    "map_smoother": MapSmoother,
    "kalman": Kalman,
    "kalman_lag": KalmanLag,
    "kalman_rts": KalmanRts,
    "tcn": Tcn,
    "tcn_causal": TcnCausal,
    "gru": Gru,
    "gru_causal": GruCausal,
    "wiener": Wiener,
    "iterated_wiener": IteratedWiener,
}


class EstimatorPluginWarning(UserWarning):
    """An estimator of another package that cannot be used, and why."""


def available() -> dict[str, type[Estimator]]:
    """All estimators by name, those of other packages included.

    One that cannot be loaded is left out with a PluginWarning. Raises ConfigError if a package
    claims a name that is taken.
    """
    classes = dict(REGISTRY)
    for name, entry in _plugins().items():
        try:
            classes[name] = check_class(entry.load())
        except Exception as error:  # whatever another package does, the rest stays usable
            reason = f"{type(error).__name__}: {error}"
            warnings.warn(
                f"the estimator {name!r} of {entry.value} is left out: {reason}",
                EstimatorPluginWarning,
                stacklevel=2,
            )
    return classes


def names() -> list[str]:
    """Names of all estimators; nothing of another package is loaded for it. Raises ConfigError."""
    return [*REGISTRY, *_plugins()]


def find(name: str) -> type[Estimator]:
    """The estimator of a name; of other packages this one alone is loaded. Raises ConfigError."""
    plugins = _plugins()
    validate_choice("estimator", name, [*REGISTRY, *plugins])
    if name in REGISTRY:
        return REGISTRY[name]
    try:
        return check_class(plugins[name].load())
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        source = plugins[name].value
        raise ConfigError(f"the estimator {name!r} of {source} cannot be used: {reason}") from error


def without_weights() -> list[str]:
    """Estimators that are taught by `road-recon train` and whose weights do not come with the
    package: to be judged they would have to be taught anew, which takes half an hour each.
    """
    return [
        name
        for name, cls in REGISTRY.items()
        if hasattr(cls, "pretrain") and not load_pretrained(name)
    ]


def create(name: str, **settings: Any) -> Estimator:
    """A fresh estimator. Raises ConfigError that names the choices, if a name or value is wrong."""
    cls: Any = find(name)
    known = [field.name for field in dataclasses.fields(cls) if field.init]
    for setting in settings:
        validate_choice(f"setting of {name}", setting, known)
    return build(cls, settings, name)


def _plugins() -> dict[str, metadata.EntryPoint]:
    """What other packages offer, not loaded. Raises ConfigError for a name that is taken."""
    plugins: dict[str, metadata.EntryPoint] = {}
    for entry in metadata.entry_points(group=ENTRY_POINT_GROUP):
        if entry.name in REGISTRY or entry.name in plugins:
            other = plugins.get(entry.name)
            owner = other.value if other else REGISTRY[entry.name].__module__
            raise ConfigError(
                f"the estimator {entry.name!r} of {entry.value} needs another name: "
                f"{owner} has this one"
            )
        plugins[entry.name] = entry
    return plugins
