"""Bending and twist of the body, which descriptions leave out, from the spectrum of a drive.

A body that bends answers the wheels at its own frequency, at every speed. One sensor cannot tell
that from waves of the road, and puts them into its profile: a bending at 20 Hz of a car that drives
at 100 km/h makes waves of 1.4 m three times as rough as they are (`studies/phone_reports.py`). A
frame that twists at 7 to 20 Hz rolls sensors on both sides against one another: a stiff model with
three or four of them explains that by no road, and halves the heights, or by a difference of the
paths that is not there (`studies/few_sensors.py`). But a road has no reason for a narrow peak. The
periodogram of the accelerations, away from obstacles, is therefore compared by Whittle's likelihood
with those of the linearised vehicle on roads of a power law, with bodies that bend or twist and
without. Sensors on both sides count by their mean and half their difference.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.ndimage import correlate1d
from scipy.signal import welch

from estimators.common.bending import sensed_bending
from estimators.wiener.drive_check import obstacle_samples
from estimators.wiener.segments import dominant_modes
from estimators.wiener.spectral_model import SensedVehicle
from estimators.wiener.tuning import TUNING
from road_envs.analysis.information_bound import RoadPrior, equivalent_damping
from road_envs.analysis.statistical_linearization import (
    hermitian,
    nonlinear_residual,
    residual_force_psd,
)
from road_envs.records.record import Record
from road_envs.records.roughness import CLASSES
from road_envs.sensing.instruments import Instruments, SensorLocation, instruments_of
from road_envs.vehicle.linear_model import force_response, frequency_response, linearise
from road_envs.vehicle.parameters import BendingMode, Tolerance, TorsionalFrame, VehicleParameters

# Frequencies [Hz] and damping ratios that are tried: from those of bodies on rubber mounts to the
# first bending of trimmed bodies
BENDING_F, BENDING_ZETA = np.geomspace(13.0, 40.0, 40), (0.03, 0.06)
# The same of a frame's twist; a fit to the drive goes on within _FRAME_TOLERANCES of what is found
FRAME_F, FRAME_ZETA = np.geomspace(6.5, 22.0, 24), (0.05, 0.1)
_FRAME_TOLERANCES = {
    "variation.frame.f": Tolerance(relative=0.1, source="found in the spectrum of the drive"),
    "variation.frame.zeta": Tolerance(relative=0.4, source="as its frequency"),
}
# Power that a line of a Hann window takes from its neighbours
_HANN_KERNEL = np.array([1.0, 4.0, 1.0]) / 6.0


def with_bending(record: Record, car: VehicleParameters, instruments: str) -> VehicleParameters:
    """Return a `car` with the bending of its body that the spectrum of its drive shows, if any.

    Drives that change the state of their struts, and short ones, are not searched. Raises
    ConfigError.
    """
    drive = CalmDrive.of(record, car, instruments)
    if car.variation.bending is not None or not drive.tells(record):
        return car
    length = TUNING.body_over_wheelbase * car.wheelbase
    tried = product(BENDING_F.tolist(), BENDING_ZETA)
    modes = [BendingMode(f=f, zeta=zeta, length=length) for f, zeta in tried]
    bent = [replace(car, variation=replace(car.variation, bending=mode)) for mode in modes]
    vehicle, locations = SensedVehicle.of(bent[0], drive.sensors), drive.sensors.locations(car)
    bendings = [one for other in bent if (one := sensed_bending(other, locations))]
    stiff = replace(bendings[0], shape=np.zeros_like(bendings[0].shape))
    deviances = []
    for w in TUNING.waviness:
        spectra = drive.on_fitted_level(replace(vehicle, bending=stiff), w)
        parts = [replace(vehicle, bending=one) for one in (stiff, *bendings)]
        deviances.append([drive.deviance(spectra._replace(vehicle=one)) for one in parts])
    gain = np.min(deviances, axis=0)
    best = int(np.argmin(gain[1:]))
    return bent[best] if gain[0] - gain[1 + best] > TUNING.structure_gain else car


def with_twist(record: Record, car: VehicleParameters, instruments: str) -> VehicleParameters:
    """Return a `car` with the frame that the spectrum of its drive shows, if any, and tolerances.

    The frame that explains the first half of the drive best has to explain the second one better
    than a stiff body. Drives as of `with_bending`, and those whose sensors do not tell the roll,
    are not searched. Raises ConfigError.
    """
    drive = CalmDrive.of(record, car, instruments)
    has_pairs = (drive.weights < 0.0).any()  # of sensors on both sides of the body
    if car.variation.frame is not None or not (drive.tells(record) and has_pairs):
        return car
    modes = [TorsionalFrame(f=float(x), zeta=y) for x, y in product(FRAME_F, FRAME_ZETA)]
    bodies = [replace(car, variation=replace(car.variation, frame=mode)) for mode in modes]
    middle = len(drive.power) // 2
    halves = [replace(drive, power=part) for part in (drive.power[:middle], drive.power[middle:])]
    rows = []
    for w in TUNING.waviness:
        first = drive.on_fitted_level(SensedVehicle.of(car, drive.sensors), w)
        alike = first.damping, first.prior, drive, first.D  # road and dampers of all bodies
        others = [Spectra.of(SensedVehicle.of(body, drive.sensors), *alike) for body in bodies]
        rows.append([[one.deviance(x) for x in (first, *others)] for one in (*halves, drive)])
    one, other, whole = np.min(rows, axis=0)
    is_believed = other[0] - other[1 + int(np.argmin(one[1:]))] > TUNING.structure_gain
    found = bodies[int(np.argmin(whole[1:]))]
    return replace(found, tolerances=found.tolerances | _FRAME_TOLERANCES) if is_believed else car


def _pairs(locations: Mapping[str, SensorLocation]) -> np.ndarray:
    """Return the weights (C, S) of the sensors in the channels: of pairs on both sides the mean and
    half the difference, and each sensor that is in no pair.
    """
    places, rows = list(locations.values()), []
    unit, alone = np.eye(len(places)), np.ones(len(places), dtype=bool)
    for i, j in combinations(range(len(places)), 2):
        one, other = places[i], places[j]
        is_near = one.axle == other.axle and abs(one.x - other.x) <= TUNING.same_axle
        if is_near and abs(one.y - other.y) >= TUNING.least_apart:
            rows += [0.5 * (unit[i] + unit[j]), 0.5 * (unit[i] - unit[j])]
            alone[[i, j]] = False
    return np.array([*rows, *unit[alone]])


@dataclass(frozen=True, eq=False)
class CalmDrive:
    """Periodograms `power` (W, C, F) [(m/s²)²/Hz] of the channels `weights` (C, S) of `sensors` at
    the frequencies `f` (F,) [Hz], in W windows without obstacles at about the speed `v` [m/s], with
    struts in the state `mode`.
    """

    sensors: Instruments
    weights: np.ndarray
    f: np.ndarray
    power: np.ndarray
    v: float
    mode: Any

    @classmethod
    def of(cls, record: Record, car: VehicleParameters, instruments: str) -> Self:
        """Return that of a record."""
        v, sensors = float(np.median(record.v)), instruments_of(record, instruments)
        weights = _pairs(sensors.locations(car))
        mode = dominant_modes(record, np.arange(record.t.size), car.modes)
        size = round(TUNING.window * record.fs)
        bad = obstacle_samples(record) | ~np.isfinite(record.a).all(axis=0)
        bad |= np.abs(record.v / v - 1.0) > TUNING.same_speed
        parts = [slice(k, k + size) for k in range(0, record.t.size - size + 1, size // 2)]
        calm = [weights @ record.a[:, part] for part in parts if not bad[part].any()]
        if not calm:
            return cls(sensors, weights, np.zeros(0), np.zeros((0, 1, 0)), v, mode)
        f, power = welch(np.array(calm), record.fs, "hann", size, detrend="linear")
        inside = (f >= TUNING.f_range[0]) & (f <= TUNING.f_range[1])
        return cls(sensors, weights, f[inside], power[:, :, inside], v, mode)

    @property
    def windows(self) -> float:
        """Number of independent windows: half of those that overlap by half (Welch 1967)."""
        return 0.5 * (len(self.power) + 1)

    def tells(self, record: Record) -> bool:
        """Whether struts keep their state and enough windows are calm."""
        return not record.is_switched and self.windows >= TUNING.least_windows

    def on_fitted_level(self, vehicle: SensedVehicle, w: float) -> "Spectra":
        """Return the spectra of a vehicle on a road of waviness `w` of the drive's level."""
        prior = RoadPrior(G_d0=CLASSES["B"], w=w, track=vehicle.track)
        for _ in range(TUNING.level_updates):
            damping = equivalent_damping(vehicle.plant, self.mode, self.v, prior)
            spectra = Spectra.of(vehicle, damping, prior, self)
            prior = replace(prior, G_d0=self._whittle(spectra)[0] * prior.G_d0)
        return spectra

    def deviance(self, spectra: "Spectra") -> float:
        """Return the deviance of all windows, at the level of the road that fits them best."""
        return 2.0 * self.windows / TUNING.hann_lines * self._whittle(spectra)[1]

    def _whittle(self, spectra: "Spectra") -> tuple[float, float]:
        """Return the factor on the density of the road that fits the periodogram best, beside that
        of forces and noise, and the deviance of one window's lines.
        """
        road, forces = spectra.of_channels
        others = forces + (self.weights**2 @ self.sensors.noise_densities**2)[:, None]
        power, level = self.power.mean(axis=0), 1.0
        for _ in range(TUNING.level_steps):
            weight = (road / (level * road + others)) ** 2
            best = float(np.sum(weight * (power - others) / road) / np.sum(weight))
            level = max(best, 0.1 * level)
        total = correlate1d(level * road + others, _HANN_KERNEL, axis=1, mode="nearest")
        return level, float(np.sum(np.log(total) + power / total))


