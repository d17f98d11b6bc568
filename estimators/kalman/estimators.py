"""Kalman filter of the car and of the road that it stands on: heights told while driving.

The filter holds the seven coordinates of the car, their rates, the zeros of the sensors, and the
road as nodes of a spline fixed in space, of both wheel paths, from the front axle back to behind
the rear one. Nodes come in ahead as the isotropic prior foretells them (`road.py`), and as both
axles stand on the same nodes, what the rear one feels is the delayed front one's road without any
approximation, and each station is known better until it has left (fixed-lag smoothing for nothing).
The car is driven by the simulator's own step through every switch of its struts, and linearised by
its exact tangent (`block.py`); the struts' forces are linearised over what is uncertain of their
rate, and what is left over is noise (`struts.py`), without which the filter soon believes in a
wrong road. Roughness and excess noise are learnt on the way. Heights are told about their long
waves (`telling.py`); `smooth_backward.py` is the smoother for the whole drive.

    kalman       told when the front axle stands on the station
    kalman_lag   told 4.79 m later, at most 2 m after the rear axle
    kalman_rts   told when all has been heard (Rauch, Tung & Striebel's smoother in de Jong's form)

What is heard are means of 3 ms of the raw samples. Samples lost or clipped cost what they would
have told.

Known to fail: on a car that is not the one given (on the field car S2 it errs by more than a flat
road and says so in its notes), for it believes in the car and doubts the road alone; where the
front struts are softer than the rear ones, the difference of the wheel paths is told by the rear
axle, wheelbases later (`docs/observability.md`), so that the early variants have twice the error of
equal states; on smooth roads (class A), where friction holds the struts most of the time; where
wheels leave the ground. `kalman_rts` linearises once, about what was known by then; `map_smoother`
does so again and again and is better.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from estimators.common.block_means import (
    ANTIALIAS_SPREAD,
    MIN_NOISE_DENSITY,
    block_means,
    to_uniform_clock,
    valid_samples,
    validate_record,
)
from estimators.common.model_inputs import antialias_delay, build_model_inputs
from estimators.kalman.pipeline import FilterRun, run_filter, run_smoother, setup_output, setup_run
from estimators.kalman.profile_output import ProfileOutput
from estimators.kalman.state import NOISE_SCALE, ROUGHNESS_SCALE
from road_envs.analysis.information_bound import RoadPrior
from road_envs.analysis.roughness import CLASSES
from road_envs.config import STRICT
from road_envs.data.record import Estimate, Record, profile_stations, scored_band
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters

LAG = 4.79
"""Way [m] that the front axle has gone on when a station is told: the wheelbase and 2 m."""

NOISE_SCALE_WARNING = 2.0
"""Times the noise believed in from which a note says so."""


@dataclass(frozen=True, kw_only=True)
class _KalmanSettings:
    """Settings of all variants.

    `instruments`: name or path; `noise_density` [(m/s²)/sqrt(Hz)] if it is not theirs. `G_d0` [m³]
    and `w`: the road's prior before anything is heard; its level is learnt. `data_rate` [Hz]: means
    of readings in a second. `step` [s]: longest step of the model. `level_ends`: the road is level
    before station 0 and behind its length, where the drive begins at rest. `std_factor`: on what
    the filter holds for its deviation in the judged band, found on training drives.
    """

    __pydantic_config__ = STRICT

    instruments: str = "paper"
    noise_density: float | None = None
    G_d0: float = CLASSES["D"]
    w: float = 2.0
    data_rate: float = 1000.0 / 3.0
    step: float = 0.001
    level_ends: bool = True
    std_factor: float = 1.0

    def __post_init__(self):
        for name in ("G_d0", "w", "data_rate", "step", "std_factor"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.noise_density is not None and not self.noise_density > 0:
            raise ValueError(f"noise_density must be positive, got {self.noise_density}")

    def _estimate(
        self, record: Record, car: VehicleParameters, lag: float, smooth: bool
    ) -> Estimate:
        """Both wheel paths. Raises ConfigError, ValueError, ArithmeticError."""
        validate_record(record)
        record, notes = to_uniform_clock(record)
        instruments = load_instruments(self.instruments)
        model_inputs = build_model_inputs(record, instruments, car, self.step)
        used = valid_samples(record, instruments)
        if lost := int((~used).sum()):
            notes.append(f"{lost} of {used.size} samples lost or clipped, left out")
        a = np.where(used, record.a, 0.0)
        measurements = block_means(a, used, max(1, round(record.fs / self.data_rate)))
        density = self.noise_density or max(instruments.noise_density, MIN_NOISE_DENSITY)
        noise = density**2 * 0.5 * record.fs
        prior = RoadPrior(G_d0=self.G_d0, w=self.w, track=2.0 * car.front.y_t)
        run = setup_run(
            record, car, instruments, model_inputs, measurements, noise, prior, self.level_ends, lag
        )
        sensor_latency = (ANTIALIAS_SPREAD + 1) / record.fs + antialias_delay(instruments)
        output = setup_output(run, record, lag, sensor_latency, detrended=not smooth)
        if smooth:
            run_smoother(run, output)
        else:
            run_filter(run, output)
        if not np.isfinite(output.z).all():
            raise ArithmeticError("the filter lost the car: this record is none of such a drive")
        if (excess := float(run.state.adaptive[NOISE_SCALE])) > NOISE_SCALE_WARNING:
            notes.append(
                f"at last {excess:.1f} times the noise believed in was heard: the car may not be "
                "the one believed in"
            )
        z_std = self.std_factor * _output_std(run, output, record, prior)
        return Estimate(profile_stations(record.length), output.z.T.copy(), z_std, tuple(notes))


def _output_std(
    run: FilterRun, output: ProfileOutput, record: Record, prior: RoadPrior
) -> np.ndarray:
    """Standard deviations (2, M) [m] in the judged band; of the prior where no wheel has been."""
    n = np.linspace(*scored_band(float(np.clip(record.v.mean(), 0.1, 100.0))), 400)
    s, variance = profile_stations(record.length), np.maximum(output.variance.T, 0.0)
    level = np.where(
        s < record.s[0], 1.0, run.state.adaptive[ROUGHNESS_SCALE]
    )  # once none was learnt yet
    all_of_it = level * np.trapezoid(prior.density(n), n)
    unseen = (s < record.s[0]) | (s > record.s[-1])
    return np.sqrt(np.where(unseen, np.maximum(variance, all_of_it), variance))


@dataclass(frozen=True, kw_only=True)
class Kalman(_KalmanSettings):
    """The filter: a station is told when the front axle stands `lag` [m] past it."""

    causal: ClassVar[bool] = True

    lag: float = 0.0
    std_factor: float = 1.5

    def __post_init__(self):
        super().__post_init__()
        if not 0.0 <= self.lag < 100.0:
            raise ValueError(f"lag must be 0 to 100 m, got {self.lag}")

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Both wheel paths. Raises ConfigError, ValueError, ArithmeticError."""
        return self._estimate(record, car, self.lag, smooth=False)


@dataclass(frozen=True, kw_only=True)
class KalmanLag(Kalman):
    """The fixed-lag smoother."""

    lag: float = LAG
    std_factor: float = 0.74


@dataclass(frozen=True, kw_only=True)
class KalmanRts(_KalmanSettings):
    """The smoother of the whole drive."""

    causal: ClassVar[bool] = False

    std_factor: float = 0.74

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Both wheel paths. Raises ConfigError, ValueError, ArithmeticError."""
        return self._estimate(record, car, car.wheelbase, smooth=True)
