"""A car in MuJoCo, built from the numbers of a vehicle file.

The body moves sideways, up and down, yaws, pitches and rolls; its frame of reference moves ahead at
the constant speed. A solid axle slides up and down at its roll centre and turns about it.
Independent wheels swing about axes along the car, at the file's `swing_arm` from the wheel, on the
line from the contact through the roll centre. MuJoCo finds masses, levers, lengths of struts and
their rates, and accelerations; the accelerometers are its own. What acts between its bodies:

- struts are tendons, whose forces are the interpolated curves of the file, or those of a law that
  is handed over
- tyres push at the contacts: springs and dampers that never pull, and side forces that follow the
  slip over the relaxation length and end at the friction of the ground

Tyres are points; their side forces grow with the load.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.plants import check_on_body
from road_envs.roads.surface import Surface
from road_envs.sensing.instruments import SensorLocation
from road_envs.vehicle.axles import IndependentWheels, SideMotion
from road_envs.vehicle.parameters import GRAVITY, VehicleParameters
from road_envs.vehicle.side_values import side_values
from road_envs.vehicle.struts import PassiveStruts

STEP = 2e-4  # step [s] of MuJoCo's integrator
FRICTION = 0.9  # greatest side force of a tyre over its load [-]
SETTLING = 1.0  # time [s] at rest before a drive begins
DRAG = 1e-9  # rotary inertia [kg m²] about axes that do not matter, since MuJoCo needs one

StrutLaw = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Law of the struts FL, FR, RL, RR: extensions (4,) [m] and their rates [m/s] to forces (4,) [N]
that push the body up."""


