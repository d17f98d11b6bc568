"""Struts as parameters, 4S4 and passive ones; `suspension` has the laws that kernels read."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, Tag

from road_envs.core.config import Positive, Settings, by_kind
from road_envs.vehicle.force_curves import Curve

ATMOSPHERE = 101325.0  # standard atmospheric pressure [Pa]

Modes = Mapping[str, tuple[bool, bool]]  # settings of struts by name: (stiff spring, high damping)
MODES = {
    "ride": (False, False),
    "handling": (True, True),
    "soft_high": (False, True),
    "stiff_low": (True, False),
}
"""The four settings of a 4S4 strut."""
PASSIVE_MODES = {"passive": (False, False)}  # the only setting of a passive strut


@dataclass(frozen=True, kw_only=True)
class _ModeCurves(Settings):
    ride: Annotated[Curve, "N over m/s", "low damping"]
    handling: Annotated[Curve, "N over m/s", "high damping"]


@dataclass(frozen=True, kw_only=True)
class _AxleCurves(Settings):
    front: Annotated[Curve, "N over m", "both front struts"]
    rear: Annotated[Curve, "N over m", "both rear struts"]


@dataclass(frozen=True, kw_only=True)
class Strut(Settings):
    """A 4S4 strut: gas spring with two accumulators, damper, friction, bushing, bump stop."""

    p_stat: Annotated[Positive, "Pa", "static gas pressure"]
    A: Annotated[Positive, "m²", "bore area"]
    n_p: Annotated[Positive, "", "polytropic exponent"]
    x_1: Annotated[Positive, "m", "static gas column of the first accumulator"]
    x_2: Annotated[Positive, "m", "static gas column of the second accumulator, behind the valve"]
    column_min: Annotated[Positive, "m", "shortest gas column; the force is linear below it"]
    damper: _ModeCurves
    friction: _ModeCurves
    bushing: Curve
    bump_stop: _AxleCurves
    kind: Literal["4s4"] = "4s4"

    def __post_init__(self):
        super().__post_init__()
        if self.column_min >= self.x_1:
            raise ValueError(f"column_min {self.column_min} must be below x_1 {self.x_1}")


@dataclass(frozen=True, kw_only=True)
class CoilSpring(Settings):
    """A linear spring: coil, leaf or torsion bar."""

    k: Annotated[Positive, "N/m", "rate"]
    kind: Literal["coil"] = "coil"

    def force(self, e: np.ndarray, load: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the force [N] at extensions `e` [m], and its derivative; `load` [N] at 0."""
        return load - self.k * e, np.full_like(e, -self.k)


@dataclass(frozen=True, kw_only=True)
class _AirSpring(Settings):
    """An air spring of constant effective area whose pressure carries the static load.

    With p_0 the atmospheric pressure and p = p_0 + load / A the absolute pressure at static length,

        F = A (p (x / (x + e))^n_p - p_0),

    so that its rate at static length is n_p p A / x (Gillespie, "Fundamentals of Vehicle Dynamics",
    chapter 5). Below a fifth of the static column the force continues linearly.
    """

    A: Annotated[Positive, "m²", "effective area"]
    x: Annotated[Positive, "m", "gas column at static length: volume over effective area"]
    n_p: Annotated[Positive, "", "polytropic exponent"]
    kind: Literal["air"]

    def force(self, e: np.ndarray, load: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the force [N] at extensions `e` [m], and its derivative; `load` [N] at 0."""
        column = self.x + e
        inside = np.maximum(column, 0.2 * self.x)
        gas = (ATMOSPHERE * self.A + load) * (self.x / inside) ** self.n_p
        slope = -self.n_p * gas / inside
        return gas + slope * (column - inside) - ATMOSPHERE * self.A, slope


AnySpring = Annotated[
    Annotated[CoilSpring, Tag("coil")] | Annotated[_AirSpring, Tag("air")], by_kind("coil")
]


@dataclass(frozen=True, kw_only=True)
class PassiveStrut(Settings):
    """Spring, damper, friction and stops of one wheel, none of which can be switched. Curves are
    those of the strut itself; with r its `motion_ratio`, a force F(e) of the strut is r F(r e) at
    y_s of a solid axle, or at an independent wheel.
    """

    spring: AnySpring
    damper: Annotated[Curve, "N over m/s", "rebound positive, compression negative"]
    friction: Annotated[Curve, "N over m/s", "dry friction"]
    bump_stop: Annotated[Curve, "N over m", "stops of bump (negative) and of rebound"]
    bushing: Annotated[Curve, "N over m", "rubber parallel to the spring"] | None = None
    motion_ratio: Annotated[Positive, "", "travel of the strut per travel of the wheel"] = 1.0

    def spring_force(self, e: np.ndarray, load: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the force [N] at the wheel, with the static one `load`, and its slope by `e`."""
        r = self.motion_ratio
        F, slope = self.spring.force(r * e, load / r)
        return r * F, r * r * slope

    def at_wheel(self, curve: Curve) -> Curve:
        """Return one of the strut's curves as a force at the wheel over its travel or rate."""
        r = self.motion_ratio
        return Curve(x=tuple(x / r for x in curve.x), F=tuple(r * F for F in curve.F))


@dataclass(frozen=True, kw_only=True)
class PassiveStruts(Settings):
    """The passive struts of both axles."""

    kind: Literal["passive"]
    front: PassiveStrut
    rear: PassiveStrut


AnyStruts = Annotated[
    Annotated[Strut, Tag("4s4")] | Annotated[PassiveStruts, Tag("passive")], by_kind("4s4")
]


@dataclass(frozen=True, kw_only=True)
class Valve(Settings):
    """Dynamics between a switching command and the strut: pure delay, then first-order lag."""

    delay: Annotated[float, Field(ge=0.0, le=10.0), "s", "pure delay"]
    lag: Annotated[Positive, "s", "time constant of the valve"]
    equalisation: Annotated[Positive, "s", "time constant of pressure equalisation, valve open"]


NO_VALVE = Valve(delay=0.0, lag=1e-6, equalisation=1e-6)
"""Stands in for the valve of a passive strut, whose force does not depend on it."""
