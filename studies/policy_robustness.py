"""What switching policies keep on other cars: S0 to S3, with side motion, and in MuJoCo.

    python -m studies.policy_robustness [POLICY ...]

Every policy knows the described car and drives public drives of `RoadRecon/Safe4S4-v1`: all on each
grade of the individual car and on a car whose tyres hold it sideways; two, with the described car
and without braking, in MuJoCo too, where the car is built of other equations and the law of the
4S4 struts is handed over.
"""

import argparse
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from leaderboard.policies.comparison import PUBLIC_DRIVES, interval
from road_envs.analysis.comfort import wk_sos
from road_envs.envs.failures import MAX_ANGLE
from road_envs.envs.options import EpisodeStart
from road_envs.envs.safe4s4 import Safe4S4Setup
from road_envs.envs.safety_step import GRACE, SEAT
from road_envs.kernels._numba import kernel
from road_envs.plants.mujoco_car import STEP, MujocoCar
from road_envs.policies import make_policy
from road_envs.policies.api import Policy, PolicyContext
from road_envs.policies.rollout import POLICY_SEED, VIOLATION_PRICE, Drives, drive_all
from road_envs.sensing.instruments import SensorLocation
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.parameters import GRAVITY, VehicleParameters, load_vehicle
from road_envs.vehicle.suspension import (
    advance_valve,
    decode_commands,
    settled_strut_state,
    strut_force,
)

POLICIES = ("rrms", "rrms_lateral", "learned", "mpc")
REFERENCE = "rrms"
GRADES = ("S0", "S1", "S2", "S3")

SIDE_SOURCE = "defender_110_coils"
"""Vehicle file with the side motion of this car's sister."""

PLANT_DRIVES = 2
"""Drives in MuJoCo, to one side only."""

DESCRIBED: dict[str, Any] = {"grade": "S0", "payload": 0.0, "gentle": "slalom"}
"""Fields of the drives in MuJoCo: the described car, and no braking."""

H = 1e-3
"""Step [s] of valves, instruments and scores in MuJoCo."""


class Score(NamedTuple):
    """Score [m²/s⁴] and whether a drive violated (N,), of `Rollout`."""

    score: np.ndarray
    violated: np.ndarray


class SidewaysSetup(Safe4S4Setup):
    """The benchmark with a car whose tyres hold it sideways."""

    def __init__(self, options: dict[str, Any]):
        super().__init__(options)
        self.car = replace(self.car, side=load_vehicle(SIDE_SOURCE).side)
        self.plant = build_plant(self.car, manoeuvres=True)


def public(number: int, setup: type[Safe4S4Setup] = Safe4S4Setup, **fixed: Any) -> Drives:
    """Return public drives as the comparison has them, but for the `fixed` fields.

    Those of DESCRIBED are not mirrored.
    """
    groups = [{"group": ("known", "unseen")[k % 2]} | fixed for k in range(number)]
    make = Drives if fixed == DESCRIBED else Drives.mirrored
    return make(setup({"split": "test"}), range(number), groups)


@kernel(inline=False)
def _forces(vehicle, e, e_dot, forces):
    for w in range(4):
        forces[w] = strut_force(vehicle, w, e[w], e_dot[w])[0]


@kernel(inline=False)
def _advance_valves(p, strut_state, e, stiff, high, alpha):
    for w in range(4):
        advance_valve(p, strut_state, w, e[w], (stiff[w], high[w]), alpha, H)


