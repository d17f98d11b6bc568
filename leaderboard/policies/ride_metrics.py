"""Ride metrics of a drive: comfort, suspension travel, tyre load, roll, switching.

Comfort is that of heave at the centre of mass (a seat elsewhere is also exposed to pitch and roll).
Bump-stop hits are counted for each strut, whenever it leaves the range without bump-stop force.
"""

import numpy as np

from leaderboard.metrics.api import Metric
from road_envs.analysis import comfort
from road_envs.simulation.drive import Trajectory
from road_envs.vehicle.equations import PHI, Z_B
from road_envs.vehicle.force_curves import zero_force_range
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import decode_commands

METRICS = {
    metric.key: metric
    for metric in (
        Metric(
            key="comfort", head="comfort", label="W_k-weighted RMS heave acceleration", unit="m/s²",
            help="RMS of the heave acceleration of the body, weighted by W_k of ISO 2631-1.",
        ),
        Metric(
            key="vdv", head="VDV", label="vibration dose value of heave", unit="m/s^1.75",
            help="Fourth-power dose of the W_k-weighted heave acceleration: shocks count most.",
        ),
        Metric(
            key="rattle", head="rattle",
            label="RMS strut extension", unit="mm", factor=1000.0, digits=1,
            help="RMS of the strut extensions from the static length, all four struts.",
        ),
        Metric(
            key="rattle_peak", label="largest strut extension", unit="mm", factor=1000.0, digits=0,
            help="Largest extension or compression of any strut.",
        ),
        Metric(
            key="stops_per_km", head="stops", label="bump-stop hits", unit="1/km", digits=0,
            help="How often a strut leaves the range without bump-stop force.",
        ),
        Metric(
            key="tyre_load", head="tyre load", label="dynamic tyre load coefficient", digits=3,
            help="RMS of the tyre load about the static one, relative to it: handling.",
        ),
        Metric(
            key="lift_per_km", label="time of wheels off the ground", unit="s/km",
            help="Time for which wheels have no load, summed over the wheels.",
        ),
        Metric(
            key="roll", label="RMS roll angle", unit="deg", factor=float(np.degrees(1.0)),
            help="RMS roll angle of the body.",
        ),
        Metric(
            key="roll_peak", head="roll", label="largest roll angle", unit="deg",
            factor=float(np.degrees(1.0)), digits=1, help="Largest roll angle of the body.",
        ),
        Metric(
            key="switches_per_km", head="switch",
            label="changes of the command", unit="1/km", digits=0,
            better="", help="How often the commanded states change, after the first command.",
        ),
        Metric(
            key="dwell", head="dwell", label="mean time between changes", unit="s", better="",
            help="Mean time for which the commanded states stay.",
        ),
        Metric(
            key="turned_over", label="drives that ended in a rollover",
            help="Share of drives that ended in a rollover.",
        ),
        Metric(
            key="return", head="return",
            label="return: sum of rewards, per second", unit="1/s", digits=3,
            better="high", help="Sum of the environment's rewards over a drive, per second.",
        ),
        Metric(
            key="bound", head="bound",
            label="bound on the in-band error for the states used", digits=3,
            help="Bound of a linear car without friction that spends in each pair of states the "
            "time that the policy did.",
        ),
    )
}  # fmt: skip
"""Metrics of a policy by key."""


def ride_metrics(
    motion: Trajectory, car: VehicleParameters, first_step: int = 0
) -> dict[str, float]:
    """Return those of METRICS that follow from a uniformly sampled motion, in SI units.

    Commands before `first_step` precede the first action of the policy and do not count as
    switches.
    """
    h = float(motion.t[1] - motion.t[0])
    # the last sample lasts one step as well
    km = (float(motion.s[-1] - motion.s[0]) + h * float(motion.v[-1])) / 1000.0
    heave, roll = motion.acceleration[:, Z_B], motion.state[:, PHI]
    static = np.repeat(car.tyre_loads, 2)  # per axle to per wheel
    changes = int(np.count_nonzero(np.diff(motion.commands[first_step:])))
    return {
        "comfort": float(comfort.weighted_rms(heave, 1.0 / h)),
        "vdv": float(comfort.vdv(heave, 1.0 / h)),
        "rattle": _rms(motion.extension),
        "rattle_peak": float(np.abs(motion.extension).max()),
        "stops_per_km": count_bump_stop_hits(motion.extension, car) / km,
        "tyre_load": _rms(motion.tyre_load / static - 1.0),
        "lift_per_km": h * int(np.count_nonzero(motion.tyre_load <= 0.0)) / km,
        "roll": _rms(roll),
        "roll_peak": float(np.abs(roll).max()),
        "switches_per_km": changes / km,
        "dwell": h * motion.t.size / (changes + 1),
    }


def count_bump_stop_hits(extension: np.ndarray, car: VehicleParameters) -> int:
    """Count how often a strut reaches a bump stop, from extensions (N, 4) [m]."""
    limits = np.array([zero_force_range(curve) for curve in car.bump_stops for _ in range(2)])
    hits = 0
    for beyond in (extension < limits[:, 0], extension > limits[:, 1]):
        # an excursion counts at its first sample only
        hits += int(beyond[0].sum() + np.count_nonzero(beyond[1:] & ~beyond[:-1]))
    return hits


def state_time_shares(commands: np.ndarray) -> dict[tuple[bool, ...], float]:
    """Return the share of time in each state of front and rear.

    Keys are (stiff, high) of the front left and of the rear left strut.
    """
    distinct, counts = np.unique(commands, return_counts=True)
    stiff, high = decode_commands(distinct)
    states = np.stack([stiff[:, 0], high[:, 0], stiff[:, 2], high[:, 2]], axis=1)
    total: dict[tuple[bool, ...], float] = {}
    for state, count in zip(states.tolist(), counts.tolist(), strict=True):
        total[tuple(state)] = total.get(tuple(state), 0.0) + count / len(commands)
    return total


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
