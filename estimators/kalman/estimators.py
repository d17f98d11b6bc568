"""Extended Kalman filter of vehicle and road, with a fixed-lag and a whole-drive smoother.

The state holds the coordinates of the vehicle and their rates, with a frame that twists and a body
that bends where the vehicle has them, the sensor biases, and the road as nodes of a spline fixed in
space, of both wheel paths, from the front axle back to behind the rear one. New nodes come from the
isotropic prior (`road_process.py`). Both axles roll over the same nodes, so the wheelbase delay is
exact, and a node keeps being updated until it is retired: fixed-lag smoothing at no extra cost. The
vehicle is propagated by the simulator's own step through every switch of its struts, and linearized
by the exact tangent of the steps (`linearization.py`). The strut forces are linearized over the
uncertainty of their rate (`friction_linearization.py`) and the residual is noise, without which the
filter soon becomes overconfident. Roughness and noise scale are estimated online; edges of
obstacles, which are no part of a stationary road, are found by the innovations (`jumps.py`).
Heights are emitted relative to their long waves (`profile_output.py`).

    kalman       emitted when the front axle is at the station
    kalman_lag   emitted 10 m later, 7.2 m after the rear axle
    kalman_rts   emitted after the whole drive (`smoother.py`)

The measurements are means over 3 ms of the raw samples. Lost samples are left out; a clipped one is
a limit. The nodes of the lag are held, so the cost grows with its square beyond some 10 m.

The standard deviation follows the innovations of the metres about a station, and heights no larger
than it are reduced (`monitoring.py`). Where the innovations are far beyond their covariance for
long, heights are emitted reduced, with wide intervals and a note. Where no obstacle explains it,
the filter has lost the vehicle and begins anew, as in the middle of a road (`forward.py`).

Known to fail: on a vehicle other than the one described (on a field vehicle S2 that was not
identified the error is nearly that of a flat road), as the filter corrects the road and not the
vehicle; where the front struts are softer than the rear ones, as only the rear axle then resolves
the difference of the wheel paths, wheelbases later (`docs/observability.md`): at a lag of 4.79 m
the error is two to three times that of equal states, at 10 m about the same; on smooth roads (class
A), where friction holds the struts most of the time; where wheels lift off. `kalman_rts` linearizes
once, about the filter's estimate; `map_smoother` iterates and is more accurate.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field
from scipy.ndimage import minimum_filter1d

from estimators.api import LAG, declared_lag
from estimators.common.blas import single_blas_thread
from estimators.common.block_means import MIN_NOISE_DENSITY, block_means
from estimators.common.explained import reduce_unexplained, trusted_share, untrusted_note
from estimators.common.model_inputs import antialias_delay, build_model_inputs
from estimators.common.odometer import calibrate_odometer
from estimators.kalman import monitoring, pipeline
from estimators.kalman.state import N_BIAS, NOISE_SCALE
from estimators.kalman.tuning import TUNING
from estimators.map_smoother.identified_vehicle import CalibratedByIdentification
from estimators.preprocessing import ANTIALIAS_SPREAD, RecordError, clipped_signs, mask_record
from road_envs.analysis.information_bound import RoadPrior
from road_envs.core.config import Positive
from road_envs.records.record import PROFILE_SPACING, Estimate, Record, profile_stations
from road_envs.records.roughness import CLASSES
from road_envs.sensing.instruments import instruments_of, on_axle
from road_envs.vehicle.parameters import VehicleParameters

_Lag = Annotated[float, Field(ge=0, lt=100), "m", "from the front axle back to the station emitted"]
_StdFactor = Annotated[Positive, "", "on the in-band standard deviation, fitted to training drives"]


@dataclass(frozen=True, kw_only=True)
class _KalmanSettings(CalibratedByIdentification):
    """Settings of all variants, beside the name or path of the `instruments`. `level_ends`: the
    road is level before station 0 and behind its length, where the drive begins at rest.
    """

    noise_density: Annotated[Positive | None, "(m/s²)/sqrt(Hz)", "if not the instruments'"] = None
    G_d0: Annotated[Positive, "m³", "of the road's prior, whose level adapts"] = CLASSES["D"]
    w: Annotated[Positive, "", "waviness of the road's prior"] = 2.0
    data_rate: Annotated[Positive, "Hz", "of the block means"] = 1000.0 / 3.0
    step: Annotated[Positive, "s", "longest step of the model"] = 0.001
    causal: ClassVar[bool]
    level_ends: bool = True
    std_factor: _StdFactor = 1.0

    @single_blas_thread()  # its products are small: threads that wait for each other cost ten times
    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return both wheel paths. Raises ConfigError, RecordError, ValueError, ArithmeticError."""
        smooth = not self.causal
        lag = car.wheelbase if smooth else declared_lag(self)
        instruments = instruments_of(record, self.instruments)
        places = instruments.locations(car)
        if len(places) != N_BIAS or on_axle(places):
            raise RecordError(
                f"the Kalman filters take {N_BIAS} accelerometers on the body; the record has "
                f"{', '.join(instruments.accelerometers)}: map_smoother and wiener take any"
            )
        odometer = calibrate_odometer(record, causal=not smooth)
        # where positions wander the road is level somewhere else
        level_ends = self.level_ends and not (smooth and odometer.s_std is not None)
        record, car = self.as_identified(odometer.record, car)
        record, valid, notes = mask_record(record, instruments)
        model_inputs = build_model_inputs(record, instruments, car, self.step)
        censored = clipped_signs(record, instruments)
        a = np.where(valid | (censored != 0), record.a, 0.0)
        block = max(1, round(record.fs / self.data_rate))
        measurements = block_means(a, valid, block, censored)
        density = self.noise_density or max(instruments.noise_density, MIN_NOISE_DENSITY)
        noise = density**2 * 0.5 * record.fs
        prior = RoadPrior(G_d0=self.G_d0, w=self.w, track=2.0 * car.front.y_t)
        ahead = TUNING.power_window if smooth else min(max(lag - LAG, 0.0), TUNING.power_window)
        run = pipeline.setup_run(
            record,
            car,
            instruments,
            model_inputs,
            measurements,
            noise_variance=noise,
            prior=prior,
            level_ends=level_ends,
            lag=lag - (0.0 if smooth else ahead),
        )
        sensor_latency = (ANTIALIAS_SPREAD + 1) / record.fs + antialias_delay(instruments)
        output = pipeline.setup_output(run, record, sensor_latency, detrended=not smooth)
        (pipeline.run_smoother if smooth else pipeline.run_filter)(run, output)
        if not np.isfinite(output.z).all():
            raise ArithmeticError(
                "the filter diverged (heights are not finite): check the vehicle, the commanded "
                "states and the signs of the sensors"
            )
        if (scale := float(run.state.adaptive[NOISE_SCALE])) > TUNING.noise_scale_warning:
            notes += (
                f"at the end the noise power is {scale:.1f} times the expected one: the vehicle "
                "may differ from the one described",
            )
        if run.state.restarts:
            at = ", ".join(f"{x:.0f}" for x in run.known_front(0.0)[run.state.restarts])
            notes += (
                f"the filter lost the vehicle and began anew at {at} m: the heights of "
                f"the {TUNING.lost_reach:g} m before are not known; the vehicle may differ from "
                "the one described (docs/howto/identify)",
            )
        s, front = profile_stations(record.length), run.known_front(sensor_latency)
        z, emitted = output.z.T.copy(), run.emitted_share(output)
        z_std = self.std_factor * pipeline.output_std(run, output, record, prior)
        if smooth or lag >= LAG:  # both axles have passed
            late = np.inf if smooth else lag
            z_std *= np.sqrt(monitoring.local_nis(run.state.nis, front, s, late))
            z = monitoring.reduce_uncertain(z, z_std, ahead, drifting=smooth)
            steps = run.state.jumps.square
            nodes = run.origin + TUNING.node_spacing * np.arange(len(steps))
            z_std = np.hypot(z_std, monitoring.obstacle_std(steps, nodes, s))
        long = monitoring.long_waves(z) if smooth else np.zeros_like(z)
        # RMS of the latest accelerations when each height is emitted
        power = run.state.signal_power[np.clip(output.emit_block - 1, 0, None)]
        driven = np.sqrt(noise / max(float(measurements.sample_count.max()), 1.0) * power)
        z_std = monitoring.with_model_error(z_std, z - long, driven, car)
        share = emitted
        if smooth:
            explained = trusted_share(record, valid, car, instruments, z)
            # a filter that is lost later errs before that too, once smoothed
            share = minimum_filter1d(emitted, 2 * round(TUNING.lost_reach / PROFILE_SPACING) + 1)
            share, notes = share * explained, notes + untrusted_note(explained)
        if (length := PROFILE_SPACING * float(np.sum(emitted < 0.95))) >= 1.0:
            notes += (
                f"over {length:.0f} m the innovations are far beyond their covariance; the heights "
                "are reduced there",
            )
        share = np.where(run.lost_before_restarts(output), 0.0, share)
        reduced, std = reduce_unexplained(z - long, z_std, share)
        heights = reduced + monitoring.reduce_slope(long, share)
        return odometer.describe(Estimate(s, heights, std, notes))


@dataclass(frozen=True, kw_only=True)
class Kalman(_KalmanSettings):
    """Extended Kalman filter that emits a station when the front axle is `lag` [m] past it."""

    causal: ClassVar[bool] = True
    lag: _Lag = 0.0
    std_factor: _StdFactor = 1.5


@dataclass(frozen=True, kw_only=True)
class KalmanLag(Kalman):
    """Extended Kalman filter, as a smoother of the last 10 m: usable while driving."""

    lag: _Lag = 10.0
    std_factor: _StdFactor = 0.87


@dataclass(frozen=True, kw_only=True)
class KalmanRts(_KalmanSettings):
    """Extended Kalman filter and Rauch-Tung-Striebel smoother of the whole drive."""

    causal: ClassVar[bool] = False
    std_factor: _StdFactor = 0.85
