"""Sequence networks over distance behind an FIR bank: `tcn`, `gru` and their causal variants.

Each is one network for all speeds and modes. `tcn` is convolutional: five dilated layers span 9.7 m
to either side offline and 19 m backwards in the causal variant, beyond the FIR windows. `gru` is a
gated recurrent network, offline bidirectional; in training it warms up on the 9 m before a crop,
offline also on the 9 m after it, and in use it runs over the whole drive.

`road-recon train NAME` produced the shipped weights from a corpus of simulated drives. `fit` trains
from scratch on the given drives alone. An estimator with other settings than those of the shipped
weights, or with `shipped=False`, must be fitted before use.

Limitations: vehicles far from those of the training corpus; below 0.15 cycles/m the network adds
nothing to the FIR bank. Errors of `gru` are larger by a tenth (median NRMSE over 42 drives of the
main board 0.30 against 0.27, causal 0.34 against 0.32), with fewer parameters; a training step
takes several times as long, since the stations are processed sequentially.
"""

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import AfterValidator, Field

from estimators.api import LAG, Profiles, Records, copy_with, validate_weights
from estimators.common.coverage import coverage_factors
from estimators.common.pretrained import (
    STATIONS_AHEAD,
    STATIONS_BEHIND,
    Prediction,
    Predictor,
    SpatialEstimator,
    TrainingExample,
)
from estimators.common.spatial_signals import SPACING, SpatialSignals, keep_short_waves, wheel_paths
from estimators.linear.fir_bank import FirBank
from estimators.networks import trainer
from estimators.networks.inputs import MIRROR_SIGNS, NetworkInputs, network_inputs
from estimators.networks.std_calibration import N_TERMS, StdScale, in_scored_band
from estimators.networks.trainer import require_torch
from road_envs.core.config import Count
from road_envs.vehicle.parameters import VehicleParameters

_NETWORK_PREFIX = "network."  # prefix of the names of the network's weights
_MOTION_UNIT = 500.0  # levels per s² by which accelerations in a correction's window are divided
_WHEELBASE_TOLERANCE = 0.02  # relative deviation from the trained one above which a note is added
_WARM_UP_STATIONS = 60  # stations of warm-up of `gru`
_EDGE_LENGTH = 5.0  # length [m] of each end of a drive on which deviations are not calibrated


class _FittedSequence(NamedTuple):
    """FIR bank, network weights (float16), the factor `std_scale` on the network's standard
    deviations, and the vehicle's `wheelbase` [m].
    """

    bank: FirBank
    network: dict[str, np.ndarray]
    std_scale: StdScale
    wheelbase: float


def _check_odd(size: int) -> int:
    if size % 2 == 0:
        raise ValueError(f"must be odd, got {size}")
    return size


_KernelSize = Annotated[int, Field(ge=3), AfterValidator(_check_odd), "stations", "kernel size"]
_Dilations = Annotated[tuple[Count, ...], Field(min_length=1), "stations", "of the layers"]


