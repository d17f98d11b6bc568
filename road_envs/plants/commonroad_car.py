"""The multi-body car of `commonroad-vehicle-models`, with the numbers of a vehicle file.

The equations are those of `vehicle_dynamics_mb` (Althoff & Wuersching, "CommonRoad: Vehicle
models", after Allen et al., DOT HS 807 956): 29 states, linear springs and dampers, axles that also
move sideways on compliant joints, Magic Formula tyres with camber. They know neither roads nor
solid axles, and the published slip angles are those of the body's centre, which cannot see roll.
So PATCHES replace three groups of terms in its source, and nothing else:

- the heights of the road are added to the compressions of the four tyres
- the slip of a tyre is that of its axle: its own side speed (states 16 and 21) and roll
- struts are at the distance of the vehicle file, which differs from the wheels' on a solid axle

Two of its tyre's numbers are 0 here, p_hy1 and p_vy1 (ply steer and conicity): the package gives
them the sign of the camber, and that jump of 110 N makes a car roll on a level road. Struts are
linear: `as_driven` returns the vehicle that this plant has, for those who are told it.
"""

import inspect
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.plants import check_on_body
from road_envs.roads.surface import Surface
from road_envs.sensing.instruments import SensorLocation
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.side_values import side_values
from road_envs.vehicle.struts import CoilSpring, PassiveStrut, PassiveStruts

PATCHES = (
    (r"(F_z_(\w\w) = \()", r"\1p.z_\2 + ", 4),
    (r"x\[10\] \+ p\.a\*x\[5\] - x\[14\]", "x[15] - x[14]", 2),
    (r"x\[10\] - p\.b\*x\[5\] - x\[19\]", "x[20] - x[19]", 2),
    (r"(?m)^(    d?z_S\w\w = .*)p\.T_([fr])", r"\1p.S_\2", 8),
    (r"(K_ts[fr])/p\.T_([fr])", r"\1/p.S_\2", 4),
    (r"(0\.5\*F_S\w\w\*)p\.T_([fr])", r"\1p.S_\2", 8),
)
"""Regular expressions, what stands in their place, and how often."""

_MAX_STEP = 1e-3  # greatest step [s] of a drive
DAMPING_RATE = 0.1  # rate [m/s] within which the linear dampers have the slope of the file's

CORNERING, RELAXATION = 21.92, 0.05
"""Cornering stiffness of a tyre over its load [1/rad], p_ky1 of the package; its tyres have no
relaxation, for which the least length [m] of `SideMotion` stands."""

JOINT_STIFFNESS, JOINT_DAMPING = 175_186.659, 10_215.732
"""Stiffness [N/m] and damping [N s/m] of the joints of an axle, K_ras and K_rad of all its cars."""

TEMPLATES = {"bmw_320i": 2, "volkswagen_vanagon": 3}  # others have tyres and joints of the BMW


def as_driven(car: VehicleParameters) -> VehicleParameters:
    """Return the vehicle that the plant has: linear springs and dampers, no friction, no stops.

    Its wheels lean with their axle, as on swing arms of half the track, and do not go fore and aft;
    tyres and the joints of the axles are those of the package.
    """
    if not isinstance(car.strut, PassiveStruts):
        raise ConfigError(f"{car.name} has struts that are switched: a plant needs passive ones")
    none = Curve(x=(-1.0, 1.0), F=(0.0, 0.0))

    def linear(strut: PassiveStrut, load: float) -> PassiveStrut:
        F, _ = strut.at_wheel(strut.damper)(np.array([-DAMPING_RATE, DAMPING_RATE]))
        c = float(F[1] - F[0]) / (2.0 * DAMPING_RATE)
        k = -float(strut.spring_force(np.zeros(1), load)[1][0])
        damper = Curve(x=(-3.0, 3.0), F=(-3.0 * c, 3.0 * c))
        return PassiveStrut(spring=CoilSpring(k=k), damper=damper, friction=none, bump_stop=none)

    struts, loads = (car.strut.front, car.strut.rear), car.strut_loads
    front, rear = map(linear, struts, loads)
    axles = {end: replace(getattr(car, end), c_t=0.0) for end in ("front", "rear")}
    side = car.side
    if side is not None:
        side = replace(
            side,
            swing_arm=(car.front.y_t, car.rear.y_t),
            fore_and_aft=False,
            C_alpha=(CORNERING * car.tyre_loads[0], CORNERING * car.tyre_loads[1]),
            relaxation=(RELAXATION, RELAXATION),
            joint_stiffness=(JOINT_STIFFNESS, JOINT_STIFFNESS),
            joint_damping=(JOINT_DAMPING, JOINT_DAMPING),
        )
    strut = replace(car.strut, front=front, rear=rear)
    return replace(car, strut=strut, side=side, **axles)


