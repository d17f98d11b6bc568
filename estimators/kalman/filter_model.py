"""Constants of a filter run: the linearized vehicle, its force tables, and the noise."""

import numpy as np
from scipy.signal import sosfilt

from estimators.common.bending import sensed_bending
from estimators.common.model_inputs import ModelInputs
from estimators.kalman.friction_linearization import RATE_STDS, smoothed_tables
from estimators.kalman.state import FilterModel
from estimators.kalman.tuning import TUNING
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle import body_bending
from road_envs.vehicle.equations import THETA, Z_B, build_plant
from road_envs.vehicle.linear_model import linearise
from road_envs.vehicle.parameters import VehicleParameters


def build_model(
    car: VehicleParameters,
    instruments: Instruments,
    model_inputs: ModelInputs,
    steps_per_block: int,
    noise_variance: float,
    node_spacing: float,
) -> FilterModel:
    """Return a run's constants; `noise_variance` [(m/s²)²] of a sample, `node_spacing` [m]."""
    one, locations = build_plant(car), instruments.locations(car)
    line, bending = linearise(one, "ride", locations), sensed_bending(car, locations)
    # a constant force over so short a time as a block moves the vehicle like free masses
    inverse = line.inverse_inertia
    accel = (line.strut_rows / line.M).T if inverse is None else inverse @ line.strut_rows.T
    time = steps_per_block * model_inputs.h
    force_effect = [line.sensor_rows @ accel, 0.5 * time**2 * accel, time * accel]
    section = np.zeros((0, 6))
    if bending is not None:
        section = body_bending.section(bending.mode, model_inputs.h * model_inputs.decimation)
        samples = steps_per_block // model_inputs.decimation
        push = np.repeat((bending.force @ accel[[Z_B, THETA]])[:, None], samples, axis=1)
        bent, end = sosfilt(section, push, zi=np.zeros((1, 4, 2)))
        force_effect.append(end[0].T)
        force_effect[0] = force_effect[0] + np.outer(bending.shape, bent.mean(axis=1))
    tables, force_variance = smoothed_tables(one.velocity)
    return FilterModel(
        constants=one.constants.copy(),
        velocity=tables,
        displacement=one.displacement,
        first_table=one.constants["velocity_table"][0].copy(),
        rate_stds=RATE_STDS / TUNING.std_inflation,
        force_variance=force_variance
        * TUNING.force_correlation_time
        / (steps_per_block * model_inputs.h),
        strut_rows=line.strut_rows,
        sensor_rows=line.sensor_rows,
        force_effect=np.concatenate(force_effect).T.copy(),
        h=model_inputs.h,
        steps_per_block=steps_per_block,
        decimation=model_inputs.decimation,
        valve_lag=car.valve.lag,
        bending_force=np.zeros(2) if bending is None else bending.force,
        bending_shape=np.zeros(3) if bending is None else bending.shape,
        bending_section=section.ravel(),
        flexible=True if one.flexible else None,
        side=True if one.sideways else None,
        node_spacing=float(node_spacing),
        wheelbase_nodes=car.wheelbase / node_spacing,
        noise_variance=noise_variance,
        noise_time=TUNING.noise_time / (steps_per_block * model_inputs.h),
    )