@dataclass(frozen=True, kw_only=True)
class _SequenceEstimator(SpatialEstimator):
    refit_per_case: ClassVar[bool] = False
    lag: ClassVar[float | None] = None
    """Distance [m] from a station to the front axle when its height is known; None if offline."""
    libraries: ClassVar[tuple[str, ...]] = ("torch",)
    """What is slow to import."""
    shipped: bool = True
    steps: Annotated[Count, "", "training steps"] = 2500
    channels: Annotated[Count, "", "channels of each layer"] = 48
    kernel: _KernelSize = 5

    @abc.abstractmethod
    def network(self) -> Any:
        """Return the torch network with its initial weights."""

    def fit(self, records: Records, truths: Profiles, car: VehicleParameters, seed: int) -> Self:
        """Return a copy trained from scratch on these drives. Raises RecordError."""
        pairs = zip(records, truths, strict=True)
        return self.pretrain([self.training_example(*pair) for pair in pairs], car, seed)

    def pretrain(
        self,
        drives: Sequence[TrainingExample],
        car: VehicleParameters,
        seed: int,
        progress: Callable[[str, float], None] = lambda text, share: None,
        checkpoint: Any = None,
    ) -> Self:
        """Return a copy trained on these drives; `seed` draws initial weights and batches. The FIR
        bank is fitted to the rigid bodies among them. One that serves all is worse on these by a
        fifth, and the network does not make up for it; it learns to correct the others.
        """
        torch = require_torch()
        progress("fitting the FIR bank", 0.0)
        rigid = [(drive.signals, drive.target) for drive in drives if drive.rigid]
        all_signals, targets = zip(*rigid, strict=True)
        ahead = STATIONS_AHEAD if self.causal else STATIONS_BEHIND
        bank = FirBank.fit(all_signals, targets, STATIONS_BEHIND, ahead)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = self.network()
        sequences = []
        for drive in drives:
            inputs = network_inputs(drive.signals, bank, car.wheelbase, network, self.causal)
            residual = keep_short_waves(drive.target.astype(float) - inputs.first) / inputs.level
            size, residual = residual.shape[1], residual.astype(np.float32)
            sequences.append(trainer.TrainingSequence(inputs, residual, 0, size))
        config = trainer.TrainerConfig(self.steps)
        _, parts = trainer.train_network(network, sequences, config, seed, progress, checkpoint)
        # calibrated as stored, in half precision
        rounded = {name: x.astype(np.float16) for name, x in trainer.get_weights(network).items()}
        trainer.set_weights(network, rounded)
        ratios = []
        for inputs, target, start, stop in parts:
            residual, std, _ = _evaluate(network, inputs)
            error = wheel_paths(target - residual) / np.hypot(*std)
            ratios.append(error[:, start:stop].ravel())
        scale = StdScale.constant(float(np.mean(coverage_factors(np.concatenate(ratios)))))
        state = _FittedSequence(bank, rounded, scale, car.wheelbase)
        return copy_with(self, fitted_state=state)

    def calibrate_deviations(self, drives: Sequence[TrainingExample]) -> Self:
        """Return a copy with standard deviations calibrated on these drives, unseen in training."""
        state, network = self._loaded()
        ratios, conditions = [], []
        for drive in drives:
            given = drive.signals, state.bank, state.wheelbase
            inputs = network_inputs(*given, network, self.causal)
            (residual, std, _), level = _evaluate(network, inputs), inputs.level
            own, size = _station_conditions(inputs, network), level.size
            cut = min(round(_EDGE_LENGTH / SPACING), size // 10)
            scored = slice(cut, size - cut)
            error = wheel_paths(drive.target - (inputs.first + level * residual))
            error = in_scored_band(error, float(np.median(drive.signals.v)))
            ratios.append((error / (level * np.hypot(*std)))[:, scored])
            conditions.append(own[:, scored] if own.shape[1] > 1 else own)
        scale = StdScale.fit(ratios, conditions)
        return copy_with(self, fitted_state=state._replace(std_scale=scale))

    def predictor(self, car: VehicleParameters) -> Predictor:
        """Return the function that estimates a drive by bank and network. Raises NotFittedError."""
        (bank, _, scale, wheelbase), network = self._loaded()
        notes: tuple[str, ...] = ()
        if abs(car.wheelbase - wheelbase) > _WHEELBASE_TOLERANCE * wheelbase:
            notes = (f"trained with a wheelbase of {wheelbase:.2f} m, not {car.wheelbase:.2f} m",)

        def predict(signals: SpatialSignals) -> Prediction:
            inputs = network_inputs(signals, bank, car.wheelbase, network, self.causal)
            residual, std, hidden = _evaluate(network, inputs)
            z, level = inputs.first + inputs.level * residual, inputs.level
            z_std = scale(_station_conditions(inputs, network)) * level * np.hypot(*std)
            return Prediction(z, level, _MOTION_UNIT * level, hidden, z_std, notes)

        return predict

    def weights(self) -> dict[str, np.ndarray]:
        """Return `taps`, `widths` (the coefficients of the standard deviations), `wheelbase` and
        the network's weights. Raises NotFittedError.
        """
        bank, network, scale, wheelbase = self._fitted_or_pretrained()
        return {
            "taps": bank.taps,
            "widths": scale.coefficients,
            "wheelbase": np.array(wheelbase),
            **{_NETWORK_PREFIX + name: x for name, x in network.items()},
        }

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return a copy with these weights. Raises ValueError."""
        ahead = STATIONS_AHEAD if self.causal else STATIONS_BEHIND
        shapes: dict[str, tuple[int | None, ...]] = {
            "taps": FirBank.shape(STATIONS_BEHIND, ahead),
            "widths": (N_TERMS,),
            "wheelbase": (),
        }
        torch = require_torch()
        with torch.device("meta"):  # shapes only: the settings of a file may ask for any size
            layers = self.network().state_dict().items()
            own = {_NETWORK_PREFIX + name: tuple(x.shape) for name, x in layers}
        taps, coefficients, wheelbase, *rest = validate_weights(weights, shapes | own)
        names = (name.removeprefix(_NETWORK_PREFIX) for name in own)
        network = {name: x.astype(np.float16) for name, x in zip(names, rest, strict=True)}
        bank = FirBank(taps.astype(np.float16), ahead)
        state = _FittedSequence(bank, network, StdScale(coefficients), float(wheelbase))
        return copy_with(self, fitted_state=state)

    def _loaded(self) -> tuple[_FittedSequence, Any]:
        """Return the state, fitted or shipped, and its torch network. Raises NotFittedError."""
        state: _FittedSequence = self._fitted_or_pretrained()
        network = self.network()
        trainer.set_weights(network, state.network)
        return state, network


def _evaluate(network: Any, inputs: NetworkInputs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean of a network's outputs for a drive and the mirrored one, mirrored back: the
    residual of m and q and its standard deviation, both (2, M) in levels, and what the weights of
    the last layer multiply (2, channels, M).
    """
    torch = require_torch()
    with torch.no_grad(), trainer.single_thread():
        both_drives = torch.from_numpy(np.array([inputs.x, inputs.x * MIRROR_SIGNS]))
        both_conditions = torch.from_numpy(np.array([inputs.conditions] * 2))
        kept: list[Any] = []
        hook = network.head.register_forward_pre_hook(lambda _, given: kept.append(given[0]))
        output = network(both_drives, both_conditions).numpy().astype(float)
        hook.remove()
    mirror = np.array([[1.0], [-1.0]])
    residual = 0.5 * (output[0, :2] + mirror * output[1, :2])
    one, other = kept[0].numpy().astype(float)
    std = np.exp(np.clip(output[:, 2:], *trainer.LOG_STD_RANGE).mean(axis=0))
    return residual, std, 0.5 * np.array([one + other, one - other])


def _station_conditions(inputs: NetworkInputs, network: Any) -> np.ndarray:
    """Return the conditions (8, 1 or M) at the estimated stations."""
    conditions = inputs.conditions.astype(float)
    if conditions.shape[1] > 1:
        conditions = conditions[:, network.behind : network.behind + inputs.level.size]
    return conditions


@dataclass(frozen=True, kw_only=True)
class Tcn(_SequenceEstimator):
    """Convolutional network over stations; offline: uses the whole drive."""

    name: ClassVar[str] = "tcn"
    causal: ClassVar[bool] = False
    dilations: _Dilations = (1, 2, 4, 8, 16)

    def network(self) -> Any:
        from estimators.networks.modules import TemporalConvNet

        return TemporalConvNet(self.channels, self.kernel, self.dilations, self.causal)


@dataclass(frozen=True, kw_only=True)
class TcnCausal(Tcn):
    """Convolutional network over stations, which reads up to 4.79 m beyond each."""

    name: ClassVar[str] = "tcn_causal"
    causal: ClassVar[bool] = True
    lag: ClassVar[float | None] = LAG


@dataclass(frozen=True, kw_only=True)
class Gru(_SequenceEstimator):
    """Recurrent network over stations; offline: uses the whole drive."""

    name: ClassVar[str] = "gru"
    causal: ClassVar[bool] = False
    steps: Annotated[Count, "", "training steps"] = 1200
    kernel: _KernelSize = 9

    def network(self) -> Any:
        from estimators.networks.modules import GatedRecurrentNet

        return GatedRecurrentNet(self.channels, self.kernel, _WARM_UP_STATIONS, self.causal)


@dataclass(frozen=True, kw_only=True)
class GruCausal(Gru):
    """Recurrent network over stations, which reads up to 4.79 m beyond each."""

    name: ClassVar[str] = "gru_causal"
    causal: ClassVar[bool] = True
    lag: ClassVar[float | None] = LAG
