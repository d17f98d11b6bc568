"""Identification of a vehicle from calibration drives.

Over a known road (a profile with a survey error) the readings tell the parameters directly; over
roads that nobody measured by marginal likelihood. Both are one problem with a narrow or a wide
prior of the road (`car_fit.py`), and drives of both kinds can be combined. The last third of each
drive is held out: there the described and the identified vehicle are compared.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq
from scipy.ndimage import spline_filter1d
from scipy.signal import welch

from estimators.api import CalibrationDrive, CalibrationError
from estimators.common.odometer import calibrate_odometer
from estimators.map_smoother.car_fit import STRUCTURE_POWER, CarFit, Readings, fit_car
from estimators.map_smoother.estimator import READINGS_PER_UNKNOWN, MapSmoother
from estimators.map_smoother.gauss_newton import (
    GaussNewton,
    MapSolution,
    estimate_noise_scale,
    minimize,
)
from estimators.map_smoother.objective import Objective, linearize
from estimators.map_smoother.preconditioner import stationary_hessian
from estimators.map_smoother.windows import initial_window_state, window_objective
from estimators.preprocessing import mask_record
from road_envs.analysis.information_bound import RoadPrior
from road_envs.analysis.roughness import N_0, displacement_psd
from road_envs.data.record import Profile, Record
from road_envs.sensing.instruments import instruments_of
from road_envs.vehicle.parameters import Tolerance, VehicleParameters
from road_envs.vehicle.tolerances import ParameterSpace, has_absent_elements, parameter_space

FIT_SHARE = 2.0 / 3.0
"""Share of each drive that is fitted; the rest is held out."""

MIN_DURATION, MIN_SPEED, MIN_SIGNAL = 4.0, 1.0, 3.0
"""Least duration [s] and mean speed [m/s] of the fitted part of a drive, and least standard
deviation of its accelerations in units of that of the instruments' noise."""

MIN_CORRELATION = 0.5
"""Least correlation of the readings with those expected on the known road."""

CLEARLY_BETTER = 0.03
"""Excess of the correlation with another profile from which on that one is believed."""

LEVEL_BAND = (0.2, 1.0)
"""Band [cycles/m] in which the level of a profile is taken."""

KNOWN_DATA_RATE = 100.0
"""Block means per second [Hz] of a drive over a known road."""

MODE_STARTS = {
    "frame": (7.0, 8.5, 10.5, 13.0, 16.0, 20.0),
    "bending": (15.0, 18.0, 22.0, 27.0, 33.0, 40.0),
}
"""Frequencies [Hz] of the body's modes at which searches begin: one reaches about a tenth."""

STRUCTURE_GAIN = 0.5
"""Share of the unexplained power of held-out readings that elements which the description leaves
out may leave at most, to be believed."""

UNIT_RATIO = 4.0
"""Ratio of measured to expected acceleration from which on units are suspected."""

STD_INFLATION, UNKNOWN_STD_INFLATION = 1.5, 5.0
"""Factors on posterior standard deviations for what the linear vehicle's covariances leave out,
over known and over unmeasured roads (`leaderboard/benchmarks/vehicle_knowledge.py`)."""

WHEELBASE_MARGIN = 4.0
"""Distance [m] after the beginning of a profile at which all wheels are on it."""


@dataclass(frozen=True, eq=False)
class Unexplained:
    """Power of the residual over that of the instruments' noise, and its spectrum (F,) over `f`
    (F,) [Hz], mean of the three sensors.
    """

    power: float
    f: np.ndarray
    spectrum: np.ndarray


