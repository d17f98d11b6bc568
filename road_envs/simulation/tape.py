"""Drives on tape: simulate once, then apply the derivative, a row of `sensitivity` per step."""

from dataclasses import dataclass

import numpy as np

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd_arrays import stack_array
from road_envs.simulation import rosenbrock
from road_envs.simulation.rosenbrock import WORKSPACE_ROWS, StepInputs, step_workspace
from road_envs.simulation.sensitivity import TAPE_ROW_SIZE, step_with_derivative, tangent_step
from road_envs.vehicle.equations import N_DOF, Motion, Plant
from road_envs.vehicle.side_motion import n_side


@kernel(count_references=False)
def _integrate_with_derivative(
    vehicle, y, inputs, commands, lag, out, rows, flexible=None, side=None
):
    """Take N steps as `rosenbrock.integrate`; write the derivative to `rows` (N, TAPE_ROW_SIZE).

    `inputs`: StepInputs with the steps as first axis; `commands` (0,): a constant strut state.
    """
    p, n_dof, h = vehicle.constants[0], y.size // 2, inputs.h
    work, motion = step_workspace(stack_array(WORKSPACE_ROWS)), Motion(y[:n_dof], y[n_dof:])
    alpha = 1.0 - np.exp(-h / lag)
    for n in range(rows.shape[0]):
        if commands.size > 0:
            rosenbrock.update_valves(p, vehicle.strut_state, motion.q, commands[n], alpha, h)
        step_inputs = StepInputs(inputs.road[n], inputs.a_xy[n], h, inputs.v[n])
        step_with_derivative(vehicle, motion, step_inputs, work, out[n], rows[n], flexible, side)


@kernel(count_references=False)
def _propagate_tangent(constants, rows, y, road, h, v, a, flexible=None, side=None):
    """Apply `tangent_step` row by row; write changes of accelerations to `a` (N, 7)."""
    n_dof, p, work = y.size // 2, constants[0], step_workspace(stack_array(WORKSPACE_ROWS))
    motion = Motion(y[:n_dof], y[n_dof:])
    for n in range(rows.shape[0]):
        changes = StepInputs(road[n], None, h, v[n])
        tangent_step(p, rows[n], motion, changes, work, a[n], flexible, side)


def _checked_copy(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of `value` as float. Raises ValueError unless it has the `shape`."""
    copy = np.array(value, dtype=float)
    if copy.shape != shape:  # kernels do not check bounds
        raise ValueError(f"{name} must be of shape {shape}, got {copy.shape}")
    return copy


@dataclass(frozen=True, eq=False)
class Tape:
    """A drive of N steps and its derivative, 592 bytes per step; it can be applied repeatedly.

    `signals` (N, 29) at the beginning of each step, laid out as in `rosenbrock`; `end` (14,) and
    `strut_state` (4, 3) after the last step; `rows` (N, TAPE_ROW_SIZE), the derivative of each
    step of `h` [s] at the speeds `v` (N,) [m/s], which side motion alone reads.
    """

    plant: Plant
    h: float
    signals: np.ndarray
    end: np.ndarray
    strut_state: np.ndarray
    rows: np.ndarray
    v: np.ndarray

    @property
    def acceleration(self) -> np.ndarray:
        """Accelerations (N, `n_dof`) of the coordinates at the beginning of each step."""
        found = self.signals[:, rosenbrock.ACCELERATION : rosenbrock.ACCELERATION + N_DOF]
        if self.plant.flexible:
            found = np.column_stack([found, self.signals[:, rosenbrock.TWIST + 2]])
        if self.plant.sideways:
            side = self.signals[:, rosenbrock.SIDE_ACCELERATION :]
            found = np.column_stack([found, side[:, : n_side(self.plant.constants[0])]])
        return found

    def tangent(self, start: np.ndarray, road: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return first-order changes of the accelerations (N, 7) and of the final state (14,).

        `start` (14,): change of the initial state; `road` (2 N, 2, 4): change of the heights [m]
        and rates [m/s] under the wheels at the beginning and the middle of each step. Raises
        ValueError on a wrong shape.
        """
        y, steps = _checked_copy("start", start, self.end.shape), self.rows.shape[0]
        z = _checked_copy("road", road, (2 * steps, 2, 4)).reshape(steps, 16)
        a, flags = np.empty((steps, y.size // 2)), self.plant.kernel_flags
        _propagate_tangent(self.plant.constants, self.rows, y, z, self.h, self.v, a, *flags)
        return a, y


def linearize_drive(
    plant: Plant,
    strut_state: np.ndarray,
    start: np.ndarray,
    road: np.ndarray,
    h: float,
    a_xy: np.ndarray | None = None,
    *,
    commands: np.ndarray | None = None,
    lag: float = 0.01,
    v: np.ndarray | None = None,
) -> Tape:
    """Simulate N steps of `h` [s] from the state `start` (14,) and record the derivative.

    `strut_state` (4, 3) at the start; `road` (2 N, 2, 4) as of `Tape.tangent`; `a_xy` (2 N, 2): a_x
    and a_y [m/s²] of a manoeuvre at the same times; `commands` (N,): bytes that reach the valves,
    of time constant `lag` [s], without which the strut state stays constant; `v` (N,): speed [m/s]
    in the middle of each step, which a vehicle with side motion needs. Raises ValueError on a wrong
    shape, ArithmeticError if the motion diverges.
    """
    road = np.asarray(road, dtype=float)
    steps = len(road) // 2
    z = _checked_copy("road", road, (2 * steps, 2, 4))
    y = _checked_copy("start", start, (2 * plant.n_dof,))
    if v is None and plant.sideways:
        raise ValueError("a vehicle with side motion needs its speed v")
    speed = _checked_copy("v", np.zeros(steps) if v is None else v, (steps,))
    a_xy = np.zeros((2 * steps, 2)) if a_xy is None else a_xy
    a_xy_steps = _checked_copy("a_xy", a_xy, (2 * steps, 2))
    strut_state_end = _checked_copy("strut_state", strut_state, (4, 3))
    signals, rows = np.zeros((steps, rosenbrock.n_signals(plant))), np.empty((steps, TAPE_ROW_SIZE))
    bytes_ = np.zeros(0) if commands is None else _checked_copy("commands", commands, (steps,))
    inputs = StepInputs(z.reshape(steps, 16), a_xy_steps.reshape(steps, 4), float(h), speed)
    buffers, valves = plant.buffers(strut_state_end), (bytes_.astype(np.uint8), float(lag))
    _integrate_with_derivative(buffers, y, inputs, *valves, signals, rows, *plant.kernel_flags)
    if not np.isfinite(y).all():
        raise ArithmeticError("the motion diverged (no longer finite); check the road and start")
    return Tape(plant, float(h), signals, y, strut_state_end, rows, speed)
