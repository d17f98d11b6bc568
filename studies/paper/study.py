"""The eight case scenarios of Ngwangwa et al., each with many trainings of the paper's network.

Training k of every scenario forms session k, since the paper shows the four networks of the paving
as they came out of one training session. Four naive baselines use no measurement: an
`unrelated_road` of the training road's roughness, the `mean` of the training roads, the `constant`
mean height of these, and their `memory`, moved back by the delay of the copies. The test road is
driven by the field car, in place of the paper's measurements, and by the nominal car of the
training, which shows the effect of the other car. For the new roads, the network is trained on
other roads of the same kinds and tested on unseen ones.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

import estimators
from estimators.api import Estimator
from leaderboard.entries.entry import LocalSession, reconstruct_all
from leaderboard.evaluation.tasks import Condition, Task, load_task, shipped_tasks
from leaderboard.evaluation.test_data import DriveSimulation, RecordedDrive, simulate_drives
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.baselines import memory
from leaderboard.metrics.bootstrap import interquartile_mean
from leaderboard.metrics.level import EQ_12_RAW, STATE_LIMITS
from leaderboard.metrics.obstacles import MATCH_DISTANCE, detect_obstacles, true_obstacles
from leaderboard.metrics.registry import compute_scores
from road_envs.records.record import Estimate, Profile, Record

PAPER_NETWORK = "static_lm"
NAIVE_ESTIMATORS = ("unrelated_road", "mean")
NEW_ROAD_SEEDS = (1, 2, 3, 4, 5)
NEW_ROADS = 6
"""Number of unseen roads of each condition, of the families that the network was trained on."""

TrainingState = Literal["near-optimal", "sub-optimal", "unstable"]
TRAINING_STATES: tuple[TrainingState, ...] = ("near-optimal", "sub-optimal", "unstable")

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class PaperTraining:
    """One training and its estimate of the test road: scores, and heights `z` (2, M) [m].

    `nominal` and `nominal_z` are those on the drive of the car of the training.
    """

    seed: int
    scores: dict[str, float]
    z: np.ndarray
    nominal: dict[str, float]
    nominal_z: np.ndarray
    train_seconds: float
    estimate_seconds: float

    @property
    def state(self) -> TrainingState:
        """Near-optimal, sub-optimal or unstable, by equation 12 as printed."""
        return training_state(self.scores[EQ_12_RAW])


@dataclass(frozen=True, eq=False)
class PaperScenario:
    """A scenario: its truth, its trainings, and the scores of the naive baselines."""

    task: Task
    truth: Profile
    trainings: tuple[PaperTraining, ...]
    baselines: dict[str, tuple[dict[str, float], ...]]
    drive_seconds: float  # of all its drives, simulated

    @property
    def number(self) -> int:
        """Number of the scenario, 1 to 8."""
        return int(self.task.name.rpartition("_")[2])

    @property
    def condition(self) -> str:
        """Mode, speed and car, such as "ride, 14.5 km/h, car S3"."""
        return self.task.conditions[0].label

    @property
    def drive_label(self) -> str:
        """Mode and speed, without the car."""
        return ", ".join(self.condition.split(", ")[:2])

    @property
    def speed(self) -> float:
        """Speed [m/s]."""
        return self.task.conditions[0].speed_kmh / 3.6

    @property
    def is_paving(self) -> bool:
        """True on Belgian paving, False over bumps."""
        return not self.task.bumps

    def score_values(self, score: str, nominal: bool = False) -> np.ndarray:
        """Return a score (N,) of every training, on the field car or the car of the training."""
        by_run = [t.nominal if nominal else t.scores for t in self.trainings]
        return np.array([scores.get(score, np.nan) for scores in by_run])

    def iq_mean(self, score: str, nominal: bool = False) -> float:
        """Return the interquartile mean of a score over the trainings; NaN if none has it."""
        x = self.score_values(score, nominal)
        x = x[np.isfinite(x)]
        return float(interquartile_mean(x)) if x.size else np.nan

    def baseline_median(self, name: str, score: str) -> float:
        """Return the median of a score of a naive baseline."""
        return float(np.median([scores[score] for scores in self.baselines[name]]))

    def false_bump_offset(self) -> float:
        """Return the median offset [m] of false bumps from the nearest true one; NaN for none."""
        y, ds = self.truth.z, self.truth.ds
        true = [bump for path in true_obstacles(y, ds) for bump in path]
        threshold = min(abs(bump.height) for bump in true) / 2
        found = [b for t in self.trainings for z in t.z for b in detect_obstacles(z, ds, threshold)]
        gaps = [min((b.s - bump.s for bump in true), key=abs) for b in found if b.height > 0]
        return float(np.median([gap for gap in gaps if abs(gap) > MATCH_DISTANCE] or [np.nan]))

    def state_shares(self) -> dict[TrainingState, float]:
        """Return the share of trainings in each state."""
        states = [training.state for training in self.trainings]
        return {kind: states.count(kind) / len(states) for kind in TRAINING_STATES}

    def median_run(self) -> PaperTraining:
        """Return the training with the median NRMSE."""
        return sorted(self.trainings, key=lambda t: t.scores["nrmse"])[
            (len(self.trainings) - 1) // 2
        ]


def iq_means(scenarios: Sequence[PaperScenario], score: str) -> list[list[float]]:
    """Return the interquartile means by scenario: on the field car, and on that of the training."""
    return [[each.iq_mean(score, nominal) for each in scenarios] for nominal in (False, True)]


@dataclass(frozen=True, eq=False)
class Study:
    """All scenarios; `new_road` has the network's scores on unseen roads, by condition."""

    scenarios: tuple[PaperScenario, ...]
    new_road: dict[str, dict[str, float]]
    seconds: float

    @property
    def paving(self) -> list[PaperScenario]:
        """The scenarios on Belgian paving, in the order of the panels of Figures 10 and 11."""
        found = {
            scenario.drive_label: scenario for scenario in self.scenarios if scenario.is_paving
        }
        order = ("handling, 14.5 km/h", "ride, 14.5 km/h", "ride, 54 km/h", "handling, 54 km/h")
        return [found[label] for label in order]

    @property
    def bumps(self) -> list[PaperScenario]:
        """The scenarios on bumps."""
        return [scenario for scenario in self.scenarios if not scenario.is_paving]

    def new_road_score(self, scenario: PaperScenario, score: str) -> float:
        """Return a score on new roads, in the mode and at the speed of a scenario."""
        return self.new_road[scenario.drive_label][score]