class MujocoCar:
    """One car in MuJoCo; `locations` are those of its accelerometers, on the body.

    Its struts follow `law`, by default the curves of the vehicle file. Raises ConfigError if it has
    none, as a car whose struts are switched, if the joints of its axles give way, or if an
    accelerometer is on an axle.
    """

    def __init__(
        self,
        car: VehicleParameters,
        locations: Sequence[SensorLocation],
        law: StrutLaw | None = None,
    ):
        check_on_body("mujoco", locations)
        with optional_import("the plant mujoco"):
            import mujoco

        self.mujoco, self.car, self.side = mujoco, car, side_values(car)
        if self.side.has_joints:
            raise ConfigError(
                f"the axles of the plant mujoco have rigid joints, those of {car.name} not"
            )
        self.model = mujoco.MjModel.from_xml_string(_describe(car, self.side, locations))
        self.data = mujoco.MjData(self.model)
        self.law = law or _passive_law(car)
        site = mujoco.mjtObj.mjOBJ_SITE
        wheels = [mujoco.mj_name2id(self.model, site, f"contact{w}") for w in range(4)]
        self.contacts, self.bodies = np.array(wheels), self.model.site_bodyid[wheels]
        self.k, self.c, self.load, self.C, self.sigma = np.array(
            [
                (axle.k_t, axle.c_t, car.tyre_loads[i], self.side.C_alpha[i], sigma)
                for i, (axle, sigma) in enumerate(zip(car.axles, self.side.relaxation, strict=True))
                for _ in range(2)
            ]
        ).T
        mujoco.mj_forward(self.model, self.data)
        self.lengths = self.data.ten_length[:4].copy()
        self.heights = self.data.site_xpos[self.contacts, 2].copy()
        self.side_force, self.tyre_load = np.zeros(4), self.load.copy()

    @property
    def extension(self) -> np.ndarray:
        """Extensions (4,) [m] of the struts from their lengths at rest."""
        return self.data.ten_length[:4] - self.lengths

    def step(self, z_r: np.ndarray, w_r: np.ndarray, v: float) -> None:
        """Take one step at road heights `z_r` (4,) [m] and their rates `w_r` [m/s]."""
        model, data = self.model, self.data
        self.mujoco.mj_step1(model, data)
        data.ctrl[:4] = self.law(self.extension, data.ten_velocity[:4])
        speed = data.sensordata[:12].reshape(4, 3)  # of the contacts
        squeezed = self.load / self.k + z_r - (data.site_xpos[self.contacts, 2] - self.heights)
        load = self.k * squeezed + self.c * (w_r - speed[:, 2])
        self.tyre_load = load = np.where(squeezed > 0.0, np.maximum(load, 0.0), 0.0)
        slip = speed[:, 1] - v * data.qpos[2]  # against the heading
        stiffness = self.C * load / self.load
        self.side_force -= STEP / self.sigma * (v * self.side_force + stiffness * slip)
        self.side_force = np.clip(self.side_force, -FRICTION * load, FRICTION * load)
        # forces at the contacts, and their moments about the bodies' centres of mass
        x, y, z = (data.site_xpos[self.contacts] - data.xipos[self.bodies]).T
        moments = y * load - z * self.side_force, -x * load, x * self.side_force
        data.xfrc_applied[:] = 0.0
        wrench = np.array([np.zeros(4), self.side_force, load, *moments]).T
        np.add.at(data.xfrc_applied, self.bodies, wrench)
        self.mujoco.mj_step2(model, data)

    def drive(
        self, surface: Surface, begin: float, speed: float, duration: float, sample: float
    ) -> np.ndarray:
        """Return vertical accelerations (k, N) [m/s²] every `sample` [s] of a drive from `begin`.

        Front axle at `begin` [m], constant `speed` [m/s].
        """
        every, n = round(sample / STEP), round(duration / sample)
        front = begin + speed * STEP * np.arange(n * every)
        rear, rest = front - self.car.wheelbase, np.zeros(4)
        z = np.concatenate([surface.height(front), surface.height(rear)]).T
        slope = np.concatenate([surface.slope(front), surface.slope(rear)]).T
        for _ in range(round(SETTLING / STEP)):
            self.step(z[0], rest, 0.0)
        found = np.empty((n, self.model.nsensordata - 12))
        for i in range(n * every):
            self.step(z[i], speed * slope[i], speed)
            if i % every == 0:
                found[i // every] = self.data.sensordata[12:]
        return found[:, 2::3].T - GRAVITY


def _passive_law(car: VehicleParameters) -> StrutLaw:
    """Return the law of the curves in a vehicle file. Raises ConfigError if it has none."""
    if not isinstance(car.strut, PassiveStruts):
        raise ConfigError(f"{car.name} has struts that are switched: a plant needs passive ones")
    tables: list[tuple[np.ndarray, ...]] = []
    for strut, load in zip((car.strut.front, car.strut.rear), car.strut_loads, strict=True):
        e, rate = np.linspace(-0.3, 0.3, 2401), np.linspace(-4.0, 4.0, 4001)
        F = strut.spring_force(e, load)[0] - _interpolate(strut.at_wheel(strut.bump_stop), e)
        if strut.bushing is not None:
            F -= _interpolate(strut.at_wheel(strut.bushing), e)
        losses = [strut.at_wheel(curve) for curve in (strut.damper, strut.friction)]
        tables.append((e, F, rate, np.sum([_interpolate(curve, rate) for curve in losses], axis=0)))

    def law(extension: np.ndarray, rates: np.ndarray) -> np.ndarray:
        forces = np.empty(4)
        for w, (e, rate) in enumerate(zip(extension, rates, strict=True)):
            x, F, u, damping = tables[w // 2]
            forces[w] = np.interp(e, x, F) - np.interp(rate, u, damping)
        return forces

    return law


def _interpolate(curve: Any, x: np.ndarray) -> np.ndarray:
    """Return a curve of a vehicle file at `x`, continued by straight lines."""
    law = PchipInterpolator(curve.x, curve.F)
    inside = np.clip(x, curve.x[0], curve.x[-1])
    return law(inside) + law.derivative()(inside) * (x - inside)


def _describe(car: VehicleParameters, side: SideMotion, locations: Sequence[SensorLocation]) -> str:
    """Return the car as a MuJoCo model; at rest its bodies are where the file says."""
    bodies, tendons, bars, tops = [], [], [], ""
    for i, axle in enumerate(car.axles):
        wheels = _swinging if isinstance(axle, IndependentWheels) else _solid
        bodies.append(wheels(i, axle, car.h_cg, side))
        for k, y in enumerate((axle.y_s, -axle.y_s)):
            w = 2 * i + k
            tops += f'<site name="top{w}" pos="{axle.x} {y} 0.3"/>'
            tendons.append(
                f'<spatial name="strut{w}"><site site="bottom{w}"/><site site="top{w}"/></spatial>'
            )
        if isinstance(axle, IndependentWheels) and axle.k_roll > 0.0:
            # the bar feels the difference of the wheels' travel, an arm times the angles'
            rate = axle.k_roll / (2.0 * axle.y_t) ** 2
            bars.append(
                f'<fixed name="bar{i}" stiffness="{rate}" springlength="0">'
                f'<joint joint="swing{2 * i}" coef="{side.swing_arm[i]}"/>'
                f'<joint joint="swing{2 * i + 1}" coef="{side.swing_arm[i]}"/></fixed>'
            )
    for k, (x, y, _) in enumerate(locations):
        tops += f'<site name="sensor{k}" pos="{x} {y} 0"/>'
    motors = "".join(f'<motor tendon="strut{w}"/>' for w in range(4))
    velocities = "".join(f'<framelinvel objtype="site" objname="contact{w}"/>' for w in range(4))
    accelerometers = "".join(f'<accelerometer site="sensor{k}"/>' for k in range(len(locations)))
    return f"""<mujoco><compiler angle="radian" autolimits="true" boundmass="0"/>
    <option timestep="{STEP}" gravity="0 0 {-GRAVITY}"><flag contact="disable"/></option>
    <worldbody><body name="body" pos="0 0 {car.h_cg}">
    <joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
    <joint axis="0 0 1"/><joint axis="0 1 0"/><joint axis="1 0 0"/>
    <inertial pos="0 0 0" mass="{car.m_b}" diaginertia="{car.I_xx} {car.I_yy} {side.I_zz}"/>
    {tops}{"".join(bodies)}</body></worldbody>
    <tendon>{"".join(tendons + bars)}</tendon><actuator>{motors}</actuator>
    <sensor>{velocities}{accelerometers}</sensor></mujoco>"""


def _sites(w: int, strut: tuple[float, float], contact: tuple[float, float]) -> str:
    return (
        f'<site name="bottom{w}" pos="0 {strut[0]} {strut[1]}"/>'
        f'<site name="contact{w}" pos="0 {contact[0]} {contact[1]}"/>'
    )


def _solid(i: int, axle: Any, h_cg: float, side: SideMotion) -> str:
    """Return a solid axle as a body: its origin is its roll centre."""
    h, radius = side.roll_centre[i], side.wheel_radius
    sites = "".join(
        _sites(2 * i + k, (sign * axle.y_s, radius - h), (sign * axle.y_t, -h))
        for k, sign in enumerate((1.0, -1.0))
    )
    inertia = f"{axle.I_xx} {DRAG} {axle.I_xx}"  # it does not pitch with the body
    return f"""<body pos="{axle.x} 0 {h - h_cg}"><joint type="slide" axis="0 0 1"/>
    <joint axis="1 0 0" stiffness="{axle.k_roll}"/>
    <inertial pos="0 0 {radius - h}" mass="{axle.m}" diaginertia="{inertia}"/>
    {sites}</body>"""


def _swinging(i: int, axle: Any, h_cg: float, side: SideMotion) -> str:
    """Return two wheels as bodies: their origins are the axes about which they swing."""
    bodies, arm, radius = "", side.swing_arm[i], side.wheel_radius
    centre = side.roll_centre[i] * arm / axle.y_t
    for k, sign in enumerate((1.0, -1.0)):
        w = 2 * i + k
        bodies += f"""<body pos="{axle.x} {sign * (axle.y_t - arm)} {centre - h_cg}">
        <joint name="swing{w}" axis="1 0 0"/>
        <inertial pos="0 {sign * arm} {radius - centre}" mass="{0.5 * axle.m}"
        diaginertia="{DRAG} {DRAG} {DRAG}"/>
        {_sites(w, (sign * arm, radius - centre), (sign * arm, -centre))}</body>"""
    return bodies
