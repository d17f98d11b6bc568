"""What the instruments report of a drive, and the paper's processing of it (section 6).

body acceleration at the sensor -> faults -> noise -> clipping at the range -> anti-alias -> samples
samples -> constant trend removed -> 25 Hz low-pass                         (`process`)
"""

import numpy as np

from road_envs import config
from road_envs.sensing.filters import butterworth_sos, sosfilt_kernel
from road_envs.sensing.instruments import ANTIALIAS_ORDER, Instruments
from road_envs.sensing.instruments import load_instruments as load_instruments
from road_envs.sensing.sensor_faults import NO_FAULTS, JitteredSampler, SensorFaults
from road_envs.simulation.drive import Trajectory
from road_envs.vehicle.parameters import VehicleParameters


class DataLogger:
    """The instruments at work on one drive: holds the filter's memory and the noise's generator.

    `faults` are what is wrong with them. `step` [s] is the integrator's; a sample is taken every
    1 / (fs step) steps. Raises ConfigError if that is not a whole number.
    """

    def __init__(
        self,
        instruments: Instruments,
        car: VehicleParameters,
        step: float,
        rng: np.random.Generator,
        faults: SensorFaults = NO_FAULTS,
    ):
        decimation = 1.0 / (instruments.fs * step)
        if decimation < 0.999 or abs(decimation - round(decimation)) > 1e-6:
            raise config.ConfigError(
                f"sampling at {instruments.fs} Hz needs a whole number of integrator steps between "
                f"samples; a step of {step} s makes {decimation:.3f}"
            )
        self.decimation = round(decimation)
        self.range = instruments.range
        self.noise_std = instruments.noise_density * np.sqrt(0.5 / step)
        shifts = zip(instruments.locations(car).values(), faults.dx, faults.dy, strict=True)
        self.locations = [(x + dx, y + dy) for (x, y), dx, dy in shifts]
        self.faults, self.sampler = faults, None
        if faults.jitter > 0.0 or faults.dropout_rate > 0.0:
            self.sampler = JitteredSampler(self.decimation, step, faults)
        self.sos = butterworth_sos(ANTIALIAS_ORDER, instruments.f_alias, 1.0 / step)
        self.filter_state = np.zeros((self.sos.shape[0], 3, 2))
        self.n_steps = 0
        self.rng = rng
        self.speed_gain = 1.0 + instruments.speed_error * rng.standard_normal()
        self.speed_gain *= 1.0 + faults.speed

    def sample(self, trajectory: Trajectory) -> np.ndarray:
        """Samples (3, n) [m/s²] of RF, LR, RR that fall into `trajectory`, in order; NaN if lost.

        Those of a clock that jitters come a little later; `flush` has the last of them.
        """
        a = np.array([trajectory.body_acceleration(x, y) for x, y in self.locations])
        if self.faults is not NO_FAULTS:
            a = self.faults.apply(a)
        if self.noise_std > 0.0:  # drawn instant by instant, so that chunks draw what a whole does
            a += self.noise_std * self.rng.standard_normal(a.shape[::-1]).T
        a = np.clip(a, -self.range, self.range)
        sosfilt_kernel(self.sos, self.filter_state, a, a)
        if self.sampler is not None:
            return self.sampler.sample(a)
        samples = a[:, -self.n_steps % self.decimation :: self.decimation]
        self.n_steps += a.shape[1]
        return samples

    def odometer(self, distance: np.ndarray) -> np.ndarray:
        """What the odometer shows after a true `distance` (N,) [m], which grows from 0."""
        fix = self.faults.position_fix_length
        if np.isinf(fix):
            return self.speed_gain * distance
        return distance - (self.speed_gain - 1.0) * fix * np.expm1(-distance / fix)

    def flush(self) -> np.ndarray:
        """The samples (3, n) [m/s²] that waited for more of the drive when it was over."""
        nothing = np.zeros((3, 0))
        return nothing if self.sampler is None else self.sampler.sample(nothing, last=True)