def run_study(
    trainings: int,
    *,
    network: Estimator | None = None,
    drive: DriveSimulation = simulate_drives,
    progress: Progress = lambda text, share: None,
) -> Study:
    """Simulate, train and score everything, with the network of the paper by default.

    Raises ConfigError, SimulationError, EntryError.
    """
    start, network = time.perf_counter(), network or estimators.create(PAPER_NETWORK)
    tasks = shipped_tasks("paper")
    scenarios = []
    for k, task in enumerate(tasks):
        progress(f"{task.name}: {task.title}", 0.8 * k / len(tasks))
        scenarios.append(_run_scenario(task, network, range(1, trainings + 1), drive))
    progress("new roads", 0.8)
    return Study(
        tuple(scenarios), _score_new_roads(scenarios, network, drive), time.perf_counter() - start
    )


def training_state(level_error: float) -> TrainingState:
    """Return the state of a training by its level error [-]."""
    near, sub = STATE_LIMITS
    return (
        "near-optimal" if level_error < near else "sub-optimal" if level_error < sub else "unstable"
    )


def _run_scenario(
    task: Task, network: Estimator, seeds: Sequence[int], drive: DriveSimulation
) -> PaperScenario:
    (condition,) = task.conditions
    start = time.perf_counter()
    training = [(d.record, d.truth) for d in drive(task, task.training, condition)]
    (test,) = drive(task, task.test, condition)
    drive_seconds = time.perf_counter() - start
    own = replace(task, conditions=(replace(condition, grade="S0"),))
    (nominal,) = drive(own, task.test, own.conditions[0])

    def trained(estimator: Estimator, seed: int) -> PaperTraining:
        return _train_and_score(estimator, task, training, [test, nominal], seed)

    mean_height = np.mean([truth.z.mean(axis=1) for _, truth in training], axis=0)
    constant = Estimate(test.truth.s, np.broadcast_to(mean_height[:, None], test.truth.z.shape))
    baselines = {
        name: tuple(
            trained(estimators.create(name), seed).scores
            # only the unrelated road depends on the seed
            for seed in (seeds if name == "unrelated_road" else seeds[:1])
        )
        for name in NAIVE_ESTIMATORS
    }
    baselines["constant"] = (_scores(task, test, constant),)
    truths = [truth for _, truth in training]
    remembered = memory(truths, task.training_delays, test.truth.s)
    baselines["memory"] = (_scores(task, test, remembered),)
    trainings = tuple(trained(network, seed) for seed in seeds)
    return PaperScenario(task, test.truth, trainings, baselines, drive_seconds)