class SwitchedStruts:
    """The 4S4 law, which is handed over to a plant: forces of extensions and rates, and valves."""

    def __init__(self, car: VehicleParameters, byte: int):
        self.vehicle = build_plant(car).buffers(settled_strut_state(byte))
        self.delayed = deque([byte] * round(car.valve.delay / H))
        self.alpha, self.forces = 1.0 - np.exp(-H / car.valve.lag), np.zeros(4)

    def __call__(self, e: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """Return the forces (4,) [N] at extensions (4,) [m] and their rates [m/s]."""
        _forces(self.vehicle, e, e_dot, self.forces)
        return self.forces

    def advance(self, byte: int, e: np.ndarray) -> None:
        """Command `byte`, and advance the valves by H."""
        self.delayed.append(byte)
        (stiff,), (high,) = decode_commands(np.array([self.delayed.popleft()]))
        p, strut_state = self.vehicle.constants[0], self.vehicle.strut_state
        _advance_valves(p, strut_state, e, stiff, high, self.alpha)


class PlantDrive:
    """A drive of the benchmark in MuJoCo, with its road, speed, side acceleration and instruments.

    The plant's frame moves with the car; the side acceleration acts as a part of gravity, which
    the tyres must hold.
    """

    def __init__(self, start: EpisodeStart, setup: Safe4S4Setup):
        self.setup, car, drive = setup, start.drive.car, start.drive
        self.struts = SwitchedStruts(car, start.command_byte)
        seats = [SensorLocation(SEAT[0], y) for y in (SEAT[1], -SEAT[1])]
        self.plant = MujocoCar(car, [*start.logger.locations, *seats], self.struts)
        self.logger, self.n = start.logger, drive.steps_left
        s, self.speed, a_xy = drive.half_step_inputs(self.n)
        self.a_y = a_xy[::2, 1]
        # stations of the four wheels at every step of the plant
        stations = np.interp(
            np.arange(self.n * round(H / STEP)) * STEP, 0.5 * H * np.arange(s.size), s
        )
        behind = car.wheelbase * (np.arange(4) // 2)
        self.z, self.slope = (
            np.stack([of(stations - b)[w % 2] for w, b in enumerate(behind)], axis=1)
            for of in (drive.surface.height, drive.surface.slope)
        )
        for _ in range(round(1.0 / STEP)):  # to rest
            self.plant.step(self.z[0], np.zeros(4), 0.0)
        self.stops, self.done = car.free_travel, 0
        self.seats = np.zeros((self.n, 2))
        self.off, self.cost, self.failed = np.zeros(2), 0.0, False

    @property
    def running(self) -> bool:
        """Whether the car has not rolled over and a whole interval is left."""
        return not self.failed and self.done + round(self.setup.interval / H) <= self.n

    def advance(self, byte: int) -> np.ndarray:
        """Drive an interval under the command `byte`; return the observation (d,)."""
        plant, steps, ratio = self.plant, round(self.setup.interval / H), round(H / STEP)
        sensors, planar = len(self.logger.locations), np.zeros(2)
        measured = np.zeros((sensors, steps))
        for k in range(steps):
            i = self.done + k
            v, a_y = self.speed[2 * i], self.a_y[i]
            plant.model.opt.gravity[1] = -a_y
            for j in range(i * ratio, (i + 1) * ratio):
                plant.step(self.z[j], v * self.slope[j], v)
            e = plant.extension
            self.struts.advance(byte, e)
            vertical = plant.data.sensordata[12:][2::3] - GRAVITY
            measured[:, k], self.seats[i] = vertical[:sensors], vertical[sensors:]
            pitch, roll = plant.data.qpos[3:5]
            self.failed |= bool(max(abs(pitch), abs(roll)) > MAX_ANGLE)
            planar += np.array([-GRAVITY * pitch, a_y + GRAVITY * roll]) / steps
            sides = plant.tyre_load.reshape(2, 2).sum(axis=0)
            self.off = np.where(sides <= 0.0, self.off + H, 0.0)
            stopped = ((e < self.stops[:, 0]) | (e > self.stops[:, 1])).any()
            self.cost += H * bool(stopped or self.off.max() > GRACE + 0.5 * H)
        self.done += steps
        (stiff,), (high,) = decode_commands(np.array([byte]))
        speed = self.logger.speed_gain * self.speed[2 * self.done]
        states = stiff[0], high[0], stiff[2], high[2]
        rates = plant.data.ten_velocity[:4]
        parts = self.logger.digitise(measured).ravel(), [speed], states, planar, e, rates
        return np.concatenate(parts).astype(np.float32)


def drive_plant(policy: Policy, drives: Drives) -> Score:
    """Return the scores of a policy on `drives` in MuJoCo."""
    setup: Any = drives.setup
    cars = [PlantDrive(start, setup) for start in drives.starts]
    policy.reset(PolicyContext.from_setup(setup, len(cars), POLICY_SEED))
    first = [start.command_byte for start in drives.starts]
    rows = np.array([car.advance(byte) for car, byte in zip(cars, first, strict=True)])
    begin = cars[0].done
    while any(car.running for car in cars):
        actions = policy.act(rows)
        for k, car in enumerate(cars):
            if car.running:
                rows[k] = car.advance(int(setup.command_bytes[actions[k]]))
    duration = H * np.array([car.done - begin for car in cars])
    failed, sos = np.array([car.failed for car in cars]), wk_sos(1.0 / H)
    share = np.where(failed, 1.0, np.array([car.cost for car in cars]) / duration)
    squares = [
        np.square(scipy.signal.sosfilt(sos, car.seats[: car.done], axis=0)[begin:]).sum()
        for car in cars
    ]
    comfort = 0.5 * H * np.array(squares) / duration
    return Score(-comfort - VIOLATION_PRICE * share, share > 0.0)


def table_lines(title: str, results: dict[str, Score]) -> list[str]:
    """Return the lines of one car: score, difference from the reference, violations.

    Of a few drives, the score of each stands in place of the difference.
    """
    base, few = results[REFERENCE].score, results[REFERENCE].score.size <= PLANT_DRIVES
    families = np.arange(base.size) // 2 % 2  # known and unseen drives in turn, each twice
    lines = [f"{title:32s}score  {'of each drive' if few else f'more than {REFERENCE}':28s}viol."]
    for name, found in results.items():
        more = interval(found.score - base, families, mirrored=not few)
        middle = f"{more['mean']:+.3f} ({more['low']:+.3f} to {more['high']:+.3f})"
        if few:
            middle = ", ".join(f"{score:.3f}" for score in found.score)
        mean, share = found.score.mean(), found.violated.mean()
        lines.append(f"  {name:28s}{mean:7.3f}  {middle:28s}{share:5.0%}")
    return lines


def cars() -> dict[str, Drives]:
    """Return the drives by the car that drives them."""
    every = PUBLIC_DRIVES
    return {
        **{f"all drives, {grade}": public(every, grade=grade) for grade in GRADES},
        "all drives, with side motion": public(every, SidewaysSetup),
        "two drives, described car": public(PLANT_DRIVES, **DESCRIBED),
        "two drives, with side motion": public(PLANT_DRIVES, SidewaysSetup, **DESCRIBED),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Switching policies on other cars.")
    parser.add_argument("policies", nargs="*", default=POLICIES, help="names or files")
    names = dict.fromkeys([REFERENCE, *parser.parse_args(arguments).policies])
    policies = {name: make_policy(name) for name in names}
    for title, drives in cars().items():
        found = {}
        for name, policy in policies.items():
            rollout = drive_all(policy, drives)
            found[name] = Score(rollout.score, rollout.violated)
        print("\n".join(table_lines(title, found)))
    drives = public(PLANT_DRIVES, **DESCRIBED)
    found = {}
    for name, policy in policies.items():
        found[name] = drive_plant(policy, drives)
        drives = public(PLANT_DRIVES, **DESCRIBED)  # loggers begin anew
    print("\n".join(table_lines("two drives, in MuJoCo", found)))


if __name__ == "__main__":
    main()
