"""A vehicle driven over a surface: step by step under changing commands, or whole.

`Drive` is what the environment advances; `simulate` runs one to its end. A drive begins with the
front axle RUN_UP metres before station 0, at rest on the level apron in the commanded mode, and is
over when the rear axle has passed the end of the surface by the same distance.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from road_envs.config import ConfigError
from road_envs.roads.surface import Surface
from road_envs.simulation import rosenbrock
from road_envs.simulation.manoeuvres import Manoeuvre
from road_envs.simulation.speed import SpeedProfile, constant
from road_envs.vehicle.equations import N_DOF, PHI, THETA, Z_B, Plant, equilibrium, plant
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import command, memory_at_rest

RUN_UP = 5.0
"""Level apron [m] before and after the surface."""


class SimulationError(ArithmeticError):
    """The motion left the numbers' range; the sentence says when."""


@dataclass(frozen=True)
class Trajectory:
    """Motion of the vehicle at N instants.

    `t` [s], `s` station of the front axle [m], `v` speed [m/s], `commands` bytes as given, all
    (N,); `signals` (N, 29), or (N, 32) of a flexible car, as `integrator` lays them out.
    """

    t: np.ndarray
    s: np.ndarray
    v: np.ndarray
    commands: np.ndarray
    signals: np.ndarray

    @property
    def state(self) -> np.ndarray:
        """Coordinates and rates (N, 14), as in `dynamics`."""
        return self.signals[:, : 2 * N_DOF]

    @property
    def acceleration(self) -> np.ndarray:
        """Accelerations (N, 7) of the degrees of freedom."""
        return self.signals[:, rosenbrock.ACCELERATION : rosenbrock.ACCELERATION + N_DOF]

    @property
    def extension(self) -> np.ndarray:
        """Strut extensions (N, 4) [m] from the static length: rattle space in use."""
        return self.signals[:, rosenbrock.EXTENSION : rosenbrock.EXTENSION + 4]

    @property
    def tyre_load(self) -> np.ndarray:
        """Tyre loads (N, 4) [N]; 0 where a wheel has left the ground."""
        return self.signals[:, rosenbrock.LOAD : rosenbrock.LOAD + 4]

    @property
    def twist(self) -> np.ndarray:
        """Twist of the frame (N, 3): angle [rad], rate and acceleration; nothing of a stiff one."""
        return self.signals[:, rosenbrock.TWIST :]

    def body_acceleration(self, x: float, y: float) -> np.ndarray:
        """Vertical acceleration (N,) [m/s²] of the body's point at (x, y) [m].

        The halves of a flexible frame meet at the centre of mass.
        """
        a = self.acceleration
        found = a[:, Z_B] - x * a[:, THETA] + y * a[:, PHI]
        if self.twist.shape[1] > 0:
            found += 0.5 * np.sign(x) * y * self.twist[:, 2]
        return found


