"""Inputs of the vehicle model along a record: station, speed and valve commands at each step."""

from dataclasses import dataclass

import numpy as np

from road_envs.records.record import Record
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle.equations import N_DOF, build_plant
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import settled_strut_state

# Prior standard deviations of the first vehicle state, of a vehicle at rest on a level apron
REST_STD = np.repeat([1e-4, 1e-3], N_DOF)
_CLOCK_ERROR = 0.01  # part of a sample's interval by which an even clock may be late or early
MOVING_STD = np.repeat([3e-2, 3e-1], N_DOF)  # the same in the middle of a road


@dataclass(frozen=True, eq=False)
class ModelInputs:
    """Inputs of N steps of `h` [s]: station `s` [m] of the front axle and speed `v` [m/s] at each
    half step (2 N,), and the command bytes `commands` (N,) that reach the valves. A sample is taken
    every `decimation` steps, or where the clock jitters `offset` (T,) steps after that.
    """

    h: float
    decimation: int
    s: np.ndarray
    v: np.ndarray
    commands: np.ndarray
    offset: np.ndarray | None = None

    @property
    def n_steps(self) -> int:
        """Steps N."""
        return self.commands.size

    def slice_steps(self, first: int, last: int) -> "ModelInputs":
        """Return the steps `first` to `last` (excluded)."""
        half = slice(2 * first, 2 * last)
        commands, offset = self.commands[first:last], self.offset
        if offset is not None:
            offset = offset[first // self.decimation : last // self.decimation]
        return ModelInputs(self.h, self.decimation, self.s[half], self.v[half], commands, offset)

    def sample_steps(self, n_samples: int) -> np.ndarray:
        """Return the step (T,), which need not be whole, at which each sample is taken."""
        even = self.decimation * np.arange(float(n_samples))
        return even if self.offset is None else even + self.offset[:n_samples]


def build_model_inputs(
    record: Record,
    instruments: Instruments,
    car: VehicleParameters,
    max_step: float,
    filtered: bool = False,
) -> ModelInputs:
    """Return the inputs of a record, in steps of at most `max_step` [s], a whole number per sample.

    The anti-alias filter delays the samples, so the model is driven earlier by as much. With
    `filtered` the filter is a part of the model, and the samples are at their own times.
    """
    decimation = max(1, int(np.ceil(1.0 / (record.fs * max_step) - 1e-3)))
    h = 1.0 / (record.fs * decimation)
    half_steps = np.arange(2 * decimation * record.t.size)
    begin, offset = record.t[0] - antialias_delay(instruments), None
    if filtered:
        late = _lateness(record)
        begin, offset = late.mean(), None if is_even(record) else (late - late.mean()) / h
    t = begin + 0.5 * h * half_steps
    s, v = (np.interp(t, record.t, x) for x in (record.s, record.v))
    # beyond the record the vehicle goes on at the speed of its first and last sample
    s += v[0] * np.minimum(t - record.t[0], 0.0) + v[-1] * np.maximum(t - record.t[-1], 0.0)
    sample = np.floor((t[::2] - car.valve.delay - record.t[0]) * record.fs + 1e-6)
    sample = np.clip(sample, 0, record.t.size - 1).astype(int)
    return ModelInputs(h, decimation, s, v, record.commands[sample], offset)


def is_even(record: Record) -> bool:
    """Return whether the samples of a record are at even times."""
    return bool(np.ptp(_lateness(record)) <= _CLOCK_ERROR / record.fs)


def _lateness(record: Record) -> np.ndarray:
    """Return the times (N,) [s] of the samples less multiples of their mean interval."""
    return record.t - np.arange(record.t.size) / record.fs


def antialias_delay(instruments: Instruments) -> float:
    """Return the delay [s] of slow signals in the anti-alias filter."""
    f = 1e-3 * instruments.f_alias
    return float(-np.angle(instruments.response(np.array(f))) / (2.0 * np.pi * f))


def rest_state(car: VehicleParameters, inputs: ModelInputs) -> np.ndarray:
    """Return the state (14,) or, with a flexible frame, (16,) at rest on a level apron, but for
    1e-7: exactly at rest the friction law has a kink and no tangent.
    """
    plant = build_plant(car)
    if car.tyre_static_deflection != "equilibrium":
        return np.full(2 * plant.n_dof, 1e-7)  # the paper's start, some millimetres off
    return equilibrium(plant, settled_strut_state(int(inputs.commands[0])), np.zeros(4)) + 1e-7
