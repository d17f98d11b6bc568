"""Maximum a posteriori road under the full nonlinear vehicle (4D-Var).

    minimize  1/2 sum over block means ((y - a(road)) / sigma)² + 1/2 |u|²

a(road) is what the accelerometers measure when the vehicle, with its gas springs, dampers,
friction, stops and tyres that lift off, is driven over the road. u is white noise that the prior
shapes into an equally rough surface in all directions (`road_prior.py`); its density is
re-estimated from the drive, octave by octave, and along the road where it is rough in places only
(potholes, bumps). A clipped sample is a limit: the acceleration was at least that. Both axles roll
over the same unknown road. Gauss-Newton steps with the exact tangent and adjoint of the simulator's
step (`objective.py`) are solved by conjugate gradients, preconditioned by the stationary linear
vehicle (`preconditioner.py`). Friction is smoothed and the noise inflated at first and less so in
later steps (`gauss_newton.py`). Where a wheel has lifted off, the road is lowered, and at last it
is the mean of what it may be there (`wheel_liftoff.py`). (Talagrand & Courtier 1987,
doi:10.1002/qj.49711347812, for the adjoint method.)

The model is the vehicle as given, in steps of 1 ms. The measurements are means over 5 ms of the raw
samples, so up to about 90 Hz: friction mixes frequencies, and accelerations above the scored 25 Hz
carry information about the road below.

A vehicle that differs from the one given within its tolerances is fitted to the drive
(`car_fit.py`), and one that stays unexplained with the elements that the description leaves out but
whose tolerances say what they are about, such as a frame that twists (`identification.py`).

Known to fail: under a lifted wheel, where the road is only known to lie below it, as over a hole
whose floor the wheel does not reach; for waves longer than about 50 m, which are hardly observable
at a walking pace and left out.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from estimators.api import CalibrationError, copy_with
from estimators.common.bending import sensed_bending
from estimators.common.block_means import MIN_NOISE_DENSITY
from estimators.common.explained import reduce_unexplained
from estimators.common.misfit import misfit_note
from estimators.common.model_inputs import (
    MOVING_STD,
    REST_STD,
    build_model_inputs,
    is_even,
    rest_state,
)
from estimators.common.odometer import calibrate_odometer
from estimators.common.sensor_filter import SensorFilter, is_only_a_delay
from estimators.low_pass import bridge
from estimators.map_smoother.car_fit import (
    STRUCTURE_POWER,
    CarFit,
    can_show_vehicle,
    fit_car,
    fit_if_due,
    is_believed,
)
from estimators.map_smoother.gauss_newton import (
    NOISE_SCALE_WARNING,
    PRIOR_UPDATES,
    GaussNewton,
    MapSolution,
    minimize,
)
from estimators.map_smoother.identified_vehicle import CalibratedByIdentification
from estimators.map_smoother.objective import MeasurementModel, Objective
from estimators.map_smoother.passes import estimate_jointly
from estimators.map_smoother.posterior_sampling import posterior_mean_and_std
from estimators.map_smoother.preconditioner import stationary_hessian
from estimators.map_smoother.speed_error import distance_scale, estimate_speed_error
from estimators.map_smoother.vehicle_uncertainty import VehicleUncertainty
from estimators.map_smoother.wheel_liftoff import distance_in_air
from estimators.map_smoother.windows import MARGIN, PreparedDrive, reconstruct
from estimators.preprocessing import (
    MaskedRecord,
    clipped_signs,
    mask_record,
    restore_times,
)
from road_envs.analysis.information_bound import RoadPrior
from road_envs.core.config import STRICT
from road_envs.records.record import Estimate, Record, profile_stations, scored_band
from road_envs.records.roughness import CLASSES
from road_envs.sensing.instruments import Instruments, instruments_of, on_axle
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.linear_model import linearise
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import has_absent_elements, parameter_space

NODE_SPACING_RANGE = (0.025, 0.05)
"""Least and greatest distance of the road's nodes [m]."""

