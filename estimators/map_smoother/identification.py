"""Identification of a vehicle from calibration drives.

Over a known road (a profile with a survey error) the readings tell the parameters directly, over
roads that nobody measured by marginal likelihood (`car_fit.py`); both kinds can be combined. In the
last third of each drive, which is held out, the described and the identified vehicle are compared.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq
from scipy.signal import welch

from estimators.api import CalibrationDrive, CalibrationError
from estimators.common.blas import single_blas_thread
from estimators.common.odometer import calibrate_odometer
from estimators.map_smoother.car_fit import CarFit, fit_car
from estimators.map_smoother.gauss_newton import GaussNewton, MapSolution, minimize
from estimators.map_smoother.identification_result import (
    IdentificationResult,
    Unexplained,
    posterior_of,
)
from estimators.map_smoother.instrument_errors import InstrumentErrors
from estimators.map_smoother.marginal_likelihood import NO_ERRORS
from estimators.map_smoother.objective import Objective
from estimators.map_smoother.preconditioner import stationary_hessian
from estimators.map_smoother.preparation import SolverSettings
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.vehicle_uncertainty import VehicleUncertainty
from estimators.map_smoother.windows import whole_objective
from road_envs.analysis.information_bound import RoadPrior
from road_envs.records.record import Profile, Record
from road_envs.records.roughness import N_0, displacement_psd
from road_envs.sensing.instruments import instruments_of
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import has_absent_elements, parameter_space


@single_blas_thread()
def identify(
    drives: Sequence[CalibrationDrive],
    car: VehicleParameters,
    settings: SolverSettings | None = None,
    structure: bool | None = False,
) -> IdentificationResult:
    """Identify the parameters of `car` that have tolerances from calibration drives. With
    `structure`, the elements that the description leaves out (a frame that twists, progressive
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
    chosen = settings or SolverSettings()
    drives = [replace(drive, record=calibrate_odometer(drive.record).record) for drive in drives]
    parts = [_parts(drive, chosen) for drive in drives]
    for first, _ in parts:
        if first.profile is not None:
            _check_profile(_objective(first, car, chosen), first)
    try:
        result = _identify(parts, car, chosen, bool(structure))
        if structure is None and result.left >= TUNING.structure_power and has_absent_elements(car):
            flexible = _identify(parts, car, chosen, True)
            result = flexible if flexible.left < TUNING.structure_gain * result.left else result
    except ArithmeticError as error:
        names = ", ".join(drive.name for drive in drives)
        raise CalibrationError(f"{names}: no vehicle explains the drives: {error}") from None
    _refuse_unexplained(result, drives)
    return result


def _refuse_unexplained(result: IdentificationResult, drives: Sequence[CalibrationDrive]) -> None:
    described = float(np.mean([before.power for before, _ in result.unexplained]))
    if result.left < max(TUNING.structure_power, TUNING.refused_share * described):
        return
    raise CalibrationError(
        f"{', '.join(drive.name for drive in drives)}: the identified vehicle leaves "
        f"{result.left:.3g} times the noise power unexplained in the parts that were held out, the "
        f"described one {described:.3g} times: check that distances and profile belong together, "
        "and give longer drives or other roads"
    )


def _identify(
    parts: Sequence[tuple[CalibrationDrive, CalibrationDrive]],
    car: VehicleParameters,
    settings: SolverSettings,
    structure: bool,
) -> IdentificationResult:
    fit = _fit([first for first, _ in parts], car, settings, structure)
    found = fit.x[fit.space.size :]
    unexplained = tuple(
        (_unexplained(rest, car, settings), _unexplained(rest, fit.car, settings, found))
        for _, rest in parts
    )
    return IdentificationResult(fit, *posterior_of(fit, car), unexplained)


def identify_structure(
    record: Record, car: VehicleParameters, settings: SolverSettings
) -> tuple[VehicleParameters, VehicleUncertainty]:
    """Return `car` with the elements that its description leaves out, found on one drive without
    validation, and its uncertainty. Raises CalibrationError if that is too short, slow or smooth.
    """
    is_short = TUNING.fit_share * record.t.size < TUNING.min_duration * record.fs
    first, _ = _parts(CalibrationDrive(record), settings, 1.0 if is_short else TUNING.fit_share)
    return posterior_of(_fit([first], car, settings, structure=True), car)


def _fit(
    drives: Sequence[CalibrationDrive],
    car: VehicleParameters,
    settings: SolverSettings,
    structure: bool,
) -> CarFit:
    """Return the fit to `drives`. A resonance is found only from near its frequency, so for one
    mode after the other the frequency is searched at which the drives cost least. The noise that
    they leave does not tell where all of it is explained: by another road.
    """
    space = parameter_space(car, structure)
    known = all(drive.profile is not None for drive in drives)

    def solve(x: np.ndarray, quick: bool = False) -> list[MapSolution]:
        vehicle = space.from_vector(x[: space.size])
        return [_solve(drive, vehicle, settings, quick) for drive in drives]

    def cost(x: np.ndarray) -> float:
        return sum(one.linearization.cost_under(np.ones(1)) for one in solve(x, quick=True))

    errors = len(InstrumentErrors(drives[0].record.channels).names) if known else 0
    x = np.zeros(space.size + errors)
    starts = {"frame": TUNING.frame_starts, "bending": TUNING.bending_starts}
    for mode, frequencies in starts.items():
        if (name := f"variation.{mode}.f") in space.names:
            i = space.names.index(name)
            about, unit = getattr(space.car.variation, mode).f, np.eye(x.size)[i]
            points = [x + np.log(f / about) / space.std[i] * unit for f in frequencies]
            x = min(points, key=cost)
    solver, steps = GaussNewton(settings.huber), TUNING.identification_steps
    return fit_car(solve(x), space, solver, instruments=known, start=x, max_steps=steps)


def _parts(
    drive: CalibrationDrive, settings: SolverSettings, share: float = TUNING.fit_share
) -> tuple[CalibrationDrive, CalibrationDrive]:
    """Return the `share` of a drive that is fitted, and the rest. Raises CalibrationError."""
    record, profile = drive.record, drive.profile
    first, last = 0, record.t.size
    if profile is not None:  # both axles on the profile
        first = int(np.searchsorted(record.s, profile.s[0] + TUNING.wheelbase_margin))
        last = int(np.searchsorted(record.s, profile.s[-1]))
    elif record.t.size > settings.window * record.fs:
        last = int(settings.window * record.fs)
    middle = first + int(share * (last - first))
    duration = (middle - first) / record.fs
    if duration < TUNING.min_duration:
        where = "on its profile " if profile is not None else ""
        raise CalibrationError(
            f"{drive.name}: {duration:.1f} s {where}are too short to identify a vehicle; give "
            f"{TUNING.min_duration / TUNING.fit_share:.0f} s or more"
        )
    parts = slice(first, middle), slice(middle, last)
    fitted, rest = (replace(drive, record=record.select(part)) for part in parts)
    speed = float(fitted.record.v.mean())
    if speed < TUNING.min_speed:
        raise CalibrationError(
            f"{drive.name}: a mean speed of {3.6 * speed:.1f} km/h is too slow to identify a "
            f"vehicle; drive {3.6 * TUNING.min_speed:.1f} km/h or faster"
        )
    noise = instruments_of(record, settings.instruments).noise_density * np.sqrt(0.5 * record.fs)
    signal = float(np.nanstd(fitted.record.a))
    if signal < TUNING.min_signal * noise:
        raise CalibrationError(
            f"{drive.name}: the accelerations of {signal:.2f} m/s² RMS hardly exceed the "
            f"instruments' noise of {noise:.2f} m/s²; drive a rougher road or faster"
        )
    return fitted, rest


def _objective(
    drive: CalibrationDrive, car: VehicleParameters, settings: SolverSettings
) -> Objective:
    readings, is_measured = TUNING.readings_per_unknown, drive.profile is not None
    if is_measured:  # slow readings tell of waves that a survey measures well
        rate, readings = TUNING.known_data_rate, 0.0
        settings = replace(settings, level_ends=False, data_rate=rate)
    # on a profile the speed is one of the instruments' errors
    speed_std = None if is_measured else 0.0
    prepared, _ = settings.prepare(drive.record, car, readings, speed_std)
    return _on_profile(whole_objective(prepared, settings.road_prior), drive)


def _on_profile(objective: Objective, drive: CalibrationDrive) -> Objective:
    """Return the objective with the known road, if there is one, in place of the prior's: the
    Wiener filter's estimate from the profile. Left as measured, errors of short waves would count
    as road and make the vehicle look softer than it is.
    """
    road, profile = objective.road, drive.profile
    if profile is None:
        return objective
    # a prior of the profile's own level, from waves that are long against its error
    n, G = displacement_psd(profile.z, profile.ds)
    inside = (n > TUNING.level_band[0]) & (n < TUNING.level_band[1])
    prior = RoadPrior(G_d0=float(np.mean(G[:, inside] * (n[inside] / N_0) ** 2)))
    noise = 2.0 * drive.survey_std**2 * profile.ds

    def share(n: np.ndarray) -> np.ndarray:
        """The road's share of the profile's density at `n` [cycles/m]."""
        density = prior.density(np.maximum(n, 1e-6))
        return density / (density + noise)

    both = np.concatenate([profile.z, profile.z[:, ::-1]], axis=1)  # mirrored at both ends
    spectrum = rfft(both, axis=1) * share(rfftfreq(both.shape[1], profile.ds))
    smooth = irfft(spectrum, both.shape[1], axis=1)[:, : profile.s.size]
    background = road.spline_of(Profile(profile.s, smooth))
    rise = np.maximum(2.0 * np.sin(np.pi * road.n * road.ds), 1e-3)
    # mean and half difference have half the variance each of what is left of the error
    amplitude = rise * np.sqrt(0.25 * noise * share(road.n) / road.ds) * np.ones((2, 1))
    # the road is not moved: its error counts as noise of the readings
    known = replace(
        road, background=background, prior_amplitude=amplitude, density=np.ones(road.n.size),
        free=np.zeros(road.size),
    )  # fmt: skip
    return replace(objective, road=known)


def _check_profile(objective: Objective, drive: CalibrationDrive) -> None:
    (one,), profile = objective.passes, drive.profile
    assert profile is not None
    y = one.measurements.y - one.measurements.y.mean(axis=1, keepdims=True)

    def compare(z: np.ndarray) -> tuple[float, float]:
        """The correlation with the readings expected on heights `z`, and the ratio to them."""
        known = _on_profile(objective, replace(drive, profile=Profile(profile.s, z))).road
        lin = one.linearize(known.background, np.zeros(one.size))
        expected = one.measurements.y - lin.residual
        expected -= expected.mean(axis=1, keepdims=True)
        fit = np.sum(y * expected) / np.sqrt(np.sum(y**2) * np.sum(expected**2))
        return float(fit), float(y.std() / expected.std())

    fit, ratio = compare(profile.z)
    others = {
        "reversed": profile.z[::-1, ::-1],
        "with left and right exchanged": profile.z[::-1],
        "with the opposite sign": -profile.z,
    }
    tried = {what: compare(z)[0] for what, z in others.items()}
    best = max(tried, key=lambda what: tried[what])
    if tried[best] > max(TUNING.min_correlation, fit + TUNING.clearly_better):
        hint = f"the profile {best} fits ({tried[best]:.2f})"
    elif fit < TUNING.min_correlation:
        hint = "it may be another part of the road, or the odometer may be displaced"
    elif not 1.0 / TUNING.unit_ratio < ratio < TUNING.unit_ratio:
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


def _solve(
    drive: CalibrationDrive,
    car: VehicleParameters,
    settings: SolverSettings,
    quick: bool = False,
    errors: np.ndarray = NO_ERRORS,
) -> MapSolution:
    """Return the most probable road of a drive with the vehicle `car` and instruments that have
    these `errors`, roughly if `quick`.
    """
    objective, solver = _objective(drive, car, settings), GaussNewton(settings.huber)
    (one,) = objective.passes
    objective = replace(objective, passes=(InstrumentErrors.of(one).apply(one, errors),))
    if drive.profile is not None:
        return _settle(objective, solver, 2 if quick else TUNING.settling_steps)
    if quick:
        solver = replace(solver, change_tolerance=1.0, adapt_prior=False)
    return minimize(objective, solver)


def _settle(objective: Objective, solver: GaussNewton, max_steps: int) -> MapSolution:
    """Return the solution over a known road, of first state and biases alone: a drive that is cut
    out begins in motion, and only a few steps find its first state.
    """
    lin = objective.linearize(np.zeros(objective.size))
    found = MapSolution(lin, stationary_hessian(objective), np.array([np.inf]))
    for _ in range(max_steps):
        before, found = found.noise_scale, found.with_noise_scale()
        if found.noise_scale[0] > TUNING.settled_on_known * before[0]:
            break
        found, _ = solver.step(found)
    return found


def _unexplained(
    drive: CalibrationDrive,
    car: VehicleParameters,
    settings: SolverSettings,
    errors: np.ndarray = NO_ERRORS,
) -> Unexplained:
    (lin,) = _solve(drive, car, settings, errors=errors).linearization.passes
    source, used = lin.source, lin.source.is_used
    r = np.where(used, np.sqrt(source.information) * lin.residual, 0.0)
    f, S = welch(r, fs=1.0 / source.block_duration, nperseg=min(128, r.shape[1]))
    power = float(np.mean(r[used] ** 2)) / source.band_share
    return Unexplained(power, f, S.mean(axis=0))
