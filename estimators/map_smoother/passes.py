"""The most probable road of several passes over it, each with its own vehicle and speed.

The objectives of the passes add over one road (`joint_objective.py`). The minimization begins at
the mean of the single estimates, so that few steps are needed. The noise of each pass has a scale
of its own, so that a vehicle that differs from its description counts for less. Passes whose
vehicles are described alike are taken for drives of one vehicle: if it has to be adapted, its
parameters are fitted to all of them. Long roads are estimated in windows that end for all passes at
the same station (`windows.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.common.misfit import misfit_note
from estimators.map_smoother.car_fit import CarFit, fit_if_due, is_believed
from estimators.map_smoother.gauss_newton import (
    NOISE_SCALE_WARNING,
    GaussNewton,
    MapSolution,
    minimize,
    update_noise_scale,
)
from estimators.map_smoother.joint_objective import (
    JointObjective,
    joint_stationary_hessian,
    shift_inputs,
)
from estimators.map_smoother.objective import MeasurementModel
from estimators.map_smoother.posterior_sampling import posterior_mean_and_std
from estimators.map_smoother.wheel_liftoff import distance_in_air
from estimators.map_smoother.windows import (
    PreparedDrive,
    WindowState,
    advance,
    initial_window_state,
    nodes_under,
    window_objective,
)
from road_envs.records.record import Estimate, Record, scored_band
from road_envs.vehicle.parameters import VehicleParameters

if TYPE_CHECKING:
    from estimators.map_smoother.estimator import MapSmoother

STAGES = ((0.0, 8),)
"""Smoothing of friction [m/s], and the most Gauss-Newton steps with it: the mean of the single
estimates is so near that it needs none."""

JOINT_PRIOR_UPDATES = 2
"""Updates of the prior between the steps, at most."""

ADAPTED_STEPS = 4
"""Gauss-Newton steps of the road after its vehicles were adapted."""

MIN_BLOCKS = 32
"""Block means of a pass in a window below which it is left out there."""

KNOT_SPACING = 10.0
"""Distance [m] of the knots of the shifts, about."""

MAX_LATE_START = 2.0
"""Largest distance [m] of the stations where passes begin, if they begin on one level apron."""

Window = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class PreparedPass:
    """One pass: its described `car`, measurement `model`, and `drive` on the common nodes."""

    name: str
    car: VehicleParameters
    model: MeasurementModel
    drive: PreparedDrive

    @property
    def block_stations(self) -> np.ndarray:
        """Stations [m] at which the blocks begin."""
        return self.drive.inputs.s[:: 2 * self.drive.steps_per_block][: self.drive.blocks]


@dataclass(eq=False)
class _Findings:
    """Results of all windows so far: noise scale and distance in the air of each pass, fits of
    vehicles with the numbers of their passes.
    """

    noise_scale: np.ndarray
    in_air: np.ndarray
    fits: list[tuple[CarFit, list[int]]] = field(default_factory=list)

    def notes(self, passes: Sequence[PreparedPass]) -> list[str]:
        """Return the notes, with the names of the passes."""
        notes = [
            f"{one.name}: wheels were in the air for {length:.1f} m of the drive"
            for one, length in zip(passes, self.in_air, strict=True)
            if length >= 0.1
        ]
        for fit, members in self.fits:
            names = ", ".join(passes[k].name for k in members)
            notes.append(f"the vehicle of {names} was adapted to the drives: {fit.summary()}")
        notes += [
            f"{one.name}: {misfit_note(scale)}"
            for one, scale in zip(passes, self.noise_scale, strict=True)
            if scale > NOISE_SCALE_WARNING
        ]
        return notes


def estimate_jointly(
    smoother: "MapSmoother",
    records: Sequence[Record],
    cars: Sequence[VehicleParameters],
    start: Estimate,
    names: Sequence[str],
) -> Estimate:
    """Return the most probable road of `records` with stations of one odometer, from `start` on.

    The standard deviation is that in the band of the slowest pass. Raises ConfigError, RecordError,
    ArithmeticError.
    """
    passes, notes = prepare_passes(smoother, records, cars, names)
    slowest = min(float(one.drive.inputs.v.mean()) for one in passes)
    findings = _Findings(np.ones(len(passes)), np.zeros(len(passes)))

    def solve(objective: JointObjective, members: list[int]) -> tuple[Any, np.ndarray]:
        u = objective.road.noise_of(start)

        def adapt(solution: Any, solver: GaussNewton) -> MapSolution:
            vehicles = [passes[k].car for k in members]
            return _adapt(solution, solver, vehicles, members, findings)

        known: Any = _with_fits(objective, members, findings)
        may_adapt = smoother.adapt and not findings.fits
        solution: Any = minimize(
            known,
            GaussNewton(joint_stationary_hessian(objective), smoother.huber),
            adapt_prior=smoother.adapt_prior,
            start=np.pad(u.ravel(), (0, objective.size - u.size)),
            stages=STAGES,
            prior_updates=min(JOINT_PRIOR_UPDATES, smoother.prior_updates),
            adapt_car=adapt if may_adapt else None,
        )
        scale = np.maximum(findings.noise_scale[members], solution.noise_scale)
        findings.noise_scale[members] = scale
        findings.in_air[members] += [distance_in_air(one) for one in solution.linearization.passes]
        return posterior_mean_and_std(solution, scored_band(slowest), smoother.draws)[:2]

    state = reconstruct_passes(smoother, passes, solve)
    z, std = state.at_stations(passes[0].drive, start.s)
    z_std = std if smoother.draws else None
    return Estimate(start.s, z, z_std, (*notes, *findings.notes(passes)))


def prepare_passes(
    smoother: "MapSmoother",
    records: Sequence[Record],
    cars: Sequence[VehicleParameters],
    names: Sequence[str],
) -> tuple[list[PreparedPass], list[str]]:
    """Return the passes on common nodes, the finest that any of them needs, and notes."""
    passes, notes = [], list[str]()
    for record, car, name in zip(records, cars, names, strict=True):
        model, drive, told = smoother.prepare(record, car)
        passes.append(PreparedPass(name, car, model, drive))
        notes += [f"{name}: {note}" for note in told]
    drives = [one.drive for one in passes]
    ds, origin = min(drive.ds for drive in drives), min(drive.origin for drive in drives)
    last = max(drive.origin + drive.ds * drive.free.size for drive in drives)
    middle = origin + ds * (np.arange(int((last - origin) / ds) + 1) - 0.5)
    begins = np.array([record.s[0] for record in records])
    level = smoother.level_ends and begins.max() <= 0.0 and np.ptp(begins) <= MAX_LATE_START
    end = max(record.length for record in records) if smoother.level_ends else np.inf
    free = ((middle > (0.0 if level else -np.inf)) & (middle < end)).astype(float)
    return [
        replace(one, drive=replace(one.drive, origin=origin, ds=ds, free=free)) for one in passes
    ], notes


def _with_fits(
    objective: JointObjective, members: Sequence[int], findings: _Findings
) -> JointObjective:
    """Return the objective with the vehicles that were fitted in an earlier window."""
    parts = list(objective.passes)
    for fit, fitted in findings.fits:
        for i in (i for i, number in enumerate(members) if number in fitted):
            parts[i] = replace(parts[i], model=parts[i].with_car(fit.car).model)
    return objective.with_passes(parts)


def _adapt(
    solution: Any,
    solver: Any,
    cars: Sequence[VehicleParameters],
    members: Sequence[int],
    findings: _Findings,
) -> MapSolution:
    """Return the solution with each vehicle fitted to all its passes, where that is due."""
    lin, stationary = solution.linearization, solution.stationary
    parts = [
        MapSolution(one, hessian, float(scale))
        for one, hessian, scale in zip(
            lin.passes, stationary.passes, solution.noise_scale, strict=True
        )
    ]
    objectives = list(lin.at.passes)
    for first, car in enumerate(cars):
        if car in cars[:first]:
            continue
        same = [i for i, other in enumerate(cars) if other == car]
        own = [parts[i] for i in same]
        fit = fit_if_due(own, car, solver)
        if fit is None or not is_believed(fit, own):
            continue
        for i in same:
            objectives[i] = objectives[i].with_car(fit.car)
        findings.fits.append((fit, [members[i] for i in same]))
    if not findings.fits:
        return solution
    objective = lin.at.with_passes(objectives)
    solver = replace(solver, stationary=joint_stationary_hessian(objective))
    new: Any = objective.linearize(lin.x)
    noise_scale = solution.noise_scale
    for _ in range(ADAPTED_STEPS):
        noise_scale = update_noise_scale(new, solver.stationary, noise_scale)
        new, _ = solver.step(new, noise_scale)
    return replace(
        solution, linearization=new, stationary=solver.stationary, noise_scale=noise_scale
    )


def joint_windows(
    passes: Sequence[PreparedPass], window: float, overlap: float
) -> list[tuple[Window, ...]]:
    """Return the windows (begin, begin of the next one, end) of each pass, in blocks.

    Those of the pass that takes longest are even, of `window` and `overlap` [s]; the windows of the
    others begin and end at the same stations.
    """
    longest = max(passes, key=lambda one: one.drive.blocks * one.drive.block_size)
    starts = longest.block_stations

    def at(one: PreparedPass, block: int) -> int:
        if one is longest or block == 0:
            return block
        if block >= starts.size:
            return one.drive.blocks
        return int(np.searchsorted(one.block_stations, starts[block]))

    return [
        tuple((at(one, begin), at(one, after), at(one, end)) for one in passes)
        for begin, after, end in longest.drive.split(window, overlap)
    ]


def reconstruct_passes(
    smoother: "MapSmoother", passes: Sequence[PreparedPass], solve: Any
) -> WindowState:
    """Estimate all windows and return the final state of the road.

    `solve` gets the objective of a window and the numbers of its passes, and returns the solution
    and its standard deviation (2, K).
    """
    passes = list(passes)
    prior = smoother.road_prior
    states = [initial_window_state(one.drive) for one in passes]
    for windows in joint_windows(passes, smoother.window, smoother.overlap):
        members = [k for k, (begin, _, end) in enumerate(windows) if end - begin >= MIN_BLOCKS]
        reach = [
            nodes_under(passes[k].drive, passes[k].model.wheelbase, windows[k][0], windows[k][2])
            for k in members
        ]
        nodes = min(first for first, _ in reach), max(last for _, last in reach)
        parts = [
            window_objective(
                passes[k].model, passes[k].drive, prior, states[k],
                windows[k][0], windows[k][2], nodes,
            )
            for k in members
        ]  # fmt: skip
        road = parts[0].road
        length = road.ds * road.size
        count = 1 + max(1, round(length / KNOT_SPACING))
        knots = road.origin + np.linspace(0.0, length, count)
        solution, std = solve(JointObjective(tuple(parts), knots), members)
        joint = solution.linearization
        for k, lin, shift in zip(members, joint.passes, joint.at.shifts(joint.x), strict=True):
            drive = passes[k].drive
            passes[k] = replace(
                passes[k],
                drive=replace(drive, inputs=shift_inputs(drive.inputs, knots, shift)),
            )
            begin, after, end = windows[k]
            steps = (after - begin) * passes[k].drive.steps_per_block if after < end else None
            own = replace(solution, linearization=lin)
            states[k] = advance(passes[k].drive, prior, states[k], own, std, steps)
        front = max((states[k] for k in members), key=lambda state: state.first_free_node)
        shared = {
            name: getattr(front, name)
            for name in ("c", "std", "first_free_node", "n", "density_scale")
        }
        states = [replace(state, **shared) for state in states]
    return states[0]