READINGS_PER_UNKNOWN = 2.0
"""Block means per unknown of the road, at least: with as many unknowns as readings the unexplained
noise is overestimated, and a fitted vehicle is biased."""

AXLE_READINGS_PER_UNKNOWN = 1.0
"""The same where a sensor is on an axle: the tyre passes on waves that the nodes cannot hold, and
longer means keep them out."""

DELAY_NOISE_DENSITY = 5e-3
"""Noise density [(m/s²)/sqrt(Hz)] below which sensors on the body show that an anti-alias filter is
more than a delay."""

F_RESOLVED = 70.0
"""Frequency [Hz] that the nodes resolve at any speed, within NODE_SPACING_RANGE."""

FIT_INFLATION = 1.4
"""Factor on the errors of a vehicle that was fitted to this drive alone, as
`posterior_sampling.TOLERANCE_INFLATION`."""

EVIDENCE_DUE, VEHICLE_SHARE_DUE = 100.0, 0.5
"""Power of the residual that errors of the vehicle explain, in units of the noise, and share of the
variance of the heights that the tolerances make, from which on the vehicle is fitted, also where
nothing else is unexplained: on smooth roads the road takes most of what a wrong vehicle leaves. The
power is 4 to 88 for vehicles as described and 52 to 1600 for those of grade S1 (seed 211)."""

VEHICLE_SHARE_NOTED = 0.75
"""Share of the variance of the heights from which on a note says that the vehicle is the reason:
their standard deviation is then twice that of a known vehicle."""

LOST_NOISE_SCALE, LOST_POWER_SHARE = 300.0, 0.3
"""Noise scale above which the minimization has lost the vehicle, as on obstacles that throw it off
the ground again and again, if it also exceeds this share of the signals' power: the noise of good
instruments is small beside what a vehicle that is not the one described leaves unexplained.
"""

LOST_AIR_SHARE = 0.25
"""Distance that wheels spend in the air, over the road's length, from which on no share of the
power is allowed: no wheel supports such heights (bumps of 0.15 m at 54 km/h: 0.5 to 0.7)."""


