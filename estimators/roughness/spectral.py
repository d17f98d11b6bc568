"""Roughness level and ISO 8608 class of a road from the spectra of the accelerations.

    classify_record(record, car) -> ClassPosterior

No profile is reconstructed. The level of each octave is the maximum-likelihood level of the
accelerations' spectra under the linearised vehicle (empirical Bayes, `wiener/spectral_model.py`),
per segment; a vehicle that departs from its description is adapted to the drive first
(`wiener/adaptation.py`). With M independent lines the logarithm of a level has a standard deviation
of at least sqrt(1 / M); what the tolerances of the vehicle leave open (`tolerance_error.py`), and a
model that does not reproduce the record, add to it. The posterior over classes A to H follows from
a normal density of log G_d(n0), with class limits at twice the geometric means (ISO 8608, C.1).

Limitations: wheels leaving the ground and obstacles, of which spectra tell in part (a note says so,
and the interval is wide); roads too short to have a level.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from estimators.common.misfit import NOISE_SCALE_WARNING, misfit_note
from estimators.preprocessing import mask_record
from estimators.roughness.tolerance_error import roughness_std
from estimators.wiener.adaptation import adapt_vehicle
from estimators.wiener.drive_check import obstacle_samples
from estimators.wiener.segments import Segment, split_segments
from estimators.wiener.spectral_model import (
    SensedVehicle,
    SpectralModel,
    active_sensors,
    fit_hyperparameters,
    windowed_spectrum,
)
from estimators.wiener.tuning import TUNING
from road_envs.analysis.information_bound import RoadPrior, posterior
from road_envs.analysis.statistical_linearization import hermitian
from road_envs.records.record import SCORED_F_MAX, Record, scored_band
from road_envs.records.roughness import CLASSES
from road_envs.sensing.instruments import Instruments, instruments_of
from road_envs.vehicle.parameters import VehicleParameters

_MODEL_ERROR, _MISFIT_ERROR, _OBSTACLE_ERROR = 0.10, 0.5, 0.8
"""Standard deviations of the log level: by what no tolerance describes [assumed], where the model
is far from reproducing the record, and where much of it is obstacles. The latter two are RMS errors
over drives of `studies.roughness_alone` with development seeds (1130000, 1150000): individuals of
grade S2 by the described car, and roads with potholes.
"""

_OBSTACLES = 0.2  # share of a record from which on obstacles decide its level
_EM_ITERATIONS = 8  # expectation-maximisation iterations of an octave's level


class ClassPosterior(NamedTuple):
    """Posterior of a road's roughness.

    `G_d0` [m³] and the standard deviation `log_std` of its natural logarithm, over the scored band;
    `octaves` (K,) [cycles/m] with their own `levels` (K,) [m³], `level_stds` (K,) and most probable
    `octave_classes`; `probability` of each class by letter; `notes` on the vehicle.
    """

    G_d0: float
    log_std: float
    octaves: np.ndarray
    levels: np.ndarray
    level_stds: np.ndarray
    probability: dict[str, float]
    octave_classes: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def letter(self) -> str:
        """The most probable class."""
        return max(self.probability, key=self.probability.__getitem__)


def classify_record(
    record: Record, car: VehicleParameters, instruments: str = "paper"
) -> ClassPosterior:
    """Return the roughness of a record's road. Raises ConfigError, RecordError, ValueError."""
    sensors = instruments_of(record, instruments)
    masked = mask_record(record, sensors)
    octaves = scored_octaves(float(np.median(masked.record.v)))
    segments = list(split_segments(masked, TUNING.segment_length, TUNING.segment_margin))
    models, model_std, notes = _models_of_drive(masked.record, segments, car, sensors)
    model_std = math.hypot(model_std, 2.0 * roughness_std(record, car, instruments, _even(octaves)))
    pieces = zip(models, segments, strict=True)
    own, weights = np.swapaxes([_levels(*each, octaves) for each in pieces], 0, 1)
    total = np.maximum(weights.sum(axis=0), 1e-9)
    levels = (weights * own).sum(axis=0) / total
    stds = np.sqrt(1.0 / np.maximum(total, 1.0) + model_std**2)
    use = total > 1.0
    share = np.where(use, 1.0 / stds**2, 0.0)
    log_level = float(share @ np.log(levels) / share.sum())
    log_std = float(np.sqrt(1.0 / total[use].sum() + model_std**2))
    pairs = zip(np.log(levels).tolist(), stds.tolist(), strict=True)
    by_octave = [class_probabilities(*pair) for pair in pairs]
    classes = tuple(max(each, key=each.__getitem__) for each in by_octave)
    probability, G_d0 = class_probabilities(log_level, log_std), float(np.exp(log_level))
    return ClassPosterior(G_d0, log_std, octaves, levels, stds, probability, classes, notes)


