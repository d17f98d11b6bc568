"""What an estimator is that answers by a sequence network: `tcn`, `gru` and their causal twins.

It comes with weights that `roadrecon train NAME` makes from a corpus of simulated drives; `fit`
makes others from the drives it is given, without those. An estimator with other settings than the
shipped weights have, or with `shipped` false, has to be fitted before it can answer.
"""

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from estimators.api import arrays, copy_with, fitted
from estimators.common.spatial_signals import EDGE, SPACING, course, finer, wheel_paths
from estimators.linear.fir_bank import Bank, fitted_bank, shape_of, weighted
from estimators.networks.inputs import FLIP, Inputs, inputs, window
from estimators.networks.std_calibration import (
    TERMS,
    constant,
    fitted_widths,
    honest,
    inside,
    judged,
    widths,
)
from estimators.networks.trainer import (
    STD_LOG,
    Keeper,
    Lesson,
    Plan,
    divided,
    numbers,
    one_thread,
    put,
    teach,
)
from estimators.networks.training_data import MARGIN, SLOW, Material, limits, material
from estimators.preprocessing import mended
from estimators.pretrained_weights import shipped
from road_envs.config import STRICT
from road_envs.data.record import Estimate, Profile, Record, grid
from road_envs.vehicle.parameters import VehicleParameters

NETWORK = "network."
"""Stands before the name of a network's weight."""

WHEELBASE_OFF = 0.02
"""A wheelbase that differs by more than this share from the taught one is told."""


class Learnt(NamedTuple):
    """Linear windows, weights of the network (float16), the coefficients `widths` (TERMS,) of the
    factor on its standard deviations, and the `wheelbase` [m] of the car.
    """

    bank: Bank
    network: dict[str, np.ndarray]
    widths: np.ndarray
    wheelbase: float


