"""Bending of the body, which descriptions leave out, from the spectrum of a drive.

A body that bends answers the wheels at its own frequency, at every speed. One sensor cannot tell
that from waves of the road, and puts them into its profile: a bending at 20 Hz of a car that drives
at 100 km/h makes waves of 1.4 m three times as rough as they are (`studies/phone_reports.py`). But
a road has no reason for a narrow peak at 15 to 40 Hz. The periodogram of the accelerations, away
from obstacles, is therefore compared by Whittle's likelihood with those of the linearised vehicle
on roads of a power law (level and waviness are free), with bodies that bend and without.
"""

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.ndimage import correlate1d
from scipy.signal import welch

from estimators.common.bending import SensedBending, sensed_bending
from estimators.wiener.drive_check import obstacle_samples
from estimators.wiener.segments import dominant_modes
from estimators.wiener.spectral_model import SensedVehicle
from road_envs.analysis.information_bound import RoadPrior, equivalent_damping
from road_envs.analysis.statistical_linearization import (
    hermitian,
    nonlinear_residual,
    residual_force_psd,
)
from road_envs.records.record import Record
from road_envs.records.roughness import CLASSES
from road_envs.sensing.instruments import instruments_of
from road_envs.vehicle.linear_model import force_response, frequency_response, linearise
from road_envs.vehicle.parameters import BendingMode, VehicleParameters

BENDING_F, BENDING_ZETA = np.geomspace(13.0, 40.0, 40), (0.03, 0.06)
"""Frequencies [Hz] and damping ratios that are tried: from those of bodies on rubber mounts to the
first bending of trimmed bodies."""

BODY_OVER_WHEELBASE = 1.6
"""Length of a body over the wheelbase."""

WAVINESS = (1.7, 2.0, 2.3)
"""Exponents of the road's spectrum that are tried."""

WINDOW, F_RANGE = 1.0, (0.9, 38.0)
"""Length [s] of the windows of the periodogram, and its range [Hz]."""

HANN_LINES = 1.5
"""Lines that one independent line of a Hann window is spread over."""

LEAST_WINDOWS = 4.0
"""Independent windows without obstacles below which nothing is looked for."""

SAME_SPEED = 0.1
"""Relative range of the speeds of the windows."""

MIN_GAIN = 15.0
"""Least difference of the deviance for a body that bends. With it 10 of 10 such bodies of two
cars are found (70 and 100 km/h, classes A to C, seeds 101 to 126), 9 of them within 4 % of their
frequency, and none of 10 stiff ones bends."""


LEVEL_UPDATES, LEVEL_STEPS = 2, 8
"""Updates of the road's level, on which the equivalent dampers depend, and steps for each."""

HANN_KERNEL = np.array([1.0, 4.0, 1.0]) / 6.0
"""Power that a line of a Hann window takes from its neighbours."""


def with_bending(record: Record, car: VehicleParameters, instruments: str) -> VehicleParameters:
    """Return a `car` with the bending of its body that the spectrum of its drive shows, if any.

    Drives that change the state of their struts, and short ones, are not searched. Raises
    ConfigError.
    """
    v, sensors = float(np.median(record.v)), instruments_of(record, instruments)
    f, power, windows = _calm_periodogram(record, v)
    if car.variation.bending is not None or record.is_switched or windows < LEAST_WINDOWS:
        return car
    length = BODY_OVER_WHEELBASE * car.wheelbase
    modes = [
        BendingMode(f=float(x), zeta=zeta, length=length)
        for x, zeta in product(BENDING_F, BENDING_ZETA)
    ]
    bent = [replace(car, variation=replace(car.variation, bending=mode)) for mode in modes]
    vehicle, locations = SensedVehicle.of(bent[0], sensors), sensors.locations(car)
    bendings = [one for other in bent if (one := sensed_bending(other, locations))]
    stiff = replace(bendings[0], shape=np.zeros_like(bendings[0].shape))
    strut_mode = dominant_modes(record, np.arange(record.t.size), car.modes)
    noise = sensors.noise_densities[:, None] ** 2
    deviances = []
    for w in WAVINESS:
        prior = RoadPrior(G_d0=CLASSES["B"], w=w, track=vehicle.track)
        for _ in range(LEVEL_UPDATES):
            spectra = _Spectra.of(vehicle, strut_mode, prior, v, f)
            road, forces = spectra.of_sensors(stiff)
            level, _ = _whittle(power, road, forces + noise)
            prior = replace(prior, G_d0=level * prior.G_d0)
        densities = (spectra.of_sensors(one) for one in (stiff, *bendings))
        deviances.append([_whittle(power, road, forces + noise)[1] for road, forces in densities])
    lowest = 2.0 * windows / HANN_LINES * np.min(deviances, axis=0)
    best = int(np.argmin(lowest[1:]))
    return bent[best] if lowest[0] - lowest[1 + best] > MIN_GAIN else car


