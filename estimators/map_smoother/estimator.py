"""Maximum a posteriori road under the full nonlinear vehicle (4D-Var).

    minimize  1/2 sum over block means ((y - a(road)) / sigma)² + 1/2 |u|²

a(road) is what the accelerometers measure when the vehicle, with its gas springs, dampers,
friction, stops and tyres that lift off, is driven over the road, both axles over the same one. u is
white noise that the prior shapes into an equally rough surface in all directions (`road_prior.py`);
its density is re-estimated from the drive, octave by octave, and along the road where it is rough
in places only (potholes, bumps). A clipped sample is a limit: the acceleration was at least that.
Gauss-Newton steps with the exact tangent and adjoint of the simulator's step (`objective.py`; for
the adjoint method Talagrand & Courtier 1987, doi:10.1002/qj.49711347812) are solved by conjugate
gradients, preconditioned by the stationary linear vehicle (`preconditioner.py`). Friction is
smoothed and the noise inflated at first and less so in later steps (`gauss_newton.py`). Where a
wheel has lifted off, the road is lowered, and at last it is the mean of what it may be there
(`wheel_liftoff.py`).

Several drives over one road are estimated together: their misfits add. A vehicle that differs from
the one given within its tolerances is fitted to the drive (`car_fit.py`), and one that stays
unexplained with the elements that the description leaves out but whose tolerances say what they are
about, such as a frame that twists (`identification.py`).

Known to fail: under a lifted wheel, where the road is only known to lie below it, as over a hole
whose floor the wheel does not reach; for waves longer than about 50 m, which are hardly observable
at a walking pace and left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from estimators.api import CalibrationError, Cars, Records, copy_with
from estimators.common.explained import reduce_unexplained
from estimators.common.misfit import NOISE_SCALE_WARNING, misfit_note
from estimators.common.odometer import calibrate_odometer
from estimators.map_smoother.identification import identify_structure
from estimators.map_smoother.identified_vehicle import CalibratedByIdentification
from estimators.map_smoother.preparation import SolverSettings
from estimators.map_smoother.solver import RoadSolver, distance_scale
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.vehicle_uncertainty import VehicleUncertainty
from estimators.map_smoother.windows import on_common_nodes
from road_envs.records.record import Estimate, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import has_absent_elements


@dataclass(frozen=True, kw_only=True)
class MapSmoother(CalibratedByIdentification, SolverSettings):
    """Most probable road under the full nonlinear vehicle, fitted to the drive where that shows.

    With the settings of the solver. `draws`: samples of the posterior for the standard deviation, 0
    for none. `adapt`: where the unexplained noise says that the vehicle differs, and its file gives
    tolerances, the parameters are fitted to the drive (`car_fit.py`).
    """

    causal: ClassVar[bool] = False
    draws: Annotated[int, Field(ge=0), "", "samples of the posterior"] = 2
    adapt: bool = True

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Estimate both wheel paths. Raises ConfigError, RecordError, ArithmeticError."""
        odometer = calibrate_odometer(record)
        # where positions wander the road is level somewhere else
        settled = self if odometer.s_std is None else replace(self, level_ends=False)
        record, car = self.as_identified(odometer.record, car)
        return odometer.describe(settled._estimate_best(record, car, odometer.speed_std))

    def for_one_of_many(self) -> "MapSmoother":
        """The estimator of a single pass of several: fast, for alignment and as a start."""
        return copy_with(self, draws=0, adapt=False, prior_updates=0)

    def estimate_jointly(
        self, records: Records, cars: Cars, start: Estimate, names: Sequence[str]
    ) -> Estimate:
        """Estimate one road from several passes (`estimators.passes.JointEstimator`)."""
        pairs = zip(records, cars, strict=True)
        drives, notes = [], list[str]()
        for (record, car), name in zip(pairs, names, strict=True):
            drive, remarks = self.prepare(*self.as_identified(record, car))
            drives.append(drive)
            notes += [f"{name}: {remark}" for remark in remarks]
        solver = RoadSolver(self, on_common_nodes(drives), self.adapt, self.draws, start=start)
        return self._solve(solver, records[0].length, names, notes)

    def _estimate_best(self, record: Record, car: VehicleParameters, speed_std: float) -> Estimate:
        known = None if self.identified is None else self.identified.uncertainty
        first, solver = self._estimate(record, car, known, speed_std)
        left = solver.left_by_fit
        if solver.fits or solver.speed_errors:  # places need the vehicle, flights or not
            left = max(left, float(solver.noise_scale[0]))
        if not (self.adapt and left >= TUNING.searched_power and has_absent_elements(car)):
            return first
        described = replace(self, adapt=False)
        try:  # the vehicle may have elements that its description leaves out
            found, uncertainty = identify_structure(record, car, described)
            uncertain = replace(uncertainty, inflation=TUNING.structure_inflation)
            second, flexible = described._estimate(record, found, uncertain, speed_std)
        except (CalibrationError, ArithmeticError):
            return first
        if flexible.noise_scale[0] - 1.0 > TUNING.structure_gain * (left - 1.0):
            return first
        elements = {"twist": found.variation.frame, "bend": found.variation.bending}
        modes = [f"{verb} at {mode.f:.1f} Hz" for verb, mode in elements.items() if mode]
        note = f"a frame that can {' and '.join(modes)} was found, and adapted to the drive"
        return replace(second, notes=(*second.notes, note))

    def _estimate(
        self, record: Record, car: VehicleParameters, known: VehicleUncertainty | None, v_std: float
    ) -> tuple[Estimate, RoadSolver]:
        """Estimate a single drive; `known`: the uncertainty of a vehicle that was identified."""
        drive, notes = self.prepare(record, car, speed_std=v_std)
        solver = RoadSolver(self, [drive], self.adapt, self.draws, known)
        return self._solve(solver, record.length, [""], notes), solver

    def _solve(
        self, solver: RoadSolver, length: float, names: Sequence[str], remarks: Sequence[str]
    ) -> Estimate:
        """Estimate a road of `length` [m]; notes name the drive if there are several `names`."""
        road, drives, s = solver.solve(), solver.drives, profile_stations(length)
        z, std, drawn = road.at_stations(drives[0].nodes, s)
        z_std, draws = (std, drawn) if self.draws else (None, None)
        notes, share = [*remarks, *_findings_notes(solver, names)], 0.0
        rows = zip(drives, solver.in_air, solver.noise_scale.tolist(), strict=True)
        for drive, in_air, scale in rows:
            most = TUNING.lost_noise_scale  # above it the minimization has lost the vehicle
            if in_air < TUNING.lost_air_share * length:
                power = float(drive.a.var()) / drive.model.noise_variance
                most = max(most, TUNING.lost_power_share * power)
            share = max(share, most / scale)
        distance, doubts = distance_scale(solver.speed_errors, drives[0].model)
        notes += doubts
        if share < 1.0:
            z, z_std = reduce_unexplained(z, z_std, share)
            distance = draws = None
            notes.append(
                f"the heights are reduced to {share:.0%}: their motion is not the measured one"
            )
        left = float(np.sqrt(solver.noise_scale.max()))
        return Estimate(s, z, z_std, tuple(notes), distance=distance, draws=draws, residual=left)


def _findings_notes(solver: RoadSolver, names: Sequence[str]) -> list[str]:
    several = len(names) > 1
    labels = [f"{name}: " if several else "" for name in names]
    notes = [
        f"{label}wheels were in the air for {length:.1f} m of the drive; the road below them is "
        "uncertain"
        for label, length in zip(labels, solver.in_air, strict=True)
        if length >= 0.1
    ]
    for fit, members in solver.fits:
        whose = f" of {', '.join(names[k] for k in members)}" if several else ""
        drives = "drives" if several else "drive"
        notes.append(f"the vehicle{whose} was adapted to the {drives}: {fit.summary()}")
    notes += [
        f"{label}{misfit_note(scale)}"
        for label, scale in zip(labels, solver.noise_scale.tolist(), strict=True)
        if scale > NOISE_SCALE_WARNING
    ]
    if solver.vehicle_share > TUNING.vehicle_share_noted:
        ratio = np.sqrt(1.0 / (1.0 - solver.vehicle_share))
        notes.append(
            f"the errors are {ratio:.1f} times those of a vehicle that is known: calibrate it, or "
            "drive on a rougher road as well"
        )
    return notes
