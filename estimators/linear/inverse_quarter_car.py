"""Inverse of four quarter cars: from the body acceleration above each strut to the road under its
wheel.

Three or more accelerometers on the body give heave, roll and pitch of a rigid body, hence the
acceleration a above each strut. Each corner is treated as an independent quarter car and the
forward problem is inverted (after Ngwangwa 2020, who inverts the solution of the vertical ride
dynamics):

    body      m_s a = -(k_s + c_s p) e                       e: extension of the strut
    strut     z_u   = a / p² - e                             z_u: height of the wheel
    wheel     (k_t + c_t p) (z_r - z_u) = m_u p² z_u + m_s a  z_r: height of the road

with p = 2 pi j f. So z_r = R(p) a, exactly. Spring and tyre are linear about rest; c_s is the
equivalent damper for the extension rate that this inversion finds in the record. The estimate is
the mean of the heights under the front and rear wheel of a path.

R has a double pole at f = 0, where height is not observable: R / (1 + |R|² H_0²) is used instead,
which is R above `f_low` (H_0 is |1 / R| there) and tends to zero below it. From 25 to 30 Hz the
response fades to zero. The band is therefore f_low / v to 25 Hz / v: 0.07 to 6.2 cycles/m at
14.5 km/h, 0.02 to 1.7 cycles/m at 54 km/h.

R knows no resonance of the body and no coupling of the corners, and exaggerates the road where
either moves the body. Roads have spectra near S = S_0 / f² at constant speed (ISO 8608, w = 2), so
mean and half difference of the wheel paths under each axle are weighted as Wiener's filter does, by
S / (S + N): S + N is the spectrum of the inverse itself in third octaves, S_0 the median of
f² (S + N) over them.

Without these weights (`weigh`), the mean of the wheel paths is exact if equal corners are uncoupled
(body as four point masses over its struts, axles as two under them). Their difference is not: the
rigid body's roll responds to the mean of front and rear, so the fraction cos²(pi n wheelbase) of
the difference is recovered at the spatial frequency n.

Limitations: errors of half the road's level and more on any vehicle, for that reason and others;
the weights take a road of single obstacles for a smooth one with noise.
The Defender's body has 0.72 of the pitch inertia and 1.31 of the roll inertia of uncoupled corners,
and its struts stand further in than its wheels. The error in the scored band is 0.52 to 0.66 of the
road's level for a linear Defender, and about the same with friction.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from estimators.preprocessing import RecordError, clean_record
from estimators.wiener.segments import dominant_modes
from road_envs.core.config import Settings
from road_envs.records.record import F_C, Estimate, Record, profile_stations
from road_envs.sensing.instruments import SensorLocation, instruments_of
from road_envs.vehicle.equations import Plant, build_plant
from road_envs.vehicle.linear_model import gaussian_damping, strut_forces
from road_envs.vehicle.parameters import VehicleParameters

_PADDING_TIME = 8.0  # zeros [s] appended to a record before it repeats in the DFT circle
_FADE_RATIO = 1.2  # the response fades to zero from F_C to this multiple of it
_MIN_LEVER = 0.1  # least singular value of lever arms [m]: with less, noise hides the rotations
# Width of the bands in which the spectrum of the inverse is averaged, in octaves
_OCTAVE_SHARE = 1.0 / 3.0
PATHS = 0.5 * np.array([[1.0, 1.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0],
                        [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, -1.0]])  # fmt: skip
"""From heights in wheel order to mean and half difference under the front and the rear axle."""
_INITIAL_RATE_STD = 0.1  # initial standard deviation [m/s] of the struts' rates
_DAMPING_ITERATIONS = 4  # number of updates of the dampers


class _QuarterCars(NamedTuple):
    """The four corners, arrays (4,) in wheel order: sprung and unsprung mass [kg], rate [N/m] and
    damping [N s/m] of strut and tyre.
    """

    m_s: np.ndarray
    m_u: np.ndarray
    k_s: np.ndarray
    c_s: np.ndarray
    k_t: np.ndarray
    c_t: np.ndarray

    def extension(self, f: np.ndarray) -> np.ndarray:
        """Return strut extension per acceleration above it (4, F) [s²] at `f` (F,) [Hz]."""
        m_s, k_s, c_s = (x[:, None] for x in (self.m_s, self.k_s, self.c_s))
        return -m_s / (k_s + 2j * np.pi * f * c_s)

    def inverse(self, f: np.ndarray) -> np.ndarray:
        """Return R (4, F): road height per body acceleration [s²] at `f` (F,) > 0 [Hz]."""
        p = 2j * np.pi * f
        m_s, m_u, k_t, c_t = (x[:, None] for x in (self.m_s, self.m_u, self.k_t, self.c_t))
        z_u = 1.0 / p**2 - self.extension(f)
        return z_u + (m_u * p**2 * z_u + m_s) / (k_t + c_t * p)


@dataclass(frozen=True, kw_only=True)
class InverseQuarterCar(Settings):
    """Inverse of a quarter car at each corner, for a vehicle with these `instruments`. Below
    `f_low` [Hz] nothing is estimated.

    `weigh`: lines are weighted by what is plausible of a road; if not, the inverse is plain.
    """

    causal: ClassVar[bool] = False

    instruments: str = "paper"
    f_low: Annotated[float, Field(gt=0, lt=F_C), "Hz", "lower end of the band"] = 0.3
    weigh: bool = True

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Estimate both wheel paths. Raises ConfigError, RecordError."""
        sensors = instruments_of(record, self.instruments)
        record, notes = clean_record(record, None)
        size = next_fast_len(record.t.size + round(_PADDING_TIME * record.fs), real=True)
        f = rfftfreq(size, 1.0 / record.fs)
        f[0] = 0.5 * f[1]  # R has a pole at 0
        a = _accelerations_at_struts(record.a, sensors.locations(car), car)
        lines = rfft(a - a.mean(axis=1, keepdims=True), size)
        fade = np.clip((_FADE_RATIO * F_C - f) / ((_FADE_RATIO - 1.0) * F_C), 0.0, 1.0)
        lines *= fade / sensors.response(f)
        mode, samples = dominant_modes(record, np.arange(record.t.size)), record.t.size
        plant, rate = build_plant(car.rigid), np.full(4, _INITIAL_RATE_STD)
        for _ in range(_DAMPING_ITERATIONS):  # dampers equivalent for the recorded motion
            corners = _quarter_cars(plant, car, mode, rate)
            e_dot = irfft(2j * np.pi * f * corners.extension(f) * lines)[:, :samples]
            rate = np.maximum(e_dot.std(axis=1), 1e-3)
        R = corners.inverse(f)
        H_0 = 1.0 / np.abs(corners.inverse(np.array([self.f_low])))
        heights = lines * R / (1.0 + np.abs(R * H_0) ** 2)
        if self.weigh:
            heights = _weigh_by_road(heights, f, 2.0 * self.f_low)
        z = irfft(heights, size)[:, :samples]
        lowest, highest = self.f_low / record.v.max(), F_C / record.v.max()
        band = f"waves from {lowest:.2g} to {highest:.2g} cycles/m are estimated"
        z = _merge_axles(record, z, car.wheelbase)
        if record.is_switched:
            notes = (*notes, "treated as driven in the dominant strut states")
        notes = (*notes, band)
        return Estimate(profile_stations(record.length), z, notes=notes)


