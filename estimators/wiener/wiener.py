"""Wiener smoothers: estimates from the whole record for a known vehicle, in the frequency domain.

The vehicle is linearised about rest with equivalent dampers; the nonlinear residual of the strut
forces is noise of known spectrum (`road_envs.analysis.statistical_linearization`). The roughness,
and with it dampers and noise, is estimated per segment from the record (`spectral_model.py`), so no
training is needed. Missing, clipped or truncated signals only remove information. Each segment is
smoothed on its own (`iteration.py`) and blended with its neighbours.

    wiener            the best linear estimate. With linear struts the error would reach the bound
    iterated_wiener   each further pass computes the deviation of friction and damper curves from
                      the equivalent dampers on the estimated strut motion (its expectation where
                      that is uncertain), subtracts it from the accelerations and smooths again
                      (`iteration.py`): a dozen passes come close to the maximum a posteriori
                      estimate with the nonlinear vehicle, at the cost of Fourier transforms

A vehicle that departs from its description is adapted to the very drive (`adaptation.py`, `adapt`);
what its tolerances leave unknown is part of the standard deviations.

Limitations: rough roads at speed, where wheels leave the ground (there the passes diverge, and the
result is no better than that of `wiener`); speed or mode changes within a segment.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from estimators.common.explained import reduce_unexplained, trusted_share, untrusted_note
from estimators.common.misfit import NOISE_SCALE_WARNING, misfit_note
from estimators.common.odometer import calibrate_odometer
from estimators.map_smoother.identified_vehicle import CalibratedByIdentification
from estimators.preprocessing import mask_record
from estimators.wiener.adaptation import adapt_vehicle
from estimators.wiener.iteration import smooth_segment, to_grid
from estimators.wiener.segments import Segment, split_segments
from estimators.wiener.spectral_model import SensedVehicle, SpectralModel, fit_hyperparameters
from estimators.wiener.tuning import TUNING
from road_envs.core.config import Count, Positive
from road_envs.records.record import PROFILE_SPACING, Estimate, Record, profile_stations
from road_envs.sensing.instruments import instruments_of
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class Wiener(CalibratedByIdentification):
    """One pass of the Wiener smoother for a vehicle with these `instruments`."""

    causal: ClassVar[bool] = False

    std_factor: Positive = 0.93
    adapt: bool = True

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Estimate both wheel paths. Raises ConfigError, RecordError."""
        return self._estimate(record, car, 1)

    def _estimate(self, record: Record, car: VehicleParameters, passes: int) -> Estimate:
        """Estimate both wheel paths, of a vehicle adapted to the drive if it departs from its
        description; `std_factor` scales the standard deviations in the scored band.
        """
        record, car = self.as_identified(record, car)
        odometer = calibrate_odometer(record)
        record = odometer.record
        sensors = instruments_of(record, self.instruments)
        stations = profile_stations(record.length)
        total, total_std, weights = (np.zeros((2, stations.size)) for _ in range(3))
        masked = mask_record(record, sensors)
        notes = [*masked.notes]
        found = None
        segments = list(split_segments(masked, TUNING.segment_length, TUNING.segment_margin))
        vehicle = SensedVehicle.of(car, sensors)
        k = len(segments) // 2
        fit: Callable[[Segment], SpectralModel] = partial(fit_hyperparameters, vehicle)
        middle = fit(segments[k])
        unexplained = float(np.mean(middle.noise_scale))
        if self.adapt and self.identified is None:
            found = adapt_vehicle(masked.record, segments[k], middle, car, sensors, passes)
        if found:
            fitted = middle if found.car == car else None
            car, fit, middle = found.car, found.model, found.model(segments[k], fitted)
            notes += found.notes
            unexplained = found.unexplained
        for segment in segments:
            model = middle if segment is segments[k] else fit(segment)
            unexplained = max(unexplained, float(np.mean(model.noise_scale)))
            z, std = to_grid(segment, smooth_segment(model, segment, passes))
            at = np.round(stations / PROFILE_SPACING).astype(int) - segment.first * segment.stride
            weight = _blend_weights(stations, segment.core, record.length)
            inside = (at >= 0) & (at < z.shape[1]) & (weight > 0.0)
            total[:, inside] += weight[inside] * z[:, at[inside]]
            total_std[:, inside] += weight[inside] * std[:, at[inside]]
            weights[:, inside] += weight[inside]
            notes += segment.notes
        if unexplained > NOISE_SCALE_WARNING:
            notes.append(misfit_note(unexplained))
        weights = np.maximum(weights, 1e-12)
        z, std = total / weights, self.std_factor * total_std / weights
        share = trusted_share(masked.record, masked.valid, car, sensors, z)
        z, z_std = reduce_unexplained(z, std, share)
        residual = float(np.sqrt(unexplained))
        notes += untrusted_note(share)
        return odometer.describe(Estimate(stations, z, z_std, tuple(notes), residual=residual))


@dataclass(frozen=True, kw_only=True)
class IteratedWiener(Wiener):
    """Up to `passes` passes of the Wiener smoother for a vehicle with these `instruments`."""

    passes: Count = 15
    std_factor: Positive = 0.88

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Estimate both wheel paths. Raises ConfigError, RecordError."""
        return self._estimate(record, car, self.passes)


def _blend_weights(stations: np.ndarray, core: tuple[float, float], length: float) -> np.ndarray:
    """Return a segment's weights (M,): 1 in its core, falling linearly over half the margin."""
    transition = 0.5 * TUNING.segment_margin
    up = np.clip((stations - core[0]) / transition + 0.5, 0.0, 1.0) if core[0] > 0.0 else 1.0
    down = np.clip((core[1] - stations) / transition + 0.5, 0.0, 1.0) if core[1] < length else 1.0
    return np.minimum(up, down) * np.ones(stations.size)