@dataclass(frozen=True, eq=False)
class Identification:
    """Result: the `fit`, the identified `car`, and what the described and the identified vehicle
    leave `unexplained` in the held-out part of each drive.
    """

    fit: CarFit
    car: VehicleParameters
    std: np.ndarray
    unexplained: tuple[tuple[Unexplained, Unexplained], ...]

    @property
    def left(self) -> float:
        """Power that the identified vehicle leaves unexplained, mean of the held-out parts."""
        return float(np.mean([fitted.power for _, fitted in self.unexplained]))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters (P,), errors of the instruments last."""
        space = self.fit.space
        return (*space.names, *self.fit.readings.names)[: self.fit.x.size]

    @property
    def sensor_gains(self) -> tuple[float, ...]:
        """Gain of each accelerometer; 1 over unmeasured roads, where none is identified."""
        readings, errors = self.fit.readings, self.fit.x[self.fit.space.size :]
        gains = np.exp(readings.std * errors) if errors.size else np.ones(len(readings.names))
        return tuple(gains[: len(readings.sensors)].tolist())

    @property
    def displacement(self) -> float:
        """Distance [m] that the odometer lacks, mean of the drives; 0 over unmeasured roads."""
        errors = self.fit.x[self.fit.space.size :]
        if errors.size == 0:
            return 0.0
        found = (self.fit.readings.std * errors)[-2:]
        s = [solution.linearization.objective.inputs.s for solution in self.fit.solutions]
        travelled = float(np.mean([np.mean(x - x[0]) for x in s]))
        return float(found[0] + travelled * found[1])

    @property
    def factors(self) -> np.ndarray:
        """Fitted value over described value of each parameter of the vehicle."""
        space = self.fit.space
        return np.exp(space.std * self.fit.x[: space.size])


def identify(
    drives: Sequence[CalibrationDrive],
    car: VehicleParameters,
    smoother: MapSmoother | None = None,
    structure: bool | None = False,
) -> Identification:
    """Identify the parameters of `car` that have tolerances from calibration drives.

    With `structure`, the elements that the description leaves out (a frame that twists, progressive
    tyres, bushings; see `tolerances.parameter_space`) are identified as well; if it is None, where
    the held-out parts are explained much better with them. Raises CalibrationError on drives that
    do not fit, ConfigError if the vehicle has no tolerances.
    """
    if not drives:
        raise CalibrationError("an identification needs at least one drive")
    layouts = {drive.record.channels: drive.name for drive in drives}
    if len(layouts) > 1:
        one, other = list(layouts.values())[:2]
        raise CalibrationError(
            f"the drives {one} and {other} have different accelerometers; identify from drives "
            "with one layout"
        )
    chosen = smoother or MapSmoother(adapt=False)
    drives = [replace(drive, record=calibrate_odometer(drive.record)[0]) for drive in drives]
    parts = [_parts(drive, chosen) for drive in drives]
    for first, _ in parts:
        if first.profile is not None:
            _check_profile(_objective(first, car, chosen), first)
    result = _identify(parts, car, chosen, bool(structure))
    if structure is not None or result.left < STRUCTURE_POWER or not has_absent_elements(car):
        return result
    flexible = _identify(parts, car, chosen, True)
    return flexible if flexible.left < STRUCTURE_GAIN * result.left else result


def _identify(
    parts: Sequence[tuple[CalibrationDrive, CalibrationDrive]],
    car: VehicleParameters,
    smoother: MapSmoother,
    structure: bool,
) -> Identification:
    """Identify a vehicle from the first part of each drive, and judge it on the second."""
    space = parameter_space(car, structure)
    known = all(first.profile is not None for first, _ in parts)

    def solve(x: np.ndarray, **options: Any) -> list[MapSolution]:
        vehicle = space.from_vector(x[: space.size])
        return [_solve(first, vehicle, smoother, **options) for first, _ in parts]

    errors = len(Readings(parts[0][0].record.channels).names) if known else 0
    x, solutions = _nearest_start(space, space.size + errors, solve)
    solver = GaussNewton(solutions[0].stationary, smoother.huber, 40, 0.1)
    fit = fit_car(solutions, space, solver, instruments=known, start=x)
    std = np.minimum((STD_INFLATION if known else UNKNOWN_STD_INFLATION) * fit.std, 1.0)
    found = fit.x[space.size :]
    unexplained = tuple(
        (_unexplained(rest, car, smoother), _unexplained(rest, fit.car, smoother, found))
        for _, rest in parts
    )
    return Identification(fit, _with_posterior(fit, car, std), std, unexplained)


def _nearest_start(
    space: ParameterSpace, size: int, solve: Callable[..., list[MapSolution]]
) -> tuple[np.ndarray, list[MapSolution]]:
    """Return where the search begins: a resonance is found only from near its frequency.

    One mode after the other, the frequency is taken at which the drives leave the least noise
    unexplained.
    """
    x = np.zeros(size)
    for mode, frequencies in MODE_STARTS.items():
        if (name := f"variation.{mode}.f") in space.names:
            i = space.names.index(name)
            about = getattr(space.car.variation, mode).f
            points = [x + np.log(f / about) / space.std[i] * np.eye(size)[i] for f in frequencies]
            tried = [solve(point, cost_tolerance=0.1, adapt_prior=False) for point in points]
            left = [sum(float(s.noise_scale) for s in solutions) for solutions in tried]
            x = points[int(np.argmin(left))]
    return x, solve(x)


def _with_posterior(fit: CarFit, car: VehicleParameters, std: np.ndarray) -> VehicleParameters:
    """Return the fitted vehicle; its tolerances are the posterior standard deviations."""
    space: ParameterSpace = fit.space
    found = {
        name: Tolerance(relative=float(s * t), source="identified")
        for name, s, t in zip(space.names, space.std, std, strict=False)
    }
    name = car.name if car.name.endswith("identified") else f"{car.name} identified"
    return replace(fit.car, name=name, tolerances=found)


def _parts(
    drive: CalibrationDrive, smoother: MapSmoother
) -> tuple[CalibrationDrive, CalibrationDrive]:
    """Return the part of a drive that is fitted, and the rest. Raises CalibrationError."""
    record, profile = drive.record, drive.profile
    first, last = 0, record.t.size
    if profile is not None:  # both axles on the profile
        first = int(np.searchsorted(record.s, profile.s[0] + WHEELBASE_MARGIN))
        last = int(np.searchsorted(record.s, profile.s[-1]))
    elif record.t.size > smoother.window * record.fs:
        last = int(smoother.window * record.fs)
    middle = first + int(FIT_SHARE * (last - first))
    duration = (middle - first) / record.fs
    if duration < MIN_DURATION:
        where = "on its profile " if profile is not None else ""
        raise CalibrationError(
            f"{drive.name}: {duration:.1f} s {where}are too short to identify a vehicle; give "
            f"{MIN_DURATION / FIT_SHARE:.0f} s or more"
        )
    fitted, rest = (
        replace(drive, record=_slice(record, *x)) for x in ((first, middle), (middle, last))
    )
    speed = float(fitted.record.v.mean())
    if speed < MIN_SPEED:
        raise CalibrationError(
            f"{drive.name}: a mean speed of {3.6 * speed:.1f} km/h is too slow to identify a "
            f"vehicle; drive {3.6 * MIN_SPEED:.1f} km/h or faster"
        )
    noise = instruments_of(record, smoother.instruments).noise_density * np.sqrt(0.5 * record.fs)
    signal = float(np.nanstd(fitted.record.a))
    if signal < MIN_SIGNAL * noise:
        raise CalibrationError(
            f"{drive.name}: the accelerations of {signal:.2f} m/s² RMS hardly exceed the "
            f"instruments' noise of {noise:.2f} m/s²; drive a rougher road or faster"
        )
    return fitted, rest


def _slice(record: Record, first: int, last: int) -> Record:
    part = slice(first, last)
    return replace(
        record, t=record.t[part], a=record.a[:, part], v=record.v[part], s=record.s[part],
        spring_stiff=record.spring_stiff[part], damper_high=record.damper_high[part],
    )  # fmt: skip


def _objective(drive: CalibrationDrive, car: VehicleParameters, smoother: MapSmoother) -> Objective:
    """Return the objective of a drive as one window."""
    instruments = instruments_of(drive.record, smoother.instruments)
    readings = READINGS_PER_UNKNOWN
    if drive.profile is not None:  # slow readings tell of waves that a survey measures well
        smoother, readings = replace(smoother, level_ends=False, data_rate=KNOWN_DATA_RATE), 0.0
    record, valid, _ = mask_record(drive.record, instruments)
    model = smoother.measurement_model(record, car, instruments)
    prepared = smoother.prepare_drive(record, valid, car, instruments, readings)
    blocks = prepared.a.shape[1] // prepared.block_size
    prior = RoadPrior(G_d0=smoother.G_d0, w=smoother.w)
    state = initial_window_state(prepared)
    objective = window_objective(model, prepared, prior, state, 0, blocks)
    return _on_profile(objective, drive)


def _on_profile(objective: Objective, drive: CalibrationDrive) -> Objective:
    """Return the objective with the known road, if there is one, in place of the prior's.

    The road is the Wiener filter's estimate from the profile: left as measured, errors of short
    waves would count as road and make the vehicle look softer than it is.
    """
    road, profile = objective.road, drive.profile
    if profile is None:
        return objective
    prior, noise = _road_prior(profile), 2.0 * drive.survey_std**2 * profile.ds

    def share(n: np.ndarray) -> np.ndarray:
        """Return the road's share of the profile's density at `n` [cycles/m]."""
        density = prior.density(np.maximum(n, 1e-6))
        return density / (density + noise)

    s = road.origin + road.ds * np.arange(road.size)
    smooth = _filtered(profile, share)
    heights = np.array([np.interp(s, profile.s, z) for z in smooth])
    background = spline_filter1d(heights, order=3, axis=1, mode="nearest")
    rise = np.maximum(2.0 * np.sin(np.pi * road.n * road.ds), 1e-3)
    # mean and half difference have half the variance each of what is left of the error
    amplitude = rise * np.sqrt(0.25 * noise * share(road.n) / road.ds) * np.ones((2, 1))
    # the road is not moved: its error counts as noise of the readings
    known = replace(road, background=background, amplitude=amplitude, free=np.zeros(road.size))
    return replace(objective, road=known)


def _road_prior(profile: Profile) -> RoadPrior:
    """Return a prior of the profile's own level, from waves that are long against its error."""
    n, G = displacement_psd(profile.z, profile.ds)
    inside = (n > LEVEL_BAND[0]) & (n < LEVEL_BAND[1])
    return RoadPrior(G_d0=float(np.mean(G[:, inside] * (n[inside] / N_0) ** 2)))


