"""Registry of the estimators: names of this package and of installed plug-ins.

To add an estimator to this package: write its module, import the class below, add a line to
REGISTRY, run `pytest`. To add one from another package, declare an entry point there; the
estimator is then available as `my_estimator`:

    [project.entry-points."road_envs.estimators"]
    my_estimator = "my_package.my_module:MyEstimator"
"""

import dataclasses
import warnings
from importlib import metadata
from typing import Any

from estimators.api import Estimator, Pretrained, check_class
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
"""Entry-point group in which other packages declare estimators."""

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
    """Warning that an estimator of another package cannot be loaded."""


def available() -> dict[str, type[Estimator]]:
    """Return all estimator classes by name, including those of other packages.

    An estimator that cannot be loaded is skipped with an EstimatorPluginWarning. Raises
    ConfigError if two packages use the same name.
    """
    classes = dict(REGISTRY)
    for name, entry in _plugins().items():
        try:
            classes[name] = check_class(entry.load())
        except Exception as error:  # a broken plug-in must not disable the other estimators
            reason = f"{type(error).__name__}: {error}"
            warnings.warn(
                f"the estimator {name!r} of {entry.value} is skipped: {reason}",
                EstimatorPluginWarning,
                stacklevel=2,
            )
    return classes


def names() -> list[str]:
    """Return the names of all estimators without loading other packages. Raises ConfigError."""
    return [*REGISTRY, *_plugins()]


def find(name: str) -> type[Estimator]:
    """Return the estimator class `name`, loading its package only. Raises ConfigError if the name
    is unknown or its class cannot be used.
    """
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


def pretrainable() -> list[str]:
    """Return the names of the estimators of this package that can be trained on the corpus."""
    return [name for name, cls in REGISTRY.items() if isinstance(cls(), Pretrained)]


def without_weights() -> list[str]:
    """Return the names of pretrained estimators whose weights are not part of the package.

    They need `road-recon train` (about half an hour each) before they can be evaluated.
    """
    return [name for name in pretrainable() if not load_pretrained(name)]


def create(name: str, **settings: Any) -> Estimator:
    """Return an unfitted estimator with these settings. Raises ConfigError, which lists the
    choices, if the name, a setting or a value is wrong.
    """
    cls: Any = find(name)
    known = [field.name for field in dataclasses.fields(cls) if field.init]
    for setting in settings:
        validate_choice(f"setting of {name}", setting, known)
    return build(cls, settings, name)


def _plugins() -> dict[str, metadata.EntryPoint]:
    """Return the entry points of other packages by name. Raises ConfigError on a duplicate."""
    plugins: dict[str, metadata.EntryPoint] = {}
    for entry in metadata.entry_points(group=ENTRY_POINT_GROUP):
        if entry.name in REGISTRY or entry.name in plugins:
            other = plugins.get(entry.name)
            owner = other.value if other else REGISTRY[entry.name].__module__
            raise ConfigError(
                f"the estimator name {entry.name!r} of {entry.value} is already taken by {owner}: "
                "rename the entry point"
            )
        plugins[entry.name] = entry
    return plugins