class Spectra(NamedTuple):
    """Responses `H` (F, S + 2, 2) to wheel paths and `H_force` (F, S + 2, 4) to strut forces, of
    sensors and body, with struts of this `damping` (4,) on a road of this `prior`, and the spectra
    `S` and `D` of paths and of residual strut forces.
    """

    vehicle: SensedVehicle
    drive: CalmDrive
    damping: np.ndarray
    prior: RoadPrior
    H: np.ndarray
    S: np.ndarray
    H_force: np.ndarray
    D: np.ndarray

    @classmethod
    def of(
        cls,
        vehicle: SensedVehicle,
        damping: np.ndarray,
        prior: RoadPrior,
        drive: CalmDrive,
        D: np.ndarray | None = None,
    ) -> Self:
        """Return those of a vehicle at the speed of a drive."""
        plant, v, f = vehicle.plant, drive.v, drive.f
        linear = linearise(plant, drive.mode, vehicle.points, damping=damping, speed=v)
        if D is None:
            law = nonlinear_residual(plant, drive.mode, damping)
            D = residual_force_psd(linear, law, v, prior.spectrum, f)
        H, H_force = frequency_response(linear, v, f=f), force_response(linear, f)[0]
        return cls(vehicle, drive, damping, prior, H, prior.spectrum(f / v) / v, H_force, D)

    @property
    def of_channels(self) -> np.ndarray:
        """Densities (2, C, F) [(m/s²)²/Hz] of the channels by the road and by the forces."""
        weights, f = self.drive.weights, self.drive.f
        H, H_force = (weights @ self.vehicle.readings(x, f) for x in (self.H, self.H_force))
        parts = H @ self.S @ hermitian(H), H_force @ self.D @ hermitian(H_force)
        return np.array([np.real(np.einsum("fss->sf", part)) for part in parts])