@dataclass(frozen=True, kw_only=True)
class MapSmoother(CalibratedByIdentification):
    """Estimator of the maximum a posteriori road.

    - `instruments`: name or path; `noise_density` [(m/s²)/sqrt(Hz)] if it is not theirs.
    - `G_d0` [m³] and `w`: the road's prior; `adapt_prior`: re-estimate its density from the drive,
      between the last steps at most `prior_updates` times.
    - `data_rate` [Hz] of the block means, at least; `step` [s]: longest step of the model.
    - `level_ends`: the road is level before station 0 and behind its length, where the drive begins
      at rest.
    - `huber`: standard deviations beyond which a measurement is down-weighted.
    - `window`, `overlap` [s]: longer drives are estimated window by window.
    - `draws`: posterior samples for the standard deviation, 0 for none.
    - `adapt`: where the unexplained noise says that the vehicle differs, and its file gives
      tolerances, the parameters are fitted to the drive (`car_fit.py`).
    """

    __pydantic_config__ = STRICT
    causal: ClassVar[bool] = False

    noise_density: float | None = None
    G_d0: float = CLASSES["D"]
    w: float = 2.0
    adapt_prior: bool = True
    prior_updates: int = PRIOR_UPDATES
    data_rate: float = 200.0
    step: float = 0.001
    level_ends: bool = True
    huber: float = 5.0
    window: float = 40.0
    overlap: float = 5.0
    draws: int = 2
    adapt: bool = True

    def __post_init__(self):
        for name in ("G_d0", "w", "data_rate", "step", "huber", "overlap"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.noise_density is not None and not self.noise_density > 0:
            raise ValueError(f"noise_density must be positive, got {self.noise_density}")
        if not self.window >= 2.0 * self.overlap:
            raise ValueError(
                f"window must be at least twice the overlap of {self.overlap} s, got {self.window}"
            )
        for name in ("draws", "prior_updates"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Estimate both wheel paths. Raises ConfigError, RecordError, ArithmeticError."""
        record, odometer = calibrate_odometer(record)
        record, car = self.as_identified(record, car)
        found = self._estimate_adapting(record, car)
        return replace(found, notes=(*found.notes, *odometer))

    def _estimate_adapting(self, record: Record, car: VehicleParameters) -> Estimate:
        """Estimate both wheel paths, also with elements that the description leaves out."""
        known = None if self.identified is None else self.identified.uncertainty
        first, findings = self._estimate(record, car, known)
        left = findings.left_by_fit
        if findings.speed_errors and not findings.fit:  # places need the vehicle, flights or not
            left = max(left, findings.noise_scale)
        if not (self.adapt and left >= STRUCTURE_POWER and has_absent_elements(car)):
            return first
        from estimators.map_smoother.identification import STRUCTURE_GAIN, identify_structure

        told = replace(self, adapt=False)
        try:  # the vehicle may have elements that its description leaves out
            found, uncertainty = identify_structure(record, car, told)
            second, flexible = told._estimate(record, found, uncertainty)
        except (CalibrationError, ArithmeticError):
            return first
        if flexible.noise_scale > STRUCTURE_GAIN * left:
            return first
        note = f"a frame that can {_describe_modes(found)} was found, and adapted to the drive"
        return replace(second, notes=(*second.notes, note))

    def _estimate(
        self,
        record: Record,
        car: VehicleParameters,
        uncertainty: VehicleUncertainty | None = None,
    ) -> tuple[Estimate, "_Findings"]:
        """Return both wheel paths, and what was found beside them.

        `uncertainty` is that of a vehicle that was identified.
        """
        model, drive, notes = self.prepare(record, car, speed_unknown=True)
        band, findings = scored_band(float(drive.inputs.v.mean())), _Findings()

        def adapt_car(solution: MapSolution, solver: GaussNewton) -> MapSolution:
            fit = fit_if_due([solution], car, solver)
            if fit is None:
                return solution
            if not is_believed(fit, [solution]):
                left = float(np.max(fit.solutions[0].noise_scale))
                findings.left_by_fit = max(findings.left_by_fit, left)
                return solution
            findings.fit = fit
            return fit.solutions[0]

        def solve(objective: Objective) -> tuple[MapSolution, np.ndarray]:
            if findings.fit:  # the vehicle of the first window is that of the whole drive
                fitted = objective.with_car(findings.fit.car).model
                objective = replace(objective, model=fitted)
            solver = GaussNewton(stationary_hessian(objective), self.huber)
            solution = minimize(
                objective,
                solver,
                adapt_prior=self.adapt_prior,
                prior_updates=self.prior_updates,
                adapt_car=adapt_car if self.adapt and not findings.fit else None,
            )
            findings.in_air += distance_in_air(solution.linearization)
            if model.speed_std > 0.0:
                findings.speed_errors.append(estimate_speed_error(solution))
            fit, uncertain = findings.fit, uncertainty
            if fit:
                uncertain = replace(VehicleUncertainty.of_fit(fit), inflation=FIT_INFLATION)
            elif self.adapt and uncertainty is None and car.tolerances:
                uncertain = VehicleUncertainty.of_tolerances(car, tuple(model.locations))
            posterior = posterior_mean_and_std(solution, band, self.draws, uncertain)
            is_seen = posterior.evidence > EVIDENCE_DUE and can_show_vehicle(solution)
            if is_seen and posterior.vehicle_share > VEHICLE_SHARE_DUE:
                with suppress(ArithmeticError):  # a varied vehicle's motion was not finite
                    fit = fit_car([solution], parameter_space(car), solver)
                    findings.fit = fit
                    uncertain = VehicleUncertainty.of_tolerances(fit.car, tuple(model.locations))
                    uncertain = replace(uncertain, is_prior=False, inflation=FIT_INFLATION)
                    solution = fit.solutions[0]
                    posterior = posterior_mean_and_std(solution, band, self.draws, uncertain)
            findings.vehicle_share = max(findings.vehicle_share, posterior.vehicle_share)
            return posterior.solution, posterior.std

        windows = drive.split(self.window, self.overlap)
        result, noise_scales = reconstruct(model, drive, self.road_prior, windows, solve)
        noise_scale = findings.noise_scale = float(max(noise_scales))
        s = profile_stations(record.length)
        z, std = result.at_stations(drive, s)
        z_std = std if self.draws else None
        if findings.in_air >= 0.1:
            notes += (
                f"wheels were in the air for {findings.in_air:.1f} m of the drive; the road below "
                "them is uncertain",
            )
        if findings.fit:
            notes += (f"the vehicle was adapted to the drive: {findings.fit.summary()}",)
        if noise_scale > NOISE_SCALE_WARNING:
            notes += (misfit_note(noise_scale),)
        if findings.vehicle_share > VEHICLE_SHARE_NOTED:
            ratio = np.sqrt(1.0 / (1.0 - findings.vehicle_share))
            notes += (
                f"the errors are {ratio:.1f} times those of a vehicle that is known: calibrate it, "
                "or drive on a rougher road as well",
            )
        lost = LOST_NOISE_SCALE
        if findings.in_air < LOST_AIR_SHARE * record.length:
            lost = max(lost, LOST_POWER_SHARE * float(drive.a.var()) / model.noise_variance)
        distance, doubts = distance_scale(findings.speed_errors, model)
        notes += doubts
        if (share := lost / noise_scale) < 1.0:
            z, z_std = reduce_unexplained(z, z_std, share)
            distance = None
            notes += (
                f"the heights are reduced to {share:.0%}: their motion is not the measured one",
            )
        return Estimate(s, z, z_std, notes, distance=distance), findings

    def for_one_of_many(self) -> "MapSmoother":
        """Return the estimator of a single pass of several: fast, for alignment and as a start."""
        return copy_with(self, draws=0, adapt=False, prior_updates=0)

    def estimate_jointly(
        self,
        records: Sequence[Record],
        cars: Sequence[VehicleParameters],
        start: Estimate,
        names: Sequence[str],
    ) -> Estimate:
        """Estimate one road from several passes (`estimators.passes.JointEstimator`)."""
        pairs = zip(records, cars, strict=True)
        known = [self.as_identified(record, car) for record, car in pairs]
        corrected, identified = [record for record, _ in known], [car for _, car in known]
        return estimate_jointly(self, corrected, identified, start, names)

    @property
    def road_prior(self) -> RoadPrior:
        """The road's prior."""
        return RoadPrior(G_d0=self.G_d0, w=self.w)

    def prepare(
        self,
        record: Record,
        car: VehicleParameters,
        readings_per_unknown: float = READINGS_PER_UNKNOWN,
        speed_unknown: bool = False,
    ) -> tuple[MeasurementModel, PreparedDrive, tuple[str, ...]]:
        """Return the model of vehicle and instruments, the prepared drive and notes on the record.

        Raises ConfigError, RecordError.
        """
        instruments = instruments_of(record, self.instruments)
        masked = restore_times(mask_record(record, instruments), record, instruments)
        model = self._measurement_model(masked.record, car, instruments)
        if speed_unknown:
            model = replace(model, speed_std=instruments.speed_error)
        model, drive = self._prepare_drive(masked, car, instruments, model, readings_per_unknown)
        return model, drive, masked.notes

    def _measurement_model(
        self, record: Record, car: VehicleParameters, instruments: Instruments
    ) -> MeasurementModel:
        """Return the model of the vehicle and its instruments."""
        one, locations = build_plant(car), instruments.locations(car)
        sensor_rows = linearise(one, "ride", locations).sensor_rows
        density = self.noise_density or max(instruments.noise_density, MIN_NOISE_DENSITY)
        noise = density**2 * 0.5 * record.fs
        return MeasurementModel(
            one, car.valve.lag, car.wheelbase, locations, sensor_rows, noise,
            bending=sensed_bending(car, locations), contact_length=car.variation.contact_length,
            bandwidth=record.bandwidth,
        )  # fmt: skip

    def _prepare_drive(
        self,
        masked: MaskedRecord,
        car: VehicleParameters,
        instruments: Instruments,
        model: MeasurementModel,
        readings_per_unknown: float,
    ) -> tuple[MeasurementModel, PreparedDrive]:
        """Return the `model`, with the anti-alias filter where it does more than delay the samples,
        and the drive of a masked record.
        """
        record, valid, v = masked.record, masked.valid, float(masked.record.v.mean())
        ds = float(np.clip(0.5 * v / F_RESOLVED, *NODE_SPACING_RANGE))
        unknowns = 2.0 * v / ds  # per second
        rate = max(self.data_rate, readings_per_unknown * unknowns / len(record.a))
        is_on_axle = on_axle(model.locations)
        if is_on_axle and readings_per_unknown > 0.0:
            rate = AXLE_READINGS_PER_UNKNOWN * unknowns / len(record.a)
        block = max(1, round(record.fs / rate))
        precise = is_on_axle or instruments.noise_densities.min() < DELAY_NOISE_DENSITY
        filtered = precise or not (is_even(record) and is_only_a_delay(instruments))
        inputs = build_model_inputs(record, instruments, car, self.step, filtered)
        if filtered:
            rate = record.fs / block
            model = replace(model, filter=SensorFilter.of(instruments, inputs.h, rate))
        censored = clipped_signs(record, instruments)
        if np.isfinite(record.bandwidth):  # what is left of a gap lies between its ends
            a = bridge(record.a)
        else:
            a = np.where(valid | (censored != 0), record.a, 0.0)
        # the mean over the drive is mostly sensor bias
        mean = np.sum(a, axis=1, where=valid) / np.maximum(valid.sum(axis=1), 1)
        a -= mean[:, None]
        origin = inputs.s[0] - car.wheelbase - (MARGIN + 1) * ds
        middle = origin + ds * (np.arange(int((inputs.s[-1] - origin) / ds) + 2 * MARGIN) - 0.5)
        level = self.level_ends and record.s[0] <= 0.0
        end = record.length if self.level_ends else np.inf
        free = ((middle > (0.0 if level else -np.inf)) & (middle < end)).astype(float)
        rest = rest_state(car, inputs)
        typical = REST_STD if level else MOVING_STD
        initial_std = np.repeat(typical[[0, -1]], rest.size // 2)  # of a frame's twist, too
        if model.filter is not None and not level:  # what the filter held before is not known
            valid = valid & (np.arange(valid.shape[1]) >= model.filter.memory * record.fs)
        return model, PreparedDrive(
            a, valid, censored, block, inputs, rest, initial_std, origin, ds, free
        )


@dataclass(eq=False)
class _Findings:
    """Results of all windows so far: greatest noise scale, distance in the air [m], the fit of the
    vehicle, the noise scale that a fit left which is not believed, greatest share of the vehicle in
    the variance of the heights, and relative error of the speed in each window with its variance.
    """

    noise_scale: float = 1.0
    in_air: float = 0.0
    fit: CarFit | None = None
    left_by_fit: float = 0.0
    vehicle_share: float = 0.0
    speed_errors: list[tuple[float, float]] = field(default_factory=list)


def _describe_modes(car: VehicleParameters) -> str:
    """Return the frequencies of the body's modes in words."""
    modes = {"twist": car.variation.frame, "bend": car.variation.bending}
    return " and ".join(f"{verb} at {mode.f:.1f} Hz" for verb, mode in modes.items() if mode)
