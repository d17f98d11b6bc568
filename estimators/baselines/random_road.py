"""Random road of the same roughness: the score of an estimate that matches the level only.

The straight line of ISO 8608 is fitted to the displacement spectral density of the training roads,

    G_d(n) = G_d(n0) (n / n0)^-w            n0 = 0.1 cycles/m

and a road with this density and random phases is synthesised from cosines. Its level is right in
expectation, everything else is unrelated to the truth: correlation 0 and sqrt(2) times the error of
`flat`. The wheel paths are independent, and a fitted estimator returns the same road for every
drive. It is synthetic and not a training road, since on the paper's board those are modified test
roads.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from scipy.fft import irfft, rfftfreq

from estimators.api import Profiles, Records, copy_with, require_fitted, validate_weights
from estimators.preprocessing import mask_record
from road_envs.core.config import Settings
from road_envs.records.record import PROFILE_SPACING, Estimate, Profile, Record, profile_stations
from road_envs.records.roughness import FIT_BAND, N_0, displacement_psd, fit_line, smooth_psd
from road_envs.vehicle.parameters import VehicleParameters

_Road = tuple[float, float, int]
"""Level G_d(n0) [m³], waviness, and the seed of the phases."""


@dataclass(frozen=True, kw_only=True)
class UnrelatedRoad(Settings):
    """Baseline: a random road as rough as the training roads, independent of the record."""

    causal: ClassVar[bool] = True
    fitted_state: _Road | None = field(default=None, init=False, repr=False, compare=False)

    def fit(self, records: Records, truths: Profiles, car: VehicleParameters, seed: int) -> Self:
        """Fit level and waviness of the truths; `seed` draws the phases. Raises ValueError."""
        phases = int(np.random.default_rng(seed).integers(2**31))  # exact as a float
        return copy_with(self, fitted_state=(*_fit_spectrum(truths), phases))

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return the random road. Raises RecordError, NotFittedError."""
        road, notes = require_fitted(self.fitted_state, self), mask_record(record).notes
        stations = profile_stations(record.length)
        return Estimate(stations, _draw_road(road, stations.size), notes=notes)

    def weights(self) -> dict[str, np.ndarray]:
        """Return the scalars `G_d0`, `w` and `seed`. Raises NotFittedError."""
        values = map(np.asarray, require_fitted(self.fitted_state, self))
        return dict(zip(("G_d0", "w", "seed"), values, strict=True))

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return a copy with these weights. Raises ValueError."""
        G_d0, w, seed = validate_weights(weights, {"G_d0": (), "w": (), "seed": ()})
        return copy_with(self, fitted_state=(float(G_d0), float(w), int(seed)))


def _fit_spectrum(truths: Sequence[Profile]) -> tuple[float, float]:
    """Return G_d(n0) [m³] and waviness of all wheel paths together. Raises ValueError on level
    roads. The waviness is the slope of log G. The level is the mean of G over the line, not of log
    G, which is low by up to 2.5 dB where a band contains a single spectral line.
    """
    spectra = [smooth_psd(*displacement_psd(truth.z, truth.ds)) for truth in truths]
    n = np.concatenate([n for n, _ in spectra])
    G = np.concatenate([G.mean(axis=0) for _, G in spectra])
    _, w = fit_line(n, G)
    inside = (n >= FIT_BAND[0]) & (n <= FIT_BAND[1])
    return float(np.mean(G[inside] * (n[inside] / N_0) ** w)), w


def _draw_road(road: _Road, size: int) -> np.ndarray:
    """Return heights (2, size) [m] at the profile stations, from 0; the period is 2 `size`."""
    (G_d0, w, seed), n = road, rfftfreq(2 * size, PROFILE_SPACING)
    inside = n >= FIT_BAND[0]
    G = G_d0 * (n[inside] / N_0) ** -w
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (2, G.size))
    lines = np.zeros((2, n.size), dtype=complex)
    lines[:, inside] = np.sqrt(2.0 * G * n[1]) * np.exp(1j * phase)
    z = size * irfft(lines, 2 * size)[:, :size]
    return z - z[:, :1]