def _filtered(profile: Profile, share: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the heights (2, M) with each wave multiplied by `share`; mirrored at both ends."""
    both = np.concatenate([profile.z, profile.z[:, ::-1]], axis=1)
    spectrum = rfft(both, axis=1) * share(rfftfreq(both.shape[1], profile.ds))
    return irfft(spectrum, both.shape[1], axis=1)[:, : profile.s.size]


def _solve(
    drive: CalibrationDrive, car: VehicleParameters, smoother: MapSmoother, **options: Any
) -> MapSolution:
    """Return the most probable road of a drive with the vehicle `car`; `options` of `minimize`."""
    objective = _objective(drive, car, smoother)
    stationary = stationary_hessian(objective)
    if drive.profile is None:
        return minimize(objective, stationary, huber=smoother.huber, **options)
    return _settle(objective, smoother)


def _settle(objective: Objective, smoother: MapSmoother, steps: int = 2) -> MapSolution:
    """Return the solution over a known road; only first state and biases are found."""
    stationary = stationary_hessian(objective)
    lin = linearize(objective, np.zeros(objective.size), objective.information)
    noise_scale, solver = np.inf, GaussNewton(stationary, smoother.huber, 40, 0.1)
    iterations = 0
    for _ in range(steps):
        noise_scale = max(1.0, min(noise_scale, estimate_noise_scale(lin, stationary, noise_scale)))
        lin, k = solver.step(lin, objective.model.plant, noise_scale)
        iterations += k
    return MapSolution(lin, stationary, noise_scale, steps, iterations)


def _unexplained(
    drive: CalibrationDrive,
    car: VehicleParameters,
    smoother: MapSmoother,
    errors: np.ndarray | None = None,
) -> Unexplained:
    """Return what `car` leaves unexplained in a drive, with instruments of these `errors`."""
    objective = _objective(drive, car, smoother)
    if errors is not None:
        objective = Readings.of(objective).apply(objective, errors)
    if drive.profile is None:
        solution = minimize(objective, stationary_hessian(objective), huber=smoother.huber)
    else:
        solution = _settle(objective, smoother)
    lin = solution.linearization
    used = objective.measurements.sample_count > 0
    r = np.where(used, np.sqrt(objective.information) * lin.residual, 0.0)
    f, S = welch(r, fs=1.0 / objective.block_duration, nperseg=min(128, r.shape[1]))
    return Unexplained(float(np.mean(r[used] ** 2)), f, S.mean(axis=0))


def _check_profile(objective: Objective, drive: CalibrationDrive) -> None:
    """Raise CalibrationError if the readings do not belong to the profile, and say what would."""
    y = objective.measurements.y
    y = y - y.mean(axis=1, keepdims=True)
    expected = _expected(objective)
    fit, ratio = _correlation(y, expected), float(y.std() / expected.std())
    profile = drive.profile
    assert profile is not None
    others = {
        "reversed": profile.z[::-1, ::-1],
        "with left and right exchanged": profile.z[::-1],
        "with the opposite sign": -profile.z,
    }
    tried = {
        what: _correlation(
            y, _expected(_on_profile(objective, replace(drive, profile=Profile(profile.s, z))))
        )
        for what, z in others.items()
    }
    best = max(tried, key=lambda what: tried[what])
    if tried[best] > max(MIN_CORRELATION, fit + CLEARLY_BETTER):
        hint = f"the profile {best} fits ({tried[best]:.2f})"
    elif fit < MIN_CORRELATION:
        hint = "it may be another stretch, or the odometer may be displaced"
    elif not 1.0 / UNIT_RATIO < ratio < UNIT_RATIO:
        raise CalibrationError(
            f"{drive.name}: the accelerations are {ratio:.2g} times those expected on its profile; "
            "check the units of both (m/s² and m)"
        )
    else:
        return
    raise CalibrationError(
        f"{drive.name}: the readings do not belong to its profile (correlation {fit:.2f} with "
        f"those expected); {hint}"
    )


def _expected(objective: Objective) -> np.ndarray:
    """Return the block means (S, J) expected on the known road, less their means."""
    residual, _ = objective.residual_at(np.zeros(objective.size))
    expected = objective.measurements.y - residual
    return expected - expected.mean(axis=1, keepdims=True)


def _correlation(y: np.ndarray, expected: np.ndarray) -> float:
    return float(np.sum(y * expected) / np.sqrt(np.sum(y**2) * np.sum(expected**2)))
