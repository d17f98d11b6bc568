"""What the instruments report of a drive, and the paper's processing of it (section 6).

body acceleration at the sensor -> faults -> noise -> clipping at the range -> anti-alias -> samples
samples -> constant trend removed -> 25 Hz low-pass                         (`process`)
"""

import numpy as np

from road_envs import config
from road_envs.sensing.filters import butterworth, run_sections
from road_envs.sensing.instruments import ALIAS_ORDER, Instruments
from road_envs.sensing.instruments import load_instruments as load_instruments
from road_envs.sensing.sensor_faults import SOUND, Faults, Sampler
from road_envs.simulation.drive import Trajectory
from road_envs.vehicle.parameters import VehicleParameters


class Logger:
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
        faults: Faults = SOUND,
    ):
        every = 1.0 / (instruments.fs * step)
        if every < 0.999 or abs(every - round(every)) > 1e-6:
            raise config.ConfigError(
                f"sampling at {instruments.fs} Hz needs a whole number of integrator steps between "
                f"samples; a step of {step} s makes {every:.3f}"
            )
        self.every = round(every)
        self.range = instruments.range
        self.noise_std = instruments.noise_density * np.sqrt(0.5 / step)
        shifts = zip(instruments.places(car).values(), faults.ahead, faults.left, strict=True)
        self.places = [(x + ahead, y + left) for (x, y), ahead, left in shifts]
        self.faults, self.sampler = faults, None
        if faults.jitter > 0.0 or faults.lost > 0.0:
            self.sampler = Sampler(self.every, step, faults)
        self.sos = butterworth(ALIAS_ORDER, instruments.f_alias, 1.0 / step)
        self.memory = np.zeros((self.sos.shape[0], 3, 2))
        self.taken = 0
        self.rng = rng
        self.speed_gain = 1.0 + instruments.speed_error * rng.standard_normal()
        self.speed_gain *= 1.0 + faults.speed

    def sense(self, trajectory: Trajectory) -> np.ndarray:
        """Samples (3, n) [m/s²] of RF, LR, RR that fall into `trajectory`, in order; NaN if lost.

        Those of a clock that jitters come a little later; `rest` has the last of them.
        """
        a = np.array([trajectory.body_acceleration(x, y) for x, y in self.places])
        if self.faults is not SOUND:
            a = self.faults.readings(a)
        if self.noise_std > 0.0:  # drawn instant by instant, so that chunks draw what a whole does
            a += self.noise_std * self.rng.standard_normal(a.shape[::-1]).T
        a = np.clip(a, -self.range, self.range)
        run_sections(self.sos, self.memory, a, a)
        if self.sampler is not None:
            return self.sampler.take(a)
        samples = a[:, -self.taken % self.every :: self.every]
        self.taken += a.shape[1]
        return samples

    def odometer(self, distance: np.ndarray) -> np.ndarray:
        """What the odometer shows after a true `distance` (N,) [m], which grows from 0."""
        fix = self.faults.fix
        if np.isinf(fix):
            return self.speed_gain * distance
        return distance - (self.speed_gain - 1.0) * fix * np.expm1(-distance / fix)

    def rest(self) -> np.ndarray:
        """The samples (3, n) [m/s²] that waited for more of the drive when it was over."""
        nothing = np.zeros((3, 0))
        return nothing if self.sampler is None else self.sampler.take(nothing, last=True)
