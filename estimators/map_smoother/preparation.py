"""Settings of the solver, and drives prepared for it: instruments, block means, nodes.

The model is the vehicle as given, in steps of 1 ms. The measurements are means over 5 ms of the raw
samples, so up to about 90 Hz: friction mixes frequencies, and accelerations above the scored 25 Hz
carry information about the road below.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from estimators.common.bending import sensed_bending
from estimators.common.block_means import MIN_NOISE_DENSITY
from estimators.common.model_inputs import (
    MOVING_STD,
    REST_STD,
    build_model_inputs,
    is_even,
    rest_state,
)
from estimators.common.sensor_filter import SensorFilter, is_only_a_delay
from estimators.low_pass import bridge
from estimators.map_smoother.one_pass import MeasurementModel
from estimators.map_smoother.road_prior import RoadNodes
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.windows import PreparedDrive
from estimators.preprocessing import clipped_signs, mask_record, restore_times
from road_envs.analysis.information_bound import RoadPrior
from road_envs.core.config import Positive, Settings
from road_envs.records.record import Record
from road_envs.records.roughness import CLASSES
from road_envs.sensing.instruments import Instruments, instruments_of, on_axle
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.linear_model import linearise
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import settled_strut_state


@dataclass(frozen=True, kw_only=True)
class SolverSettings(Settings):
    """Settings of the most probable road, beside the name or path of the `instruments`.
    `level_ends`: the road is level before station 0 and behind its length, where the drive begins
    at rest. `adapt_prior`: the prior's density is re-estimated from the drive.
    """

    instruments: str = "paper"
    noise_density: Annotated[Positive | None, "(m/s²)/sqrt(Hz)", "if not the instruments'"] = None
    G_d0: Annotated[Positive, "m³", "of the road's prior"] = CLASSES["D"]
    w: Annotated[Positive, "", "waviness of the road's prior"] = 2.0
    adapt_prior: bool = True
    prior_updates: Annotated[int, Field(ge=0), "", "between the last steps"] = TUNING.prior_updates
    data_rate: Annotated[Positive, "Hz", "least one of the block means"] = 200.0
    step: Annotated[Positive, "s", "longest step of the model"] = 0.001
    level_ends: bool = True
    huber: Annotated[float, Field(gt=0), "deviations", "from which on readings count less"] = 5.0
    window: Annotated[float, "s", "longer drives are estimated window by window"] = 40.0
    overlap: Annotated[Positive, "s", "of the windows"] = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.window >= 2.0 * self.overlap:
            raise ValueError(
                f"window must be at least twice the overlap of {self.overlap} s, got {self.window}"
            )

    @property
    def road_prior(self) -> RoadPrior:
        return RoadPrior(G_d0=self.G_d0, w=self.w)

    def prepare(
        self,
        record: Record,
        car: VehicleParameters,
        readings_per_unknown: float = TUNING.readings_per_unknown,
        speed_std: float | None = None,
    ) -> tuple[PreparedDrive, tuple[str, ...]]:
        """Prepare a drive of `car`; with notes on the record. The relative error of the speed has
        the prior standard deviation `speed_std`, or that of the instruments if greater; with None
        it has no error. Raises ConfigError, RecordError.
        """
        instruments = instruments_of(record, self.instruments)
        masked = mask_record(record, instruments)
        record, valid, notes = restore_times(masked, record, instruments)
        model, v = self._measurement_model(record, car, instruments), float(record.v.mean())
        if speed_std is not None:
            model = replace(model, speed_std=max(speed_std, instruments.speed_error))
        ds = float(np.clip(0.5 * v / TUNING.f_resolved, *TUNING.node_spacings))
        unknowns = 2.0 * v / ds  # per second
        rate = max(self.data_rate, readings_per_unknown * unknowns / len(record.a))
        is_on_axle = on_axle(model.locations)
        if is_on_axle and readings_per_unknown > 0.0:
            rate = TUNING.axle_readings_per_unknown * unknowns / len(record.a)
        block = max(1, round(record.fs / rate))
        precise = is_on_axle or instruments.noise_densities.min() < TUNING.delay_noise_density
        filtered = precise or not (is_even(record) and is_only_a_delay(instruments))
        inputs = build_model_inputs(record, instruments, car, self.step, filtered)
        if filtered:  # the anti-alias filter does more than delay the samples
            rate = record.fs / block
            model = replace(model, filter=SensorFilter.of(instruments, inputs.h, rate))
        censored = clipped_signs(record, instruments)
        a = np.where(valid | (censored != 0), record.a, 0.0)
        if np.isfinite(record.bandwidth):  # what is left of a gap lies between its ends
            a = bridge(record.a)
        # the mean over the drive is mostly sensor bias
        mean = np.sum(a, axis=1, where=valid) / np.maximum(valid.sum(axis=1), 1)
        a -= mean[:, None]
        origin = inputs.s[0] - car.wheelbase - (TUNING.node_margin + 1) * ds
        nodes = RoadNodes(origin, ds, int((inputs.s[-1] - origin) / ds) + 2 * TUNING.node_margin)
        level = self.level_ends and record.s[0] <= 0.0
        span = 0.0 if level else -np.inf, record.length if self.level_ends else np.inf
        rest = rest_state(car, inputs)
        typical = REST_STD if level else MOVING_STD
        initial_std = np.repeat(typical[[0, -1]], rest.size // 2)  # of a frame's twist, too
        strut_state = settled_strut_state(int(inputs.commands[0]))
        filter_state = np.zeros((0, len(a), 2))
        if model.filter is not None:
            filter_state = model.filter.at_rest(len(a))
            if not level:  # what the filter held before is not known
                valid = valid & (np.arange(valid.shape[1]) >= model.filter.memory * record.fs)
        drive = PreparedDrive(
            car, model, inputs, a, valid, censored, block,
            rest, initial_std, strut_state, filter_state, nodes, span,
        )  # fmt: skip
        return drive, notes

    def _measurement_model(
        self, record: Record, car: VehicleParameters, instruments: Instruments
    ) -> MeasurementModel:
        one, locations = build_plant(car), instruments.locations(car)
        sensor_rows = linearise(one, "ride", locations).sensor_rows
        density = self.noise_density or max(instruments.noise_density, MIN_NOISE_DENSITY)
        noise = density**2 * 0.5 * record.fs
        return MeasurementModel(
            one, car.valve.lag, car.wheelbase, locations, sensor_rows, noise,
            bending=sensed_bending(car, locations), contact_length=car.variation.contact_length,
            bandwidth=record.bandwidth,
        )  # fmt: skip