def _accelerations_at_struts(
    a: np.ndarray, locations: Mapping[str, SensorLocation], car: VehicleParameters
) -> np.ndarray:
    """Return accelerations (4, N) of a rigid body above its struts from those (k, N) of the
    sensors at `locations`; sensors on the axles are not used. Raises RecordError if the others do
    not determine the motion of the body.
    """
    on_body = [i for i, place in enumerate(locations.values()) if place.axle is None]
    sensed = np.array([(1.0, place.x, place.y) for place in locations.values()])[on_body]
    if np.linalg.matrix_rank(sensed, tol=_MIN_LEVER) < 3:
        raise RecordError(
            "inverse_quarter_car needs three accelerometers on the body that are not in one line, "
            f"to resolve heave, roll and pitch; the record has {', '.join(locations)}"
        )
    struts = np.array([(1.0, axle.x, y) for axle in car.axles for y in (axle.y_s, -axle.y_s)])
    if len(on_body) == 3:  # three are the inverse exactly, more its least squares
        return struts @ np.linalg.solve(sensed, a[on_body])
    return struts @ np.linalg.lstsq(sensed, a[on_body])[0]


def _quarter_cars(
    plant: Plant, car: VehicleParameters, mode: Mapping[str, str], rate: np.ndarray
) -> _QuarterCars:
    """Return the corners of a vehicle for strut rates of standard deviation `rate` (4,) [m/s]."""
    near = np.array([-1e-4, 1e-4]) * np.ones((4, 1))
    F = strut_forces(plant, mode, near, np.zeros_like(near))
    share = np.array([-car.rear.x, car.front.x]) / (2.0 * car.wheelbase)
    axles = [axle for axle in car.axles for _ in range(2)]
    return _QuarterCars(
        m_s=car.m_b * np.repeat(share, 2),
        m_u=np.array([0.5 * axle.m for axle in axles]),
        k_s=(F[:, 0] - F[:, 1]) / (near[:, 1] - near[:, 0]),
        c_s=gaussian_damping(plant, mode, rate),
        k_t=np.array([axle.k_t for axle in axles]),
        c_t=np.array([axle.c_t for axle in axles]),
    )


def _weigh_by_road(heights: np.ndarray, f: np.ndarray, f_low: float) -> np.ndarray:
    """Return the spectra `heights` (4, F) under the wheels at `f` (F,) [Hz], weighted as Wiener's
    filter would for roads with a spectrum in proportion to 1 / f² from `f_low` on.
    """
    paths = PATHS @ heights
    bands = round(np.log2(F_C / f_low) / _OCTAVE_SHARE)
    edges = np.geomspace(f_low, F_C, bands + 1)
    power, weights = np.abs(f * paths) ** 2, np.ones_like(f) * np.ones((4, 1))
    inside = [band for lo, hi in pairwise(edges) if (band := (f >= lo) & (f < hi)).any()]
    centre = np.array([np.log(f[band]).mean() for band in inside])
    for row, lines in zip(weights, power, strict=True):
        level = np.array([lines[band].mean() for band in inside])
        if level.size and level.min() > 0.0:
            row[:] = np.interp(np.log(f), centre, np.minimum(1.0, np.median(level) / level))
    return np.linalg.inv(PATHS) @ (weights * paths)


def _merge_axles(record: Record, z: np.ndarray, wheelbase: float) -> np.ndarray:
    """Return both wheel paths (2, M) [m] at the profile stations from heights (4, N) [m] under the
    wheels over time: the mean of front and rear, or the one that passed the station within the
    record.
    """
    stations = profile_stations(record.length)
    axles = (stations, z[:2]), (stations + wheelbase, z[2:])
    heights = np.array([record.interpolate(at, wheels) for at, wheels in axles])
    weights = [np.where((at >= record.s[0]) & (at <= record.s[-1]), 1.0, 1e-9) for at, _ in axles]
    return np.einsum("am,asm->sm", np.array(weights) / np.sum(weights, axis=0), heights)
