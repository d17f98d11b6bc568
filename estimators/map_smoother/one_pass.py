"""One pass over the road in a window: what its instruments measure on a given road.

The unknowns of a pass, beside the road that all passes share, are the deviation of the initial
vehicle state (14), the sensor biases (S) and, if the speed is uncertain, its error, each in units
of its prior standard deviation. Both axles roll over the same road, the rear one a wheelbase later,
so a speed that reads too low shows as a wheelbase that is too short in metres of the odometer. The
measurements are block means of the accelerations of the nonlinear vehicle.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq

from estimators.common.bending import SensedBending, sensed_bending
from estimators.common.block_means import BlockMeans
from estimators.common.footprint import Footprint
from estimators.common.model_inputs import REST_STD, ModelInputs
from estimators.common.sensor_filter import SampledFilter, SensorFilter
from estimators.common.spline import sample_under_wheels
from estimators.map_smoother.block_tangent import BlockTangent, build_block_tangent
from estimators.map_smoother.road_prior import RoadNodes
from estimators.map_smoother.tuning import TUNING
from road_envs.sensing.instruments import SensorLocation
from road_envs.simulation.tape import Tape, linearize_drive
from road_envs.vehicle.equations import Plant, build_plant
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import settled_strut_state


@dataclass(frozen=True, eq=False)
class MeasurementModel:
    """Model of vehicle and instruments: `plant`, time constant `valve_lag` [s] of its valves and
    `wheelbase` [m]; `locations` of the S sensors and `sensor_rows` (S, 7), their acceleration per
    unit of each coordinate's; `noise_variance` [(m/s²)²] of a sample; prior standard deviation
    `bias_std` [m/s²] of the sensor biases; the `bending` of the body, None if it is stiff; the
    `contact_length` [m] over which the tyres envelop the road; the relative standard deviation
    `speed_std` of the speed; the `bandwidth` [Hz] of the measurements, which say nothing above it;
    the anti-alias `filter`, None where it only delays, as the inputs of the drive then say.
    """

    plant: Plant
    valve_lag: float
    wheelbase: float
    locations: Mapping[str, SensorLocation]
    sensor_rows: np.ndarray
    noise_variance: float
    bias_std: float = 0.05
    bending: SensedBending | None = None
    contact_length: float = 0.0
    speed_std: float = 0.0
    bandwidth: float = np.inf
    filter: SensorFilter | None = None


@dataclass(frozen=True, eq=False)
class Pass:
    """One pass in a window. The vehicle begins about the state `initial_state` (14,), with the
    prior standard deviation `initial_std` (14,), with `strut_state` (4, 3) and the `filter_state`
    (n, S, 2) of the model's filter, if any. `nodes` of the road; J block means `measurements` of
    each sensor.
    """

    model: MeasurementModel
    strut_state: np.ndarray
    initial_state: np.ndarray
    initial_std: np.ndarray
    nodes: RoadNodes
    inputs: ModelInputs
    measurements: BlockMeans
    filter_state: np.ndarray

    @property
    def size(self) -> int:
        return self.initial_std.size + len(self.model.sensor_rows) + self.is_speed_unknown

    @property
    def is_speed_unknown(self) -> bool:
        """True if the error of the speed is the last of the unknowns."""
        return self.model.speed_std > 0.0

    def offset_scale(self, noise_variance: float, start_information: np.ndarray) -> np.ndarray:
        """Root of the Hessian's diagonal at the own unknowns, about. `start_information` (14,) of
        measurements of unit variance on the initial state counts for a drive that begins in motion;
        at rest the state is known.
        """
        count = self.measurements.sample_count.sum(axis=1)
        bias = np.sqrt(1.0 + self.model.bias_std**2 * count / noise_variance)
        is_moving = self.initial_std.max() > REST_STD.max()
        start = is_moving * self.initial_std**2 * start_information / noise_variance
        scale = np.concatenate([np.sqrt(1.0 + start), bias])
        if not self.is_speed_unknown:
            return scale
        # a change of the speed moves the rear axle's share of the signals, about half of them
        delay = self.model.speed_std * self.model.wheelbase / float(self.inputs.v.mean())
        moved = delay * np.diff(self.measurements.y, axis=1) / self.block_duration
        information = 0.5 * np.sum(self.measurements.sample_count[:, 1:] * moved**2)
        return np.append(scale, np.sqrt(1.0 + information / noise_variance))

    @property
    def block_duration(self) -> float:
        """Duration [s] of the samples of one block mean."""
        samples = self.measurements.sample_weight.shape[2]
        return self.inputs.h * self.inputs.decimation * samples

    def split(self, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the own unknowns into initial deviation (14,) and biases (S,), in SI units."""
        sizes = self.initial_std.size, len(self.model.sensor_rows)
        start, bias, _ = np.split(own, np.cumsum(sizes))
        return self.initial_std * start, self.model.bias_std * bias

    def speed_error(self, own: np.ndarray) -> float:
        """Excess of the true speed over that of the inputs, relative to the latter."""
        return self.model.speed_std * float(own[-1]) if self.is_speed_unknown else 0.0

    def wheelbase(self, own: np.ndarray) -> float:
        """Wheelbase in metres of the odometer."""
        return self.model.wheelbase / (1.0 + self.speed_error(own))

    def road_under_wheels(self, c: np.ndarray, wheelbase: float) -> np.ndarray:
        """Heights and rates (2 N, 2, 4) under the wheels for coefficients `c` (2, K)."""
        ds, out = self.nodes.ds, np.empty((self.inputs.s.size, 2, 4))
        node, rate = (self.inputs.s - self.nodes.origin) / ds, self.inputs.v / ds
        sample_under_wheels(self.footprint.apply(c), node, rate, wheelbase / ds, out)
        return out

    @property
    def footprint(self) -> Footprint:
        return Footprint.of(self.model.contact_length, self.nodes.ds)

    def with_car(self, car: VehicleParameters) -> "Pass":
        """The pass of another vehicle, which begins as far from its equilibrium."""
        bending, length = sensed_bending(car, self.model.locations), car.variation.contact_length
        model = replace(self.model, plant=build_plant(car), bending=bending, contact_length=length)
        new = replace(self, model=model)
        change = new._level_equilibrium - self._level_equilibrium
        return replace(new, initial_state=self.initial_state + change)

    @cached_property
    def _level_equilibrium(self) -> np.ndarray:
        """Equilibrium (14,) of the vehicle on a level road, in the first strut states."""
        strut_state = settled_strut_state(int(self.inputs.commands[0]))
        return equilibrium(self.model.plant, strut_state, np.zeros(4))

    def simulate(self, c: np.ndarray, own: np.ndarray, plant: Plant | None = None) -> Tape:
        """Drive over the road of the coefficients `c` (2, K), taped, with the plant of the model or
        another. Raises ArithmeticError if the motion is not finite.
        """
        (start, _), inputs, model = self.split(own), self.inputs, self.model
        begin = plant or model.plant, self.strut_state, self.initial_state + start
        road = self.road_under_wheels(c, self.wheelbase(own))
        return linearize_drive(
            *begin, road, inputs.h, commands=inputs.commands, lag=model.valve_lag, v=inputs.v[1::2]
        )

    def linearize(
        self, c: np.ndarray, own: np.ndarray, plant: Plant | None = None
    ) -> "LinearizedPass":
        """Linearize the drive over the road of `c` (2, K), for the plant of the model or another,
        and for the instruments' noise. Raises ArithmeticError.
        """
        tape = self.simulate(c, own, plant)
        residual = self.residual(tape.acceleration, self.split(own)[1])
        return LinearizedPass(self, c, own, tape, residual, self.information)

    def state_after(
        self, c: np.ndarray, own: np.ndarray, steps: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vehicle state (14,), strut state (4, 3) and that of the anti-alias filter after `steps`
        on the road of `c` (2, K).
        """
        part = replace(self, inputs=self.inputs.slice_steps(0, steps))
        tape, filter_state = part.simulate(c, own), self.filter_state
        if self.model.filter is not None:
            sensed = self._at_sensors(tape.acceleration, self.inputs.h)
            _, filter_state = self.model.filter.filter(sensed, filter_state)
        return tape.end, tape.strut_state, filter_state

    @property
    def information(self) -> np.ndarray:
        """Inverse variance (S, J) of each block mean, by the noise of the instruments alone."""
        return self.measurements.sample_count / self.model.noise_variance

    @property
    def is_used(self) -> np.ndarray:
        return self.measurements.sample_count > 0

    def residual(self, acceleration: np.ndarray, bias: np.ndarray) -> np.ndarray:
        """Return the measured less the predicted block means (S, J) [m/s²] of the sensors, from the
        accelerations (N, 7) of the coordinates.
        """
        return self.in_band(self.measurements.residual(self.sense(acceleration) + bias[:, None]))

    @property
    def band_share(self) -> float:
        """Share of the block means' lines that are within the bandwidth."""
        return min(1.0, 2.0 * self.model.bandwidth * self.block_duration)

    def in_band(self, means: np.ndarray) -> np.ndarray:
        """Return block means (S, J) without what lies above the bandwidth: a projection."""
        if self.band_share == 1.0:
            return means
        f = rfftfreq(means.shape[1], self.block_duration)
        return _apply_frequency_weights(f <= self.model.bandwidth, means)

    def sense(self, acceleration: np.ndarray, follows: bool = True) -> np.ndarray:
        """Samples (S, T) [m/s²] of sensors without bias from the accelerations (N, 7) of the
        coordinates, which follow those before the window, or zeros.
        """
        inputs, sampled = self.inputs, self.sampled_filter
        if sampled is None:
            samples = acceleration[:: inputs.decimation][: self.measurements.n_samples]
            return self._at_sensors(samples, inputs.h * inputs.decimation)
        state = self.filter_state if follows else np.zeros_like(self.filter_state)
        return sampled.read(self._at_sensors(acceleration, inputs.h), state)

    def _at_sensors(self, acceleration: np.ndarray, step: float) -> np.ndarray:
        """Return the accelerations (S, N) at the sensors from those of the coordinates (N, 7)."""
        sensed, bending = self.model.sensor_rows @ acceleration.T, self.model.bending
        return sensed if bending is None else sensed + bending.at_samples(acceleration, step)

    @cached_property
    def sampled_filter(self) -> SampledFilter | None:
        """The anti-alias filter at the samples, None if it only delays them."""
        if self.model.filter is None:
            return None
        at = self.inputs.sample_steps(self.measurements.n_samples)
        return SampledFilter(self.model.filter, at, self.inputs.n_steps)


@dataclass(frozen=True, eq=False)
class LinearizedPass:
    """A pass `source` linearized at the coefficients `c` (2, K) of the road and at its `own`
    unknowns: the `tape` of the motion, the `residual` (S, J) [m/s²] of the measurements, and the
    `inverse_variance` (S, J) and `frequency_weights` (J // 2 + 1,), if given, of their noise.
    """

    source: Pass
    c: np.ndarray
    own: np.ndarray
    tape: Tape
    residual: np.ndarray
    inverse_variance: np.ndarray
    frequency_weights: np.ndarray | None = None

    def apply_inverse_covariance(self, means: np.ndarray) -> np.ndarray:
        """R^-1 times block means (S, J)."""
        if self.frequency_weights is None:
            return self.inverse_variance * means
        root = np.sqrt(self.inverse_variance)
        return root * _apply_frequency_weights(self.frequency_weights, root * means)

    @cached_property
    def block_tangent(self) -> BlockTangent:
        o, model = self.source, self.source.model
        inputs, rows, weight = o.inputs, model.sensor_rows, o.measurements.sample_weight
        if o.sampled_filter is not None:  # means of groups of steps, which the filter then samples
            groups, group = o.sampled_filter.n_groups, o.sampled_filter.filter.group
            inputs = replace(inputs, decimation=1)
            weight = np.full((len(rows), groups, group), 1.0 / group)
        if model.bending is not None:
            weight, rows = model.bending.extended(weight, rows)
        return build_block_tangent(self.tape, o.nodes, inputs, weight, rows, o.wheelbase(self.own))

    @cached_property
    def speed_sensitivity(self) -> np.ndarray:
        """Derivative (S, J) of the block means by the last unknown, the error of the speed."""
        o, last = self.source, np.arange(self.own.size) == self.own.size - 1
        unit = TUNING.speed_difference * last
        one, other = (o.road_under_wheels(self.c, o.wheelbase(self.own + d)) for d in (unit, -unit))
        motion, _ = self.tape.tangent(np.zeros(self.tape.end.size), one - other)
        change = o.measurements.average(o.sense(motion, follows=False))
        return change / (2.0 * TUNING.speed_difference)

    def tangent(self, dc: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Change (S, J) of the predicted block means by small changes `dc` (2, K) of the road's
        coefficients and of the `own` unknowns.
        """
        o = self.source
        start, bias = o.split(own)
        means = self.read_road(start, dc)
        if o.is_speed_unknown:
            means += own[-1] * self.speed_sensitivity
        return o.in_band(means + bias[:, None])

    def adjoint(self, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply the transpose of `tangent`: from block means (S, J) to `dc` (2, K) and `own`."""
        o = self.source
        means = o.in_band(means)
        rest = o.model.bias_std * means.sum(axis=1)
        if o.is_speed_unknown:
            rest = np.append(rest, np.sum(self.speed_sensitivity * means))
        if o.sampled_filter is not None:
            means = o.sampled_filter.apply_transpose(o.measurements.average_transpose(means))
        if o.model.bending is not None:
            means = o.model.bending.sense_transpose(means, self._mean_duration)
        start, c = self.block_tangent.apply_transpose(means)
        return o.footprint.apply_transpose(c), np.concatenate([o.initial_std * start, rest])

    def read_road(self, start: np.ndarray, dc: np.ndarray) -> np.ndarray:
        """Change (S, J) of the block means, not limited to the bandwidth, by those of the first
        vehicle state (14,) and of the road's coefficients `dc` (2, K).
        """
        o = self.source
        means = self.block_tangent.apply(start, o.footprint.apply(dc))
        if o.model.bending is not None:
            means = o.model.bending.sense(means, self._mean_duration)
        if o.sampled_filter is not None:
            means = o.measurements.average(o.sampled_filter.apply(means))
        return means

    @property
    def _mean_duration(self) -> float:
        """Duration [s] of a mean in the block tangent."""
        o = self.source
        return o.block_duration if o.model.filter is None else o.inputs.h * o.model.filter.group

    def shape_noise(self, white: np.ndarray) -> np.ndarray:
        """R^-1/2 times white noise (S, J)."""
        if self.frequency_weights is not None:
            white = _apply_frequency_weights(np.sqrt(self.frequency_weights), white)
        return np.sqrt(self.inverse_variance) * white


def _apply_frequency_weights(frequency_weights: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Multiply each frequency of block means (S, J) by its weight (J // 2 + 1,)."""
    return irfft(frequency_weights * rfft(means, axis=1), means.shape[1], axis=1)
