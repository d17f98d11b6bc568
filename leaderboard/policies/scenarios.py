"""Scenarios: drives, tuning roads and test roads of the policy comparison.

They are read from `configs/scenarios/*.yaml`. A case is a road family at a speed, with or without a
manoeuvre; every seed realises another road of the family. Test and training never share a seed.
"""

from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from road_envs.core import config
from road_envs.core.config import ConfigError, Positive, Settings
from road_envs.envs.options import EnvSetup, Weights


@dataclass(frozen=True, kw_only=True)
class Case(Settings):
    """A kind of drive; `manoeuvre` as the environment takes it."""

    road: str
    speed_kmh: Annotated[Positive, "km/h"]
    manoeuvre: str | dict[str, Any] | None = None

    @property
    def label(self) -> str:
        """Description such as "iso_d, 54 km/h, lane_change"."""
        kind = self.manoeuvre if isinstance(self.manoeuvre, str | None) else self.manoeuvre["kind"]
        return f"{self.road}, {self.speed_kmh:g} km/h, {kind or 'straight on'}"


@dataclass(frozen=True, kw_only=True)
class SeedRange(Settings):
    """`number` consecutive seeds, beginning with `first`."""

    first: Annotated[int, Field(ge=0)]
    number: Annotated[int, Field(ge=2)]

    @property
    def seeds(self) -> range:
        """The seeds."""
        return range(self.first, self.first + self.number)


@dataclass(frozen=True, kw_only=True)
class Scenarios(Settings):
    """Cases and their common settings.

    `shown` is the number of the case whose drives the page shows over time.
    """

    name: str
    title: str
    cases: Annotated[tuple[Case, ...], Field(min_length=1)]
    test: SeedRange
    training: SeedRange
    shown: int = 0
    length: Annotated[Positive, "m", "of every road"] = 100.0
    control: Literal["vehicle", "axle", "states"] = "states"
    control_rate: Annotated[Positive, "Hz"] = 50.0
    mode: str | dict[str, str] = "ride"
    vehicle: str = "land_rover_defender_110"
    sensors: str = "paper"
    weights: Weights = field(default_factory=Weights)
    note: str = ""

    def __post_init__(self):
        super().__post_init__()
        if not 0 <= self.shown < len(self.cases):
            raise ValueError(
                f"shown must be the index of a case, 0 to {len(self.cases) - 1}, got {self.shown}"
            )
        if len(set(map(repr, self.cases))) < len(self.cases):
            raise ValueError("cases must be distinct: one is given twice")
        test, training = self.test.seeds, self.training.seeds
        if shared := range(max(test[0], training[0]), min(test[-1], training[-1]) + 1):
            raise ValueError(
                "training and test must be disjoint but share the seeds "
                f"{shared[0]} to {shared[-1]}"
            )

    def options(self, case: Case) -> dict[str, Any]:
        """Return the keyword arguments of the environment; `info` never holds the truth."""
        common = ("length", "control", "control_rate", "mode", "vehicle", "sensors")
        return {
            **{name: getattr(self, name) for name in common},
            "road": case.road,
            "speed_kmh": case.speed_kmh,
            "manoeuvre": case.manoeuvre,
            "weights": asdict(self.weights),
            "observe": ["accelerations", "planar", "struts"],  # all that a policy may use
            "truth": False,
        }

    @cached_property
    def setups(self) -> tuple[EnvSetup, ...]:
        """Environment of each case. Raises ConfigError for the first invalid one."""
        setups = []
        for case in self.cases:
            try:
                setups.append(EnvSetup(self.options(case)))
            except ConfigError as error:
                raise ConfigError(f"{self.name}: {case.label}: {error}") from None
        return tuple(setups)

    def test_seeds(self, roads: int | None) -> range:
        """Return the first `roads` test seeds, all of them for None. Raises ConfigError."""
        if roads is not None and not 2 <= roads <= self.test.number:
            raise ConfigError(
                f"{self.name}: the number of roads must be 2 to {self.test.number}, got {roads}"
            )
        return self.test.seeds[:roads]


def load_scenarios(name: str | Path) -> Scenarios:
    """Load scenarios by shipped name or YAML path. Raises ConfigError."""
    return config.load(Scenarios, "scenarios", name)
