"""Self-check of an estimated road: does the vehicle, driven over it, move as was measured?

A linear smoother or a filter that has lost the vehicle gives heights that the nonlinear vehicle
contradicts: wheels that were in the air press, accelerations are many times those measured. The
vehicle is simulated over the estimate and the accelerations of the sensors are compared below F_C.

Heights are impossible whatever the estimator if they demand _IMPOSSIBLE_RATIO times the measured
accelerations or more. The wheel loads alone move the vehicle (Newton's second law), so the
accelerations would have been measured, had the wheels carried the loads that the heights demand.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.signal import butter, sosfiltfilt

from estimators.api import Estimator, HasInstruments
from estimators.common.bending import sensed_bending
from estimators.common.footprint import Footprint
from estimators.common.model_inputs import ModelInputs, build_model_inputs, rest_state
from estimators.common.spline import sample_under_wheels
from estimators.preprocessing import mask_record
from road_envs.kernels.filters import preprocess_accelerations
from road_envs.records.record import F_C, PROFILE_SPACING, Estimate, Record, profile_stations
from road_envs.sensing.instruments import Instruments, instruments_of
from road_envs.simulation.tape import linearize_drive
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.linear_model import linearise
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import settled_strut_state

_WINDOW = 5.0  # standard deviation [m] of the window in which accelerations are compared
_CHUNK_STEPS = 20_000  # steps that are simulated at a time
# Explained share of the measured power from which on an estimate is left as it is. Linear
# smoothers explain more than 0.8 on roads up to class D and on bumps, none where wheels fly.
_TRUSTED_SHARE = 0.7
# Time [s] at the beginning of a record that is not compared: the simulation starts at rest, a
# record may begin in motion. Two periods of the body's bounce.
_SETTLING_TIME = 2.0
_MAX_SPEED_STEP = 0.001  # longest step [s] of the simulation
_IMPOSSIBLE_RATIO = 2.0
"""Accelerations that heights demand over those measured, as RMS, from which on they are impossible.

The true road under the described vehicle has 1.2 at most where a vehicle of grade S0 to S3 drove
over classes A to D, Belgian paving and speed bumps at 14.5 to 100 km/h, 1.4 on potholes and 1.95 on
class E; the washboard 1.7, and 2.4 at 75 km/h, where its waves are beyond F_C. Three times the
heights of the washboard have 2.2 or more. Class F from 54 km/h on, over which vehicles fly and no
description tells where they land, has up to 4 times.
"""
# Share of the drive's mean power in all bands, and factor of the power of the sensors' noise,
# below which measured accelerations count as so large. So they do below the mean power in their own
# band: of drives cut out of longer ones the true road has 1.7 at most, with a tenth of it 2.5.
_LEAST_OF_ALL, _NOISE_MARGIN = 0.003, 9.0
# Time [s] at the beginning, and largest share of a drive, that makes no heights impossible
_LONGEST_SETTLING, _SETTLING_SHARE = 4.0, 0.5
# Edges of the bands [Hz] in which accelerations are compared: about the resonances of the body,
# of the axles, and between them
_IMPOSSIBLE_BANDS = (0.3, 2.0, 8.0, F_C)


def trusted_share(
    record: Record, valid: np.ndarray, car: VehicleParameters, sensors: Instruments, z: np.ndarray
) -> np.ndarray:
    """Return by how much (M,), 0 to 1, heights `z` (2, M) [m] of the `record` are to be trusted.

    It is 1 where the accelerations of `car` on them explain _TRUSTED_SHARE or more of the measured
    power, 0 where they explain nothing. `valid` (k, N): samples that are compared, after the first
    _SETTLING_TIME.
    """
    measured, predicted, finite = _motions(record, valid, car, sensors, z)
    motions = [
        preprocess_accelerations(x, record.fs, F_C) for x in (measured, measured - predicted)
    ]
    power, error = _by_station(motions, finite, record, car.wheelbase, _SETTLING_TIME)
    explained = 1.0 - error / np.maximum(power, 1e-12 * max(power.max(), 1e-300))
    return np.clip(explained / _TRUSTED_SHARE, 0.0, 1.0)


def _motions(
    record: Record, valid: np.ndarray, car: VehicleParameters, sensors: Instruments, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the accelerations (k, N) measured and those of `car` on heights `z` (2, M) [m], in
    `valid` (k, N) samples, and where (N,) the latter are finite.
    """
    inputs = build_model_inputs(record, sensors, car, _MAX_SPEED_STEP)
    predicted = _simulate_sensors(inputs, car, sensors, z)[:, : record.t.size]
    finite = np.isfinite(predicted).all(axis=0)
    return np.where(valid, record.a, 0.0), np.where(valid & finite, predicted, 0.0), finite


