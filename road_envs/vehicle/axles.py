"""Axles of a vehicle as parameters: solid ones, and pairs of independent wheels."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, Tag

from road_envs.core.config import Finite, NonNegative, Positive, Settings, by_kind


@dataclass(frozen=True, kw_only=True)
class _UnsprungPair(Settings):
    """Fields of both kinds of axle: two wheels with their tyres, at one distance from the body."""

    x: Annotated[Finite, "m", "ahead of the body's centre of mass; negative at the rear"]
    m: Annotated[Positive, "kg", "unsprung mass, both wheels included"]
    y_t: Annotated[Positive, "m", "half the distance between the tyres"]
    k_t: Annotated[Positive, "N/m", "vertical stiffness of one tyre"]
    c_t: Annotated[NonNegative, "N s/m", "damping of one tyre"]
    k_roll: Annotated[
        NonNegative, "N m/rad", "anti-roll bar: moment per roll of the body relative to the wheels"
    ] = 0.0


@dataclass(frozen=True, kw_only=True)
class Axle(_UnsprungPair):
    """A solid axle with its two struts and two tyres."""

    I_xx: Annotated[Positive, "kg m²", "roll inertia"]
    y_s: Annotated[Positive, "m", "half the distance between the struts"]
    kind: Literal["solid"] = "solid"


@dataclass(frozen=True, kw_only=True)
class IndependentWheels(_UnsprungPair):
    """Two independently suspended wheels with their struts and tyres.

    Two masses m / 2 at y = ±y_t move as an axle of mass m and roll inertia m y_t² with struts at
    the wheels (y_s = y_t): its heave is the mean of their heights, its roll the difference over
    2 y_t. Forces and rates of the struts are those at the wheels; the anti-roll bar pushes each by
    k_roll / (2 y_t)² times the difference of their travel.
    """

    kind: Literal["independent"]

    @property
    def I_xx(self) -> float:
        """Roll inertia [kg m²] of the equivalent axle."""
        return self.m * self.y_t**2

    @property
    def y_s(self) -> float:
        """Half the distance [m] between the struts of the equivalent axle."""
        return self.y_t


AnyAxle = Annotated[
    Annotated[Axle, Tag("solid")] | Annotated[IndependentWheels, Tag("independent")],
    by_kind("solid"),
]

_RollCentre = Annotated[float, Field(ge=-0.3, le=1.5)]
_Cornering = Annotated[float, Field(ge=5e3, le=5e5)]
_Relaxation = Annotated[float, Field(ge=0.01, le=2.0)]
_SwingArm = Annotated[float, Field(ge=0.4, le=50.0)]
_Stiffness = Annotated[float, Field(ge=0, le=1e7)]
_Damping = Annotated[float, Field(ge=0, le=1e6)]


@dataclass(frozen=True, kw_only=True)
class SideMotion(Settings):
    """Parts that hold the body sideways (`side_motion`); pairs are front and rear. Values beyond
    the ranges are those of no road vehicle.
    """

    I_zz: Annotated[float, Field(ge=100, le=1e6), "kg m²", "yaw inertia of the body"]
    wheel_radius: Annotated[float, Field(ge=0.15, le=0.8), "m", "height of the wheels' centres"]
    roll_centre: Annotated[
        tuple[_RollCentre, _RollCentre], "m", "heights at which the axles hold the body sideways"
    ]
    C_alpha: Annotated[tuple[_Cornering, _Cornering], "N/rad", "cornering stiffness of one tyre"]
    relaxation: Annotated[tuple[_Relaxation, _Relaxation], "m", "relaxation length of the tyres"]
    swing_arm: Annotated[
        tuple[_SwingArm, _SwingArm], "m", "of independent wheels: to the centre they swing about"
    ] = (1.5, 1.5)
    fore_and_aft: Annotated[bool, "", "if the wheels go fore and aft as the body pitches"] = True
    joint_stiffness: Annotated[
        tuple[_Stiffness, _Stiffness], "N/m", "of the axles' sideways joints; 0 at both: rigid"
    ] = (0.0, 0.0)
    joint_damping: Annotated[tuple[_Damping, _Damping], "N s/m", "of these joints"] = (0.0, 0.0)

    def __post_init__(self):
        super().__post_init__()
        if (self.joint_stiffness[0] > 0.0) != (self.joint_stiffness[1] > 0.0):
            raise ValueError(
                "joint_stiffness: the joints of one axle only give way; give that of the other, or "
                f"0 at both, got {list(self.joint_stiffness)} N/m"
            )

    @property
    def has_joints(self) -> bool:
        """True if the joints that hold the axles sideways give way."""
        return self.joint_stiffness[0] > 0.0