def _patched() -> Callable[..., list[float]]:
    """Return the package's right-hand side with the PATCHES."""
    from vehiclemodels import vehicle_dynamics_mb as module

    source = inspect.getsource(module.vehicle_dynamics_mb)
    for pattern, new, expected in PATCHES:
        source, count = re.subn(pattern, new, source)
        if count != expected:
            raise ImportError(
                "this version of commonroad-vehicle-models has other equations than 3.0.2, for "
                f"which the plant was written: {pattern!r} occurs {count} times"
            )
    scope = dict(vars(module))
    exec(source, scope)
    return scope["vehicle_dynamics_mb"]


class CommonRoadCar:
    """One multi-body car; `locations` are those of its accelerometers, on the body.

    Raises ConfigError if one is on an axle, or if the car's struts are switched.
    """

    def __init__(self, car: VehicleParameters, locations: Sequence[SensorLocation]):
        check_on_body("commonroad", locations)
        with optional_import("the plant commonroad"):
            from vehiclemodels.init_mb import init_mb
            from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

            self.rate = _patched()
        self.car, self.init = as_driven(car), init_mb
        self.p = setup_vehicle_parameters(TEMPLATES.get(car.name, 2))
        for name, value in _parameters(self.car).items():
            setattr(self.p, name, value)
        self.p.tire.p_hy1 = self.p.tire.p_vy1 = 0.0
        # its heave is down and its pitch nose up
        self.rows = np.array([(-1.0, at.y, at.x) for at in locations])

    def _rate(self, y: np.ndarray, z: Sequence[float]) -> np.ndarray:
        self.p.z_LF, self.p.z_RF, self.p.z_LR, self.p.z_RR = z
        return np.array(self.rate(y.tolist(), (0.0, 0.0), self.p))

    def drive(
        self, surface: Surface, begin: float, speed: float, duration: float, sample: float
    ) -> np.ndarray:
        """Return vertical accelerations (k, N) [m/s²] every `sample` [s] of a drive from `begin`.

        Front axle at `begin` [m], constant `speed` [m/s]. By the classic method of Runge and Kutta,
        of order 4, with steps of _MAX_STEP [s] or less.
        """
        per_sample = math.ceil(sample / _MAX_STEP - 1e-9)
        h, n = sample / per_sample, round(duration / sample) * per_sample
        stations = begin + speed * 0.5 * h * np.arange(2 * n + 1)
        axles = stations, stations - self.car.wheelbase
        z = np.concatenate([surface.height(s) for s in axles]).T
        heights = (z - z[0].mean()).tolist()
        y = np.array(self.init([0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0], self.p))
        # the package begins with struts off their static lengths
        y[8] = (y[21] - y[16]) / self.car.wheelbase
        y[11] = y[16] + self.p.a * y[8]
        found = np.empty((n // per_sample, 3))
        for i in range(n):
            before, middle, after = heights[2 * i : 2 * i + 3]
            k_1 = self._rate(y, before)
            if i % per_sample == 0:
                found[i // per_sample] = k_1[[12, 7, 9]]  # heave (down), roll, pitch
            k_2 = self._rate(y + 0.5 * h * k_1, middle)
            k_3 = self._rate(y + 0.5 * h * k_2, middle)
            k_4 = self._rate(y + h * k_3, after)
            y = y + h / 6.0 * (k_1 + 2.0 * (k_2 + k_3) + k_4)
            y[3] = speed  # the cruise control
            if not math.isfinite(y[11]):
                raise ArithmeticError(f"{surface.name}: the plant's motion is no longer finite")
        return self.rows @ found.T


def _parameters(car: VehicleParameters) -> dict[str, Any]:
    """Return the numbers of a vehicle by the names of the package."""
    side, (front, rear), struts = side_values(car), car.axles, car.strut
    assert isinstance(struts, PassiveStruts)
    dampers = [strut.damper.F[-1] / strut.damper.x[-1] for strut in (struts.front, struts.rear)]
    springs = [strut.spring.k for strut in (struts.front, struts.rear)]  # type: ignore[union-attr]
    mass = car.m_b + front.m + rear.m
    return {
        "m": mass, "m_s": car.m_b, "m_uf": front.m, "m_ur": rear.m, "a": front.x, "b": -rear.x,
        "I_Phi_s": car.I_xx, "I_y_s": car.I_yy, "I_z": side.I_zz, "I_uf": front.I_xx,
        "I_ur": rear.I_xx, "K_sf": springs[0], "K_sr": springs[1], "K_sdf": dampers[0],
        "K_sdr": dampers[1], "T_f": 2.0 * front.y_t, "T_r": 2.0 * rear.y_t, "S_f": 2.0 * front.y_s,
        "S_r": 2.0 * rear.y_s, "K_tsf": -front.k_roll, "K_tsr": -rear.k_roll, "K_zt": front.k_t,
        "h_s": car.h_cg, "h_raf": side.roll_centre[0], "h_rar": side.roll_centre[1],
        "R_w": side.wheel_radius,
    }  # fmt: skip