def _train_and_score(
    estimator: Estimator,
    task: Task,
    training: Sequence[tuple[Record, Profile]],
    tests: Sequence[RecordedDrive],
    seed: int,
) -> PaperTraining:
    session, records = LocalSession(estimator, task.vehicle), [t.record for t in tests]
    (outcome,) = reconstruct_all(session, training, records, [seed])
    found, nominal = (_scores(task, *pair) for pair in zip(tests, outcome.estimates, strict=True))
    z, nominal_z = (estimate.z for estimate in outcome.estimates)
    return PaperTraining(
        seed,
        found,
        z,
        nominal,
        nominal_z,
        outcome.train_seconds,
        outcome.estimate_seconds / len(tests),
    )


def _scores(task: Task, test: RecordedDrive, estimate: Estimate) -> dict[str, float]:
    speed = task.conditions[0].speed_kmh / 3.6
    return compute_scores(ScoredEstimate(test.truth, estimate, speed, bumps=task.bumps))


def _score_new_roads(
    scenarios: Sequence[PaperScenario], network: Estimator, drive: DriveSimulation
) -> dict[str, dict[str, float]]:
    """Return interquartile means of the network's scores on new roads, by condition."""
    task = load_task("new_road")
    families = len(task.training.roads)  # the first test roads are of the families of the training
    test = replace(
        task.test,
        roads=task.test.roads[:families],
        families=(),
        seeds=task.test.seeds[: NEW_ROADS // families],
        number=None,
        design=(),  # every road under every condition
    )
    task = replace(task, test=test)
    found: dict[str, dict[str, float]] = {}
    for condition in task.conditions:
        if condition.label in {scenario.drive_label for scenario in scenarios}:
            training = [(d.record, d.truth) for d in drive(task, task.training, condition)]
            tests = list(drive(task, task.test, condition))
            found[condition.label] = _new_road_scores(task, condition, network, training, tests)
    return found


def _new_road_scores(
    task: Task,
    condition: Condition,
    network: Estimator,
    training: Sequence[tuple[Record, Profile]],
    tests: Sequence[RecordedDrive],
) -> dict[str, float]:
    run_scores = []
    for seed in NEW_ROAD_SEEDS:
        records = [test.record for test in tests]
        session = LocalSession(network, task.vehicle)
        (outcome,) = reconstruct_all(session, training, records, [seed])
        for test, estimate in zip(tests, outcome.estimates, strict=True):
            scored = ScoredEstimate(test.truth, estimate, condition.speed_kmh / 3.6, bumps=False)
            run_scores.append(compute_scores(scored))
    return {
        name: float(interquartile_mean(np.array([scores[name] for scores in run_scores])))
        for name in ("nrmse", "r", "level_error", EQ_12_RAW)
    }