class Drive:
    """One vehicle on its way over a surface; plain NumPy state, so copies and pickles work.

    `speed` is a number [m/s] or a SpeedProfile; `step` [s] is the integrator's. A `manoeuvre`, and
    the acceleration of a speed profile, lean the body if `plant` was made for manoeuvres. Raises
    ConfigError on a speed or step that is not positive, and on a surface shorter than the
    wheelbase.
    """

    def __init__(
        self,
        plant: Plant,
        car: VehicleParameters,
        surface: Surface,
        speed: float | SpeedProfile,
        mode: str | Mapping[str, str] = "ride",
        step: float = 0.001,
        manoeuvre: Manoeuvre | None = None,
    ):
        if not isinstance(speed, SpeedProfile):
            if not (np.isfinite(speed) and speed > 0):
                raise ConfigError(f"the speed must be positive, got {speed} m/s")
            speed = constant(speed)
        if not 0 < step <= 0.01:
            raise ConfigError(f"the integrator's step must be within (0, 0.01] s, got {step} s")
        if surface.length < car.wheelbase:
            raise ConfigError(
                f"{surface.name}: {surface.length:.2f} m of road is shorter than the wheelbase "
                f"of {car.wheelbase:.3f} m"
            )
        self.plant, self.car, self.surface = plant, car, surface
        self.profile, self.manoeuvre, self.step = speed, manoeuvre, float(step)
        byte = command(mode)
        self.steps = 0
        self.start = -RUN_UP
        self.finish = surface.end + car.wheelbase + RUN_UP
        self._total = int(np.ceil(speed.arrival(self.finish - self.start) / step))
        self.memory = memory_at_rest(byte)
        self.state = self._at_rest()
        self.pipe = np.full(round(car.valve.delay / step), byte, dtype=np.uint8)

    def _at_rest(self) -> np.ndarray:
        if self.car.tyre_static_deflection != "equilibrium":
            # the paper's start, some millimetres off equilibrium
            return np.zeros(2 * self.plant.inertias.size)
        s = self.start - np.array([0.0, 0.0, self.car.wheelbase, self.car.wheelbase])
        heights = self.surface.height(s)[[0, 1, 0, 1], range(4)]
        return equilibrium(self.plant, self.memory, heights)

    @property
    def t(self) -> float:
        """Time since the start [s]."""
        return self.steps * self.step

    @property
    def speed(self) -> float:
        """Speed now [m/s]."""
        return float(self.profile.at(np.array([self.t]))[1][0])

    @property
    def station(self) -> float:
        """Station of the front axle [m]."""
        return self.start + float(self.profile.at(np.array([self.t]))[0][0])

    @property
    def steps_left(self) -> int:
        """Steps until the drive is over."""
        return max(self._total - self.steps, 0)

    @property
    def over(self) -> bool:
        """Whether the rear axle has left the surface and its apron."""
        return self.steps_left == 0

    def arriving(self, commands: np.ndarray) -> np.ndarray:
        """The command bytes (n,) that reach the valves while `commands` (n,) are given."""
        given = np.concatenate([self.pipe, commands])
        self.pipe = given[commands.size :]
        return given[: commands.size]

    def course(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stations [m], speeds [m/s] (2 n + 1,) and a_x, a_y [m/s²] (2 n + 1, 2) of the next `n`
        steps, at every half step.
        """
        instants = half_steps(self.step, self.steps, n)
        distance, v, a_x = self.profile.at(instants)
        turn = np.zeros((v.size, 2)) if self.manoeuvre is None else self.manoeuvre.at(instants)
        turn[:, 0] += a_x
        return self.start + distance, v, turn

    def advance(self, commands: np.ndarray) -> Trajectory:
        """Take one step per command byte (n,); returns the signals at the steps' beginnings.

        Raises SimulationError if the motion is no longer finite.
        """
        commands = np.asarray(commands, dtype=np.uint8)
        n = commands.size
        s, v, turn = self.course(n)
        signals = np.empty((n, rosenbrock.signals_of(self.plant)))
        road = (self.surface.padded, self.surface.start, self.surface.ds, s, v, turn)
        valve = (self.arriving(commands), self.car.valve.lag, self.step, signals)
        more = (
            (True,) if self.plant.flexible else ()
        )  # a flexible car's kernel is compiled when one comes
        rosenbrock.drive(*self.plant.arrays, self.memory, self.state, *road, *valve, *more)
        t = self.step * (self.steps + np.arange(n))
        self.steps += n
        if not np.isfinite(self.state).all():
            whole = int(np.isfinite(signals).all(axis=1).sum())
            raise SimulationError(
                f"{self.surface.name}: the motion is no longer finite at t = "
                f"{self.step * (self.steps - n + whole):.3f} s"
            )
        return Trajectory(t, s[:-1:2], v[:-1:2], commands, signals)


def half_steps(step: float, done: int, n: int) -> np.ndarray:
    """The instants (2 n + 1,) [s] of `n` steps after `done` ones, with those half-way between."""
    return 0.5 * step * (2 * done + np.arange(2 * n + 1))


def simulate(
    car: VehicleParameters,
    surface: Surface,
    speed: float | SpeedProfile,
    mode: str | Mapping[str, str] = "ride",
    step: float = 0.001,
    manoeuvre: Manoeuvre | None = None,
) -> Trajectory:
    """Drive `car` over the whole `surface` in one 4S4 mode, at a `speed` [m/s] or speed profile.

    Without a `manoeuvre` nothing leans the body, not even a change of speed, as in the paper.
    Raises ConfigError on bad input, SimulationError if the motion is no longer finite.
    """
    kernels = plant(car, manoeuvres=manoeuvre is not None)
    drive = Drive(kernels, car, surface, speed, mode, step, manoeuvre)
    return drive.advance(np.full(drive.steps_left, command(mode), dtype=np.uint8))
