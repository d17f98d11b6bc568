"""Registry of the estimators: names of this package and of installed plug-ins.

To add an estimator to this package: write its module, import the class below, add a line to
REGISTRY, run `pytest`. To add one from another package, declare an entry point there; the
estimator is then available as `my_estimator`:

    [project.entry-points."road_envs.estimators"]
    my_estimator = "my_package.my_module:MyEstimator"
"""

from typing import Any

from estimators.api import ENTRY_POINT_GROUP, Estimator, Pretrained, check_class
from estimators.baselines.flat import FlatEstimator
from estimators.baselines.mean import Mean
from estimators.baselines.random_road import UnrelatedRoad
from estimators.kalman.estimators import Kalman, KalmanLag, KalmanRts
from estimators.linear.calibrated_fir import CalibratedFir
from estimators.linear.fir_ridge import FirRidge
from estimators.linear.inverse_quarter_car import InverseQuarterCar
from estimators.map_smoother.estimator import MapSmoother
from estimators.networks.narx import Narx
from estimators.networks.sequence_estimator import Gru, GruCausal, Tcn, TcnCausal
from estimators.networks.static_lm import StaticLm
from estimators.pretrained_weights import load_pretrained
from estimators.wiener.wiener import IteratedWiener, Wiener
from road_envs.core.registry import PluginWarning as PluginWarning  # part of `estimators`
from road_envs.core.registry import Registry

REGISTRY: dict[str, type[Estimator]] = {
    "flat": FlatEstimator,
    "mean": Mean,
    "unrelated_road": UnrelatedRoad,
    "static_lm": StaticLm,
    "narx": Narx,
    "inverse_quarter_car": InverseQuarterCar,
    "fir_ridge": FirRidge,
    "calibrated_fir": CalibratedFir,
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

_ESTIMATORS = Registry("estimator", ENTRY_POINT_GROUP, REGISTRY, check_class)
available, names, find = _ESTIMATORS.available, _ESTIMATORS.names, _ESTIMATORS.find
"""Look-up by name, as documented in `Registry`."""


def pretrainable() -> list[str]:
    """Return the names of the estimators of this package that can be trained on the corpus."""
    return [name for name, cls in REGISTRY.items() if isinstance(cls(), Pretrained)]


def without_weights() -> list[str]:
    """Return the names of pretrained estimators whose weights are not part of the package: they
    need `road-recon train` (about half an hour each) before they can be evaluated.
    """
    return [name for name in pretrainable() if not load_pretrained(name)]


def create(name: str, **settings: Any) -> Estimator:
    """Return an unfitted estimator with these settings. Raises ConfigError, which lists the
    choices, if the name, a setting or a value is wrong.
    """
    return _ESTIMATORS.create(name, settings, {})
