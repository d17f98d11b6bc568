"""Numbers that a change of names or of layout must leave as they are, to the bit.

    python tests/golden.py --write FILE      compute them and keep them
    python tests/golden.py FILE              compute them again and compare

Bits differ between processors, library versions and numbers of threads (one is set here), so this
compares two states of the code on one machine; `tests/data/golden.json` holds what was computed
when the list was made.
"""

# ruff: noqa: E402
import hashlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

for library in ("OMP", "OPENBLAS", "MKL"):  # before they are loaded: a sum depends on its parts
    os.environ[f"{library}_NUM_THREADS"] = "1"

import gymnasium
import numpy as np
from fakes import task
from weighted import weighted_rms

import estimators
import road_envs  # noqa: F401  registers the environment
from leaderboard.evaluation.comparison import scores_by_run
from leaderboard.evaluation.evaluate import run_task
from leaderboard.evaluation.test_data import simulate_drives
from road_envs.analysis.information_bound import RoadPrior, bound
from road_envs.drives.recording import simulate_record
from road_envs.records.roughness import iri
from road_envs.roads import load_road
from road_envs.sensing.data_logger import load_instruments
from road_envs.sensing.perturbed_vehicle import perturb_vehicle
from road_envs.simulation.drive import DriveSimulator, simulate
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import encode_command
from studies.bench.adaptive_drive import simulate_adaptive
from studies.bench.fleet import Fleet, select_vehicle

MIXED = {"front": "ride", "rear": "handling"}
ROADS = ("iso_d", "belgian", "potholes", "random_bumps", "twist", "iso_c_varying", "sine_sweep")
ESTIMATORS = (
    "flat", "inverse_quarter_car", "fir_ridge", "map_smoother", "kalman",
    "kalman_lag", "kalman_rts", "tcn", "tcn_causal", "gru", "gru_causal", "wiener",
    "iterated_wiener",
)  # fmt: skip


def numbers() -> Iterator[tuple[str, np.ndarray]]:
    """Name and values of everything that is held."""
    car = load_vehicle("land_rover_defender_110")
    for name in ROADS:
        surface = load_road(name).realise(np.random.default_rng(7))
        yield f"surface {name}", surface.z
        drive = simulate(car, surface, 8.0, MIXED)
        yield f"drive {name}", drive.signals
        yield f"comfort {name}", np.array([weighted_rms(drive.signals[:, 0], 1000.0)])
        yield f"iri {name}", np.asarray(iri(surface.z, surface.ds))
    surface = load_road("iso_d").realise(np.random.default_rng(7))
    yield "adaptive", simulate_adaptive(car, surface, 15.0, "handling").trajectory.signals
    for grade in ("S0", "S1", "S2", "S3"):
        one = perturb_vehicle(car, grade, 3)
        drive = DriveSimulator(one.plant, one.car, surface, 15.0, "ride", min(1e-3, one.step))
        n = drive.steps_left
        yield f"field {grade}", drive.advance(np.full(n, encode_command("ride"), np.uint8)).signals
        record, truth = simulate_record(
            surface, vehicle=car, speed_kmh=14.5, mode="ride", seed=5, grade=grade
        )
        yield f"record {grade}", np.concatenate([record.a.ravel(), record.s, record.v])
        yield f"truth {grade}", truth.z
    drives = [DriveSimulator(build_plant(car), car, surface, 5.0 + k, MIXED) for k in range(5)]
    fleet = Fleet(drives)
    signals = fleet.advance(np.full((5, 2000), encode_command(MIXED), np.uint8))
    yield "fleet", np.stack([select_vehicle(signals, k) for k in range(5)])
    yield from _environments()
    record, _ = simulate_record(
        surface,
        vehicle=car,
        speed_kmh=36.0,
        mode="handling",
        instruments=load_instruments("paper"),
        seed=2,
    )
    for name in ESTIMATORS:
        found = estimators.create(name).estimate(record, car)
        yield f"estimate {name}", found.z
        if found.z_std is not None:
            yield f"deviation {name}", found.z_std
    paper = load_instruments("paper")
    yield (
        "bound",
        bound(car, MIXED, 15.0, paper, RoadPrior(), residual_as_noise=True).error.view(float),
    )
    yield from _rows()


def _environments() -> Iterator[tuple[str, np.ndarray]]:
    for control in ("vehicle", "axle", "states"):
        env = gymnasium.make("RoadRecon-v0", road="iso_d", control=control, speed_kmh=36.0)
        observation, _ = env.reset(seed=3)
        seen, rewards = [observation], []
        for k in range(40):
            observation, reward, terminated, truncated, _ = env.step(k % int(env.action_space.n))
            seen.append(observation)
            rewards.append(float(reward))
            if terminated or truncated:
                break
        yield f"observations {control}", np.array([np.asarray(x, dtype=float) for x in seen])
        yield f"rewards {control}", np.array(rewards)


def _rows() -> Iterator[tuple[str, np.ndarray]]:
    short = task(
        test={"roads": ["iso_d", "random_bumps"], "seeds": [11], "length": 60.0}, bumps=True
    )
    entries = {name: estimators.create(name) for name in ("flat", "static_lm", "fir_ridge", "narx")}
    for row in run_task(
        short, {**entries, "truth_plus_noise": None}, (1,), simulate=simulate_drives
    ):
        scores = [sorted(own.items()) for own in scores_by_run(row.scores).values()]
        yield f"row {row.estimator}", np.array([v for drive in scores for _, v in drive])


def digests() -> dict[str, str]:
    """Digest of the shape and bits of each array."""
    found = {}
    for name, values in numbers():
        array = np.ascontiguousarray(values, dtype=float)
        found[name] = hashlib.sha256(f"{array.shape}".encode() + array.tobytes()).hexdigest()[:24]
    return found


def main(arguments: list[str]) -> int:
    """Write the digests, or compare with those written; returns the exit status."""
    path = Path(arguments[-1])
    found = digests()
    if "--write" in arguments:
        path.write_text(json.dumps(found, indent=1) + "\n")
        print(f"{len(found)} arrays written to {path}")
        return 0
    known = json.loads(path.read_text())
    wrong = [name for name in known | found if known.get(name) != found.get(name)]
    print(f"{len(known) - len(wrong)} of {len(known)} arrays are the same to the bit")
    for name in wrong:
        print(f"  differs: {name}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