@dataclass(frozen=True, kw_only=True)
class Taught(abc.ABC):
    """A sequence network behind a bank of linear windows."""

    __pydantic_config__ = STRICT
    name: ClassVar[str]
    causal: ClassVar[bool]
    lag: ClassVar[float | None] = None
    """How far past a station the front axle is when its height is told [m]; None: at the end."""

    shipped: bool = True
    steps: int = 2500
    learnt: Learnt | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        for setting in ("steps", "channels"):
            if getattr(self, setting) < 1:
                raise ValueError(f"{setting} must be at least 1, got {getattr(self, setting)}")

    @abc.abstractmethod
    def network(self) -> Any:
        """The torch network before it has learnt anything."""

    def material(self, record: Record, truth: Profile) -> Material:
        """What this estimator keeps of a drive to learn from. Raises RecordError."""
        return material(record, truth, self.causal)

    def fit(
        self,
        records: Sequence[Record],
        truths: Sequence[Profile],
        car: VehicleParameters,
        seed: int,
    ) -> Self:
        """A copy that has learnt from these drives and nothing else."""
        pairs = zip(records, truths, strict=True)
        return self.learn([self.material(*pair) for pair in pairs], car, seed)

    def learn(
        self,
        drives: Sequence[Material],
        car: VehicleParameters,
        seed: int,
        progress: Callable[[str, float], None] = lambda text, share: None,
        keeper: Keeper | None = None,
    ) -> Self:
        """A copy that has learnt from these drives; `seed` draws first weights and batches."""
        import torch

        progress("fitting linear windows", 0.0)
        courses, targets = zip(*drives, strict=True)
        bank = fitted_bank(courses, targets, *window(self.causal))
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = self.network()
        lessons = [self._lesson(drive, bank, car.wheelbase, network) for drive in drives]
        teach(network, lessons, Plan(self.steps), seed, progress, keeper)
        rounded = {name: x.astype(np.float16) for name, x in numbers(network).items()}
        put(network, rounded)
        _, held_out = divided(lessons)
        ratios = [self._ratios(part.lesson, network, part.start, part.stop) for part in held_out]
        width = constant(honest(np.concatenate(ratios)))
        return copy_with(self, learnt=Learnt(bank, rounded, width, car.wheelbase))

    def calibrated(self, drives: Sequence[Material]) -> Self:
        """A copy whose standard deviations are honest on these drives, which it was not taught."""
        learnt = self._learnt()
        network = self.network()
        put(network, learnt.network)
        ratios, conditions = [], []
        for drive in drives:
            read = inputs(drive.course, learnt.bank, learnt.wheelbase, network, self.causal)
            told, counts = _told(read, network), inside(read.level.size)
            missing, std = answer(network, read.x, read.conditions)
            error = wheel_paths(drive.target - read.first - read.level * missing)
            speed = float(np.median(drive.course.v))
            ratios.append((judged(error, speed) / (read.level * np.hypot(*std)))[:, counts])
            conditions.append(told if told.shape[1] == 1 else told[:, counts])
        return copy_with(self, learnt=learnt._replace(widths=fitted_widths(ratios, conditions)))

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Heights with their standard deviation above 0.15 cycles/m. Raises RecordError."""
        record, notes = mended(record)
        bank, weights, width, wheelbase = self._learnt()
        network = self.network()
        put(network, weights)
        seen = course(record, MARGIN, self.causal)
        read = inputs(seen, bank, car.wheelbase, network, self.causal)
        missing, std = answer(network, read.x, read.conditions)
        stations = grid(record.length)
        z = wheel_paths(finer(read.first + read.level * missing, stations.size))
        spread = widths(width, _told(read, network)) * read.level * np.hypot(*std)
        z_std = np.interp(stations, SPACING * (np.arange(spread.size) - EDGE), spread)
        notes = (*notes, SLOW, *limits(seen))
        if abs(car.wheelbase - wheelbase) > WHEELBASE_OFF * wheelbase:
            notes += (f"taught with a wheelbase of {wheelbase:.2f} m, not {car.wheelbase:.2f} m",)
        return Estimate(stations, z, np.array([z_std, z_std]), notes)

    def weights(self) -> dict[str, np.ndarray]:
        """`taps`, `widths`, `wheelbase`, and each weight of the network. Raises NotFittedError."""
        bank, network, width, wheelbase = self._learnt()
        return {
            "taps": bank.taps,
            "widths": width,
            "wheelbase": np.array(wheelbase),
            **{NETWORK + name: x for name, x in network.items()},
        }

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """A copy with these weights. Raises ValueError."""
        behind, ahead = window(self.causal)
        shapes: dict[str, tuple[int | None, ...]] = {
            "taps": shape_of(behind, ahead),
            "widths": (TERMS,),
            "wheelbase": (),
        }
        own = {NETWORK + name: x.shape for name, x in numbers(self.network()).items()}
        taps, width, wheelbase, *rest = arrays(weights, shapes | own)
        names = (name.removeprefix(NETWORK) for name in own)
        network = {name: x.astype(np.float16) for name, x in zip(names, rest, strict=True)}
        bank = Bank(taps.astype(np.float16), ahead)
        return copy_with(self, learnt=Learnt(bank, network, width, float(wheelbase)))

    def _learnt(self) -> Learnt:
        """What was learnt, or what came with the package. Raises NotFittedError."""
        if self.learnt is not None:
            return self.learnt
        weights = shipped(self.name) if self == type(self)() else None
        return self.with_weights(fitted(weights, self))._learnt()

    def _lesson(self, drive: Material, bank: Bank, wheelbase: float, network: Any) -> Lesson:
        read = inputs(drive.course, bank, wheelbase, network, self.causal)
        missing = weighted(drive.target.astype(float) - read.first) / read.level
        return Lesson(read, missing.astype(np.float32))

    def _ratios(self, lesson: Lesson, network: Any, start: int, stop: int) -> np.ndarray:
        """Errors of both wheel paths over their standard deviations."""
        missing, std = answer(network, lesson.inputs.x, lesson.inputs.conditions)
        error = wheel_paths(lesson.missing - missing) / np.hypot(*std)
        return error[:, start:stop].ravel()


def answer(network: Any, x: np.ndarray, conditions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is missing of m and q, and its standard deviation, both (2, M) in levels: the mean of
    what the network says of the drive and, mirrored back, of the mirrored drive.
    """
    import torch

    with torch.no_grad(), one_thread():
        twice = torch.from_numpy(np.array([x, x * FLIP]))
        told = torch.from_numpy(np.array([conditions, conditions]))
        said = network(twice, told).numpy().astype(float)
    mirror = np.array([[1.0], [-1.0]])
    missing = 0.5 * (said[0, :2] + mirror * said[1, :2])
    return missing, np.exp(np.clip(said[:, 2:], *STD_LOG).mean(axis=0))


def _told(read: Inputs, network: Any) -> np.ndarray:
    """The conditions (8, 1 or M) under which the network answers for each station."""
    told = read.conditions.astype(float)
    if told.shape[1] > 1:
        told = told[:, network.behind : network.behind + read.level.size]
    return told