def _models_of_drive(
    record: Record, segments: Sequence[Segment], car: VehicleParameters, sensors: Instruments
) -> tuple[list[SpectralModel], float, tuple[str, ...]]:
    """Return the models of the segments, of the vehicle adapted to the drive, the standard
    deviation of log levels by what is wrong with them, and notes.
    """
    vehicle, middle = SensedVehicle.of(car, sensors), segments[len(segments) // 2]
    model, adapted = fit_hyperparameters(vehicle, middle), None
    unexplained, std, notes = float(np.mean(model.noise_scale)), _MODEL_ERROR, list[str]()
    found = adapt_vehicle(record, middle, model, car, sensors, 1)
    if found is not None and found.notes:
        adapted, unexplained, notes = found.model, found.unexplained, [*found.notes]
    if unexplained > NOISE_SCALE_WARNING:
        std = math.hypot(std, _MISFIT_ERROR)
        notes.append(misfit_note(unexplained))
    obstacles = float(obstacle_samples(record).mean())
    if obstacles > _OBSTACLES:
        std = math.hypot(std, _OBSTACLE_ERROR)
        notes.append(
            f"{obstacles:.0%} of the drive is shaken by obstacles, which spectra tell in part: the "
            "level may be some dB too low"
        )
    if adapted:
        models = [adapted(each) for each in segments]
    else:
        models = [model if x is middle else fit_hyperparameters(vehicle, x) for x in segments]
    return models, std, tuple(notes)


def _even(octaves: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the weight of a spatial frequency in a level that is the mean over `octaves` (K,)."""
    low, high = octaves[0] * 2.0**-0.5, octaves[-1] * 2.0**0.5
    return lambda n: np.where((n >= low) & (n < high), 1.0 / n, 0.0)


def class_probabilities(log_level: float, log_std: float) -> dict[str, float]:
    """Return the probability of each class for a normally distributed log level."""
    limits = np.log([2.0 * mean for mean in CLASSES.values()][:-1])
    below = np.concatenate([[0.0], ndtr((limits - log_level) / log_std), [1.0]])
    return dict(zip(CLASSES, np.diff(below).tolist(), strict=True))


def scored_octaves(v: float) -> np.ndarray:
    """Return the centres (K,) [cycles/m] of the octaves scored at `v` [m/s]: of 0.25, 0.5, 1 and 2
    those that the 25 Hz low-pass passes completely. Raises ValueError if there is none.
    """
    low, _ = scored_band(v)
    high = min(2.0, SCORED_F_MAX / v / np.sqrt(2.0))
    if high < low:
        raise ValueError(
            f"at {3.6 * v:.0f} km/h the 25 Hz low-pass passes no octave of the scored band whole; "
            "drive slower"
        )
    return 2.0 ** np.arange(np.ceil(np.log2(low)), np.floor(np.log2(high)) + 1.0)


def _levels(
    model: SpectralModel, segment: Segment, octaves: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the levels (K,) [m³] of a segment's octaves and their independent lines (K,)."""
    lines, sensors = windowed_spectrum(model, segment), active_sensors(segment)
    noise = model.noise_psd()
    levels, counts = np.full(octaves.size, model.prior.G_d0), np.zeros(octaves.size)
    span = segment.valid.any(axis=0).sum() * segment.spacing
    for k, centre in enumerate(octaves):
        inside = (model.n >= centre * 2.0**-0.5) & (model.n < centre * 2.0**0.5)
        if not inside.any():
            continue
        n, y = model.n[inside], lines[inside][:, sensors]
        H, R = model.H[inside][:, sensors], noise[inside][:, sensors][:, :, sensors]
        unit = RoadPrior(G_d0=1.0, track=model.prior.track).spectrum(n)
        for _ in range(_EM_ITERATIONS):
            road_posterior = posterior(n, H, unit * levels[k], R)
            z = road_posterior.gain @ y
            second = z @ hermitian(z) + road_posterior.error
            told, unresolved = (
                np.trace(np.linalg.solve(unit, part), axis1=1, axis2=2).real
                for part in (second, road_posterior.error)
            )
            levels[k] = float(np.mean(told)) / 2.0
            known = float(np.mean(1.0 - 0.5 * (unresolved / levels[k])))
        # two wheel paths; a Hann window leaves two thirds of the independent lines
        counts[k] = 2.0 * span * (n[-1] - n[0]) * max(known, 0.01) * 2.0 / 3.0
    return levels, counts
