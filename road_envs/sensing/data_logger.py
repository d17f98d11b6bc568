"""Data logger: measured samples from the true motion (section 6 of the paper).

acceleration at the sensor -> faults -> noise -> clipping at the range -> anti-alias -> samples
samples -> constant trend removed -> 25 Hz low-pass        (`filters.preprocess_accelerations`)
"""

import numpy as np

from road_envs.core import config
from road_envs.kernels.filters import butterworth_sos, sosfilt_kernel
from road_envs.sensing.instruments import ANTIALIAS_ORDER, Instruments
from road_envs.sensing.instruments import load_instruments as load_instruments
from road_envs.sensing.sensor_faults import NO_FAULTS, JitteredSampler, SensorFaults, gauss_markov
from road_envs.simulation.drive import Trajectory
from road_envs.vehicle.body_bending import BendingMotion, shape
from road_envs.vehicle.equations import THETA, Z_B
from road_envs.vehicle.parameters import VehicleParameters


class DataLogger:
    """Instruments and logger of one drive, with the filter state and the noise generator.

    A sample is taken every 1 / (fs step) steps of the integrator of `step` [s]. Raises ConfigError
    if that is not a whole number.
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
                f"samples; a step of {step} s gives {decimation:.3f}"
            )
        self.decimation, self.fs = round(decimation), instruments.fs
        self.range = instruments.ranges
        self.noise_std = instruments.noise_densities * np.sqrt(0.5 / step)
        k = self.range.size
        dx, dy = (faults.per_sensor(name, k).tolist() for name in ("dx", "dy"))
        shifts = zip(instruments.locations(car).values(), dx, dy, strict=True)
        self.locations = [at._replace(x=at.x + x, y=at.y + y) for at, x, y in shifts]
        self.faults, self.sampler = faults, None
        mode = car.variation.bending
        self.bending = None if mode is None else BendingMotion(mode, car, step)
        if faults.jitter > 0.0 or faults.dropout_rate > 0.0:
            self.sampler = JitteredSampler(self.decimation, step, faults, k)
        self.sos = butterworth_sos(ANTIALIAS_ORDER, instruments.f_alias, 1.0 / step)
        self.filter_state = np.zeros((self.sos.shape[0], k, 2))
        self.n_steps, self.rng = 0, rng
        self.position_rng = rng.spawn(1)[0] if faults.position_noise > 0.0 else None
        self.speed_gain = 1.0 + instruments.speed_error * rng.standard_normal()
        self.speed_gain *= 1.0 + faults.speed

    def sample(self, trajectory: Trajectory) -> np.ndarray:
        """Return the samples (k, n) [m/s²] of the sensors within `trajectory`; NaN if lost.

        With jitter the samples near the end are returned by the next call, or by `flush`.
        """
        a = np.array([trajectory.vertical_acceleration(*location) for location in self.locations])
        if self.bending is not None:
            rates = trajectory.acceleration
            q, mode = self.bending.advance(rates[:, Z_B], rates[:, THETA]), self.bending.mode
            a += np.array([shape(mode, at.x) * (at.axle is None) * q for at in self.locations])
        return self.digitise(a)

    def digitise(self, a: np.ndarray) -> np.ndarray:
        """Return the samples (k, n) of true accelerations `a` (k, N) [m/s²] at the sensors."""
        if self.faults is not NO_FAULTS:
            factor, constant = self.faults.readings(len(a))
            a = factor[:, None] * a + constant[:, None]
        if self.noise_std.any():  # drawn time step by time step, so that chunks equal the whole
            a += self.noise_std[:, None] * self.rng.standard_normal(a.shape[::-1]).T
        a = np.clip(a, -self.range[:, None], self.range[:, None])
        sosfilt_kernel(self.sos, self.filter_state, a, a)
        if self.sampler is not None:
            return self.sampler.sample(a)
        samples = a[:, -self.n_steps % self.decimation :: self.decimation]
        self.n_steps += a.shape[1]
        return samples

    def odometer(self, distance: np.ndarray) -> np.ndarray:
        """Return the odometer reading after a true `distance` (N,) [m], from 0 on, at samples."""
        length = self.faults.position_fix_length
        if np.isinf(length):
            return self.speed_gain * distance
        s = distance - (self.speed_gain - 1.0) * length * np.expm1(-distance / length)
        return s if self.position_rng is None else s + self._followed_fixes(distance)

    def _followed_fixes(self, distance: np.ndarray) -> np.ndarray:
        """Return the error (N,) [m] of an odometer without a speed error that follows the fixes."""
        faults, rng = self.faults, self.position_rng
        assert rng is not None
        wander = faults.position_noise, faults.position_correlation_time, 1.0 / self.fs
        g = gauss_markov(*wander, distance.size, rng)
        shares = -np.expm1(-np.diff(distance) / faults.position_fix_length)
        error, last = g.copy(), float(g[0])
        for k, (share, mean) in enumerate(zip(shares, 0.5 * (g[1:] + g[:-1]), strict=True), 1):
            error[k] = last = last + share * (mean - last)
        return error

    def flush(self) -> np.ndarray:
        """Return the samples (k, n) [m/s²] that are still buffered at the end of the drive."""
        empty = np.zeros((self.range.size, 0))
        return empty if self.sampler is None else self.sampler.sample(empty, last=True)