def _by_station(
    motions: list[np.ndarray], finite: np.ndarray, record: Record, wheelbase: float, after: float
) -> np.ndarray:
    """Return the powers (2, M) about the stations of two `motions` (k, N), summed over samples
    later than `after` [s] from the beginning; the second is infinite where not `finite` (N,).
    """
    power = np.array([(x**2).sum(axis=0) for x in motions])
    power[1, ~finite] = np.inf
    power = np.where(record.t < record.t[0] + after, 0.0, np.minimum(power, 1e12))
    size = profile_stations(record.length).size
    # both axles excite the body: a sample belongs to the road around the middle of the vehicle
    cell = ((record.s - 0.5 * wheelbase) / PROFILE_SPACING).round().astype(int)
    inside = (cell >= 0) & (cell < size)
    total = [np.bincount(cell[inside], x[inside], size) for x in power]
    return np.asarray(gaussian_filter1d(total, _WINDOW / PROFILE_SPACING, axis=1))


def _demand_ratio(
    z: np.ndarray, record: Record, car: VehicleParameters, instruments: Instruments
) -> np.ndarray:
    """Return the accelerations that heights `z` (2, M) [m] demand of `car` over those measured, as
    RMS about each station (M,) in that of _IMPOSSIBLE_BANDS in which it is the greatest.
    """
    record, valid, _ = mask_record(record, instruments)
    measured, predicted, finite = _motions(record, valid, car, instruments, z)
    settling = min(_LONGEST_SETTLING, _SETTLING_SHARE * float(record.t[-1] - record.t[0]))
    density = float(np.sum(instruments.noise_densities**2)) * record.t.size / z.shape[1]
    powers = []
    centred = [x - x.mean(axis=1, keepdims=True) for x in (measured, predicted)]
    for band in pairwise(_IMPOSSIBLE_BANDS):
        sos = butter(2, band, "bandpass", fs=record.fs, output="sos")
        motions = [sosfiltfilt(sos, x) for x in centred]
        powers.append(_by_station(motions, finite, record, car.wheelbase, settling))
    power, demanded = np.swapaxes(powers, 0, 1)
    mean = power.mean(axis=1)
    noise = _NOISE_MARGIN * density * np.diff(_IMPOSSIBLE_BANDS)
    least = np.maximum(np.maximum(mean, _LEAST_OF_ALL * mean.sum()), noise)
    return np.asarray(np.sqrt(demanded / np.maximum(power, least[:, None])).max(axis=0))


def mark_impossible(
    estimate: Estimate, record: Record, car: VehicleParameters, estimator: Estimator
) -> Estimate:
    """Return the `estimate` of an `estimator` with a model of the vehicle with its impossible
    heights marked as `unsure`, in the first note and by a greater `z_std`. Raises ConfigError.

    Which heights of a window demand its accelerations is not told, so all of it are marked.
    """
    if not isinstance(estimator, HasInstruments):
        return estimate
    ratio = _demand_ratio(estimate.z, record, car, instruments_of(record, estimator.instruments))
    window = 2 * round(_WINDOW / PROFILE_SPACING) + 1
    impossible = maximum_filter1d(ratio >= _IMPOSSIBLE_RATIO, window)
    if not impossible.any():
        return estimate
    first, last = PROFILE_SPACING * np.flatnonzero(impossible)[[0, -1]]
    note = (
        f"no wheel load supports {PROFILE_SPACING * impossible.sum():.0f} m of the road between "
        f"{first:.0f} and {last:.0f} m, which would move the vehicle up to {ratio.max():.0f} times "
        "as hard as was measured: heights there are not known; check vehicle, modes, speed and "
        "channels, or drive more slowly"
    )
    return mark_unsure(estimate, impossible, note)


def mark_unsure(estimate: Estimate, unsure: np.ndarray, *notes: str) -> Estimate:
    """Return `estimate` with the stations `unsure` (M,) beside those that are, `notes` before the
    others, and `z_std` raised there by the RMS of the waves below some metres.
    """
    z_std = estimate.z_std
    if z_std is not None:
        short = estimate.z - gaussian_filter1d(estimate.z, 1.0 / PROFILE_SPACING, axis=1)
        level = np.sqrt((short[:, unsure] ** 2).mean(axis=1, keepdims=True))
        z_std = np.where(unsure, np.hypot(z_std, level), z_std)
    before = False if estimate.unsure is None else estimate.unsure
    return replace(estimate, z_std=z_std, unsure=unsure | before, notes=(*notes, *estimate.notes))


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


def _simulate_sensors(
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
    wheelbase = car.wheelbase / PROFILE_SPACING
    state, strut_state = rest_state(car, inputs), settled_strut_state(int(inputs.commands[0]))
    a = np.full((rows.shape[0], inputs.n_steps), np.nan)
    for first in range(0, inputs.n_steps, _CHUNK_STEPS):
        last = min(first + _CHUNK_STEPS, inputs.n_steps)
        half = slice(2 * first, 2 * last)
        road = np.empty((2 * (last - first), 2, 4))
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
