"""Self-check of an estimated road: does the vehicle, driven over it, move as was measured?

A linear smoother or a filter that has lost the vehicle gives heights that the nonlinear vehicle
contradicts: wheels that were in the air press, accelerations are many times those measured. The
vehicle is simulated over the estimate and the accelerations of the sensors are compared below F_C.
"""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from estimators.common.bending import sensed_bending
from estimators.common.footprint import Footprint
from estimators.common.model_inputs import ModelInputs, build_model_inputs, rest_state
from estimators.common.spline import sample_under_wheels
from road_envs.kernels.filters import preprocess_accelerations
from road_envs.records.record import F_C, PROFILE_SPACING, Record, profile_stations
from road_envs.sensing.instruments import Instruments
from road_envs.simulation.tape import linearize_drive
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.linear_model import linearise
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import settled_strut_state

WINDOW = 5.0
"""Standard deviation [m] of the window in which accelerations are compared."""

CHUNK_STEPS = 20_000
"""Steps that are simulated at a time."""

TRUSTED_SHARE = 0.7
"""Explained share of the measured power from which on an estimate is left as it is. Linear
smoothers explain more than 0.8 on roads up to class D and on bumps, none where wheels fly."""

SETTLING_TIME = 2.0
"""Time [s] at the beginning of a record that is not compared: the simulation starts at rest, a
record may begin in motion. Two periods of the body's bounce.
"""

MAX_SPEED_STEP = 0.001
"""Longest step [s] of the simulation."""


def trusted_share(
    record: Record,
    valid: np.ndarray,
    car: VehicleParameters,
    instruments: Instruments,
    z: np.ndarray,
) -> np.ndarray:
    """Return by how much (M,), 0 to 1, heights `z` (2, M) [m] of the `record` are to be trusted.

    It is 1 where the accelerations of `car` on them explain TRUSTED_SHARE or more of the measured
    power, 0 where they explain nothing. `valid` (k, N): samples that are compared, after the first
    SETTLING_TIME.
    """
    inputs = build_model_inputs(record, instruments, car, MAX_SPEED_STEP)
    predicted = simulate_sensors(inputs, car, instruments, z)[:, : record.t.size]
    measured = np.where(valid, record.a, 0.0)
    finite = np.isfinite(predicted).all(axis=0)
    predicted = np.where(valid & finite, predicted, 0.0)
    a, e = (
        (preprocess_accelerations(x, record.fs, F_C) ** 2).sum(axis=0)
        for x in (measured, measured - predicted)
    )
    e[~finite] = np.inf
    settling = record.t < record.t[0] + SETTLING_TIME
    a[settling], e[settling] = 0.0, 0.0
    stations = profile_stations(record.length)
    # both axles excite the body: a sample belongs to the road around the middle of the vehicle
    cell = ((record.s - 0.5 * car.wheelbase) / PROFILE_SPACING).round().astype(int)
    inside = (cell >= 0) & (cell < stations.size)
    width = WINDOW / PROFILE_SPACING
    power, error = (
        gaussian_filter1d(np.bincount(cell[inside], x[inside], stations.size), width)
        for x in (a, np.minimum(e, 1e12))
    )
    explained = 1.0 - error / np.maximum(power, 1e-12 * max(power.max(), 1e-300))
    return np.clip(explained / TRUSTED_SHARE, 0.0, 1.0)


def untrusted_note(share: np.ndarray) -> tuple[str, ...]:
    """Return a note on where `share` (M,) reduces the heights, if anywhere."""
    length = PROFILE_SPACING * float(np.sum(share < 0.95))
    if length < 1.0:
        return ()
    return (
        f"over {length:.0f} m the vehicle on the estimated road does not move as was measured; the "
        "heights are reduced there",
    )


def reduce_unexplained(
    z: np.ndarray, z_std: np.ndarray | None, share: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return heights `z` (2, M) [m] times `share`, 0 to 1, and the standard deviation they leave.

    The part that is taken away counts as error. `share` is a number or one per station (M,).
    """
    share = np.broadcast_to(share, z.shape)
    if z_std is None or not (share < 1.0).any():
        return z * share, z_std
    return z * share, np.hypot(z_std, (1.0 - share) * np.abs(z))


def simulate_sensors(
    inputs: ModelInputs, car: VehicleParameters, instruments: Instruments, z: np.ndarray
) -> np.ndarray:
    """Return accelerations (k, N) [m/s²] of the sensors on heights `z` (2, M) [m] at the profile
    stations; not finite from where the motion diverges.
    """
    plant = build_plant(car)
    locations = instruments.locations(car)
    rows, bending = linearise(plant, "ride", locations).sensor_rows, sensed_bending(car, locations)
    if bending is not None:
        rows = bending.extended_rows(rows)
    pad = int(np.ceil((car.wheelbase + 5.0) / PROFILE_SPACING)) + 4
    footprint = Footprint.of(car.variation.contact_length, PROFILE_SPACING)
    c = footprint.apply(np.pad(z, ((0, 0), (pad, pad)), mode="edge"))
    node = inputs.s / PROFILE_SPACING + pad
    state = rest_state(car, inputs) + 1e-7  # exactly at rest the friction law has no tangent
    strut_state = settled_strut_state(int(inputs.commands[0]))
    a = np.full((rows.shape[0], inputs.n_steps), np.nan)
    for first in range(0, inputs.n_steps, CHUNK_STEPS):
        last = min(first + CHUNK_STEPS, inputs.n_steps)
        half = slice(2 * first, 2 * last)
        road = np.empty((2 * (last - first), 2, 4))
        wheelbase = car.wheelbase / PROFILE_SPACING
        sample_under_wheels(c, node[half], inputs.v[half] / PROFILE_SPACING, wheelbase, road)
        try:
            tape = linearize_drive(
                plant, strut_state, state, road, inputs.h,
                commands=inputs.commands[first:last], lag=car.valve.lag,
                v=inputs.v[2 * first + 1 : 2 * last : 2],
            )  # fmt: skip
        except ArithmeticError:
            break
        a[:, first:last] = rows @ tape.acceleration.T
        state, strut_state = tape.end, tape.strut_state
    if bending is not None:
        a = bending.sense(a, inputs.h)
    return a[:, :: inputs.decimation]