class _Spectra(NamedTuple):
    """Responses `H` (F, S + 2, 2) to wheel paths and `H_force` (F, S + 2, 4) to strut forces, of
    sensors and body, at the frequencies `f` (F,) [Hz], and the spectra `S` and `D` of paths and of
    residual strut forces.
    """

    vehicle: SensedVehicle
    f: np.ndarray
    H: np.ndarray
    S: np.ndarray
    H_force: np.ndarray
    D: np.ndarray

    @classmethod
    def of(cls, vehicle: SensedVehicle, mode, prior: RoadPrior, v: float, f: np.ndarray):
        """Return those of a vehicle at `v` [m/s] on a road with this prior."""
        plant = vehicle.plant
        damping = equivalent_damping(plant, mode, v, prior)
        linear = linearise(plant, mode, vehicle.points, damping=damping, speed=v)
        law = nonlinear_residual(plant, mode, damping)
        return cls(
            vehicle, f, frequency_response(linear, v, f=f), prior.spectrum(f / v) / v,
            force_response(linear, f)[0], residual_force_psd(linear, law, v, prior.spectrum, f),
        )  # fmt: skip

    def of_sensors(self, bending: SensedBending) -> tuple[np.ndarray, np.ndarray]:
        """Return the densities (S, F) [(m/s²)²/Hz] of the sensors by the road and by the forces, on
        a body with this bending.
        """
        one = replace(self.vehicle, bending=bending)
        H, H_force = one.readings(self.H, self.f), one.readings(self.H_force, self.f)
        parts = H @ self.S @ hermitian(H), H_force @ self.D @ hermitian(H_force)
        road, forces = (np.real(np.einsum("fss->sf", part)) for part in parts)
        return road, forces


def _calm_periodogram(record: Record, v: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return frequencies (F,) [Hz], the density (S, F) [(m/s²)²/Hz] of the accelerations in windows
    at about the speed `v` [m/s] without obstacles, and the number of independent windows.
    """
    size = round(WINDOW * record.fs)
    bad = obstacle_samples(record) | ~np.isfinite(record.a).all(axis=0)
    bad |= np.abs(record.v / v - 1.0) > SAME_SPEED
    parts = [slice(k, k + size) for k in range(0, record.t.size - size + 1, size // 2)]
    calm = [record.a[:, part] for part in parts if not bad[part].any()]
    if not calm:
        return np.zeros(0), np.zeros((1, 0)), 0.0
    f, power = welch(np.array(calm), record.fs, "hann", size, detrend="linear")
    inside = (f >= F_RANGE[0]) & (f <= F_RANGE[1])
    # windows that overlap by half count for about half of one each (Welch 1967)
    return f[inside], power.mean(axis=0)[:, inside], 0.5 * (len(calm) + 1)


def _whittle(power: np.ndarray, road: np.ndarray, others: np.ndarray) -> tuple[float, float]:
    """Return the factor on the density (S, F) of the `road` that fits a periodogram best, beside
    that of the `others`, and the deviance of one window's lines.
    """
    level = 1.0
    for _ in range(LEVEL_STEPS):
        weight = (road / (level * road + others)) ** 2
        best = float(np.sum(weight * (power - others) / road) / np.sum(weight))
        level = max(best, 0.1 * level)
    total = correlate1d(level * road + others, HANN_KERNEL, axis=1, mode="nearest")
    return level, float(np.sum(np.log(total) + power / total))
