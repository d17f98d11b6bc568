"""Simulation of one vehicle over a surface, step by step under changing commands or as a whole.

`DriveSimulator` advances step by step; `simulate` runs one to its end. A drive begins with the
front axle APRON_LENGTH metres before station 0, at rest on a level apron in the commanded mode. It
is finished when the rear axle has passed the end of the surface by the same distance.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.roads.surface import Surface, enveloped
from road_envs.simulation import rosenbrock
from road_envs.simulation.manoeuvres import Manoeuvre
from road_envs.simulation.speed import SpeedProfile
from road_envs.vehicle.equations import AXLE, N_DOF, PHI, THETA, Z_B, Plant, build_plant
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.parameters import DEFAULT_STEP, STEP_LIMIT, VehicleParameters
from road_envs.vehicle.suspension import encode_command, settled_strut_state

APRON_LENGTH = 5.0  # length [m] of the level apron before and after the surface


class SimulationError(ArithmeticError):
    """The motion diverged, or no step of an adaptive integrator meets its tolerance."""


@dataclass(frozen=True)
class Trajectory:
    """Motion of the vehicle at N times.

    `t` [s], `s` station of the front axle [m], `v` speed [m/s], `commands` bytes before their
    delay, all (N,); `signals` (N, 29), or (N, 32) of a flexible vehicle, laid out as in
    `rosenbrock`.
    """

    t: np.ndarray
    s: np.ndarray
    v: np.ndarray
    commands: np.ndarray
    signals: np.ndarray

    @property
    def state(self) -> np.ndarray:
        """Coordinates and rates (N, 14), as in `equations`, but for twist and side motion."""
        return self.signals[:, : 2 * N_DOF]

    @property
    def acceleration(self) -> np.ndarray:
        """Accelerations (N, 7) of the degrees of freedom."""
        return self.signals[:, rosenbrock.ACCELERATION : rosenbrock.ACCELERATION + N_DOF]

    @property
    def extension(self) -> np.ndarray:
        """Strut extensions (N, 4) [m] from the static length, i.e. the rattle space used."""
        return self.signals[:, rosenbrock.EXTENSION : rosenbrock.EXTENSION + 4]

    @property
    def tyre_load(self) -> np.ndarray:
        """Tyre loads (N, 4) [N]; 0 where a wheel has left the ground."""
        return self.signals[:, rosenbrock.LOAD : rosenbrock.LOAD + 4]

    @property
    def twist(self) -> np.ndarray:
        """Twist of the frame (N, 3): angle [rad], rate and acceleration; (N, 0) if it is rigid."""
        return self.signals[:, rosenbrock.TWIST : rosenbrock.N_FLEXIBLE_SIGNALS]

    def vertical_acceleration(self, x: float, y: float, axle: int | None = None) -> np.ndarray:
        """Return the vertical acceleration (N,) [m/s²] of a point at (x, y) [m].

        It belongs to the body, or to the front (0) or rear (1) `axle`. The two halves of a flexible
        frame meet at the centre of mass, x = 0.
        """
        a = self.acceleration
        if axle is not None:
            return a[:, AXLE + 2 * axle] + y * a[:, AXLE + 2 * axle + 1]
        a_point = a[:, Z_B] - x * a[:, THETA] + y * a[:, PHI]
        if self.twist.shape[1] > 0:
            a_point += 0.5 * np.sign(x) * y * self.twist[:, 2]
        return a_point


class DriveInputs(NamedTuple):
    """Inputs of N steps of `h` [s], of one vehicle or with LANES vehicles on the last axis.

    At every half step: `s`, `v` (2 N + 1,), station [m] and speed [m/s] of the front axle; `a_xy`
    (4 N + 2,), a_x and a_y [m/s²] of a manoeuvre in turn. `commands` (N,): bytes as they reach the
    valves.
    """

    s: np.ndarray
    v: np.ndarray
    a_xy: np.ndarray
    commands: np.ndarray
    h: float


class DriveSimulator:
    """Simulator of one drive over a surface; its state is plain NumPy, so copies and pickles work.

    `mode` is one of the car's, by default its first. `speed` is a number [m/s] or a SpeedProfile;
    `step` [s] is the integrator's. A `manoeuvre` and the acceleration of a speed profile act on the
    body if `plant` was built for manoeuvres. Raises ConfigError on a mode, speed or step out of
    range, on a surface shorter than the wheelbase, and on one with a step that no wheel can climb.
    """

    def __init__(
        self,
        plant: Plant,
        car: VehicleParameters,
        surface: Surface,
        speed: float | SpeedProfile,
        mode: str | Mapping[str, str] | None = None,
        step: float = DEFAULT_STEP,
        manoeuvre: Manoeuvre | None = None,
    ):
        if not isinstance(speed, SpeedProfile):
            if not (np.isfinite(speed) and speed > 0):
                raise ConfigError(f"speed must be positive and finite, got {speed} m/s")
            speed = SpeedProfile(t=(0.0,), v=(float(speed),))
        if not 0 < step <= STEP_LIMIT:
            raise ConfigError(
                f"the integrator step must be within (0, {STEP_LIMIT:g}] s, got {step} s"
            )
        if surface.length < car.wheelbase:
            raise ConfigError(
                f"{surface.name}: {surface.length:.2f} m of road is shorter than the wheelbase "
                f"of {car.wheelbase:.3f} m"
            )
        if (contact := car.variation.contact_length) > 0.0:
            surface = enveloped(surface, contact)
        surface.check_climbable()
        self.plant, self.car, self.surface = plant, car, surface
        self.speed_profile, self.manoeuvre, self.step = speed, manoeuvre, float(step)
        byte = encode_command(mode, car)
        self.steps = 0
        self.start = -APRON_LENGTH
        self.end = surface.end + car.wheelbase + APRON_LENGTH
        self._total = int(np.ceil(speed.arrival_time(self.end - self.start) / step))
        self.strut_state = settled_strut_state(byte)
        self.state = self._at_rest()
        self._vehicle = plant.buffers(self.strut_state)
        # commands that have not reached the valves yet, one per step of delay
        self.delay_line = np.full(round(car.valve.delay / step), byte, dtype=np.uint8)

    def _at_rest(self) -> np.ndarray:
        if self.car.tyre_static_deflection != "equilibrium":
            # the paper starts there, some millimetres off equilibrium
            return np.zeros(2 * self.plant.n_dof)
        # stations and heights in the order of wheels FL, FR, RL, RR
        s = self.start - np.array([0.0, 0.0, self.car.wheelbase, self.car.wheelbase])
        heights = self.surface.height(s)[[0, 1, 0, 1], range(4)]
        try:
            return equilibrium(self.plant, self.strut_state, heights)
        except ArithmeticError as error:
            reason = f"{error}; check its masses, gas springs and force curves"
            raise SimulationError(f"{self.car.name}: {reason}") from None

    @property
    def t(self) -> float:
        """Time [s] since the start."""
        return self.steps * self.step

    @property
    def speed(self) -> float:
        """Current speed [m/s]."""
        return float(self.speed_profile.at(np.array([self.t]))[1][0])

    @property
    def station(self) -> float:
        """Current station [m] of the front axle."""
        return self.start + float(self.speed_profile.at(np.array([self.t]))[0][0])

    @property
    def steps_left(self) -> int:
        """Number of steps until the rear axle has left the surface and its apron."""
        return max(self._total - self.steps, 0)

    def limit_duration(self, duration: float) -> None:
        """End the drive after `duration` [s], if it is not at the end of its road before."""
        self._total = min(self._total, round(duration / self.step))

    def delayed_commands(self, commands: np.ndarray) -> np.ndarray:
        """Return the bytes (n,) that reach the valves in n steps; queue `commands` (n,)."""
        sent = np.concatenate([self.delay_line, commands])
        self.delay_line = sent[commands.size :]
        return sent[: commands.size]

    def half_step_inputs(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return stations [m], speeds [m/s], (a_x, a_y) [m/s²] at half steps of the next `n`."""
        instants = 0.5 * self.step * (2 * self.steps + np.arange(2 * n + 1))
        distance, v, a_x = self.speed_profile.at(instants)
        a_xy = np.zeros((v.size, 2)) if self.manoeuvre is None else self.manoeuvre.at(instants)
        if not self.speed_profile.is_constant:
            a_xy[:, 0] += a_x
        return self.start + distance, v, a_xy

    def advance(self, commands: np.ndarray) -> Trajectory:
        """Take one step per command byte (n,) and return the motion at the steps' beginnings.

        Raises SimulationError if the motion diverges.
        """
        commands = np.asarray(commands, dtype=np.uint8)
        n = commands.size
        s, v, a_xy = self.half_step_inputs(n)
        signals = np.zeros((n, rosenbrock.n_signals(self.plant)))
        delayed = self.delayed_commands(commands)
        inputs = DriveInputs(s, v, a_xy.ravel(), delayed, self.step)
        road, lag, flags = self.surface.buffers, self.car.valve.lag, self.plant.kernel_flags
        rosenbrock.integrate(self._vehicle, self.state, road, inputs, lag, signals, *flags)
        t = self.step * (self.steps + np.arange(n))
        self.steps += n
        if not np.isfinite(self.state).all():
            n_finite = int(np.isfinite(signals).all(axis=1).sum())
            raise SimulationError(
                f"{self.surface.name}: the motion is no longer finite at t = "
                f"{self.step * (self.steps - n + n_finite):.3f} s; check the vehicle and the step"
            )
        return Trajectory(t, s[:-1:2], v[:-1:2], commands, signals)


def simulate(
    car: VehicleParameters,
    surface: Surface,
    speed: float | SpeedProfile,
    mode: str | Mapping[str, str] | None = None,
    step: float = DEFAULT_STEP,
    manoeuvre: Manoeuvre | None = None,
) -> Trajectory:
    """Simulate `car` over the whole `surface` in one mode; arguments as of DriveSimulator.

    Without a `manoeuvre` no horizontal acceleration acts on the body, not even that of the speed
    profile, as in the paper. Raises ConfigError on bad input, SimulationError if the motion
    diverges.
    """
    plant = build_plant(car, manoeuvres=manoeuvre is not None)
    drive = DriveSimulator(plant, car, surface, speed, mode, step, manoeuvre)
    return drive.advance(np.full(drive.steps_left, encode_command(mode, car), dtype=np.uint8))
