"""First vertical bending mode of the body: a free beam that the struts bend and sensors ride on.

The shape is that of a uniform free beam of length L about the centre of mass (Meirovitch,
"Fundamentals of Vibrations", 2001, section 8.6), 1 at both ends:

    psi(x) = (cos(b x) / cos(b L / 2) + cosh(b x) / cosh(b L / 2)) / 2,     b L = 4.730

so that its modal mass is a quarter of the body's mass m. With F_f and F_r the forces of the struts
at the axles' positions x_f and x_r, beyond the weight,

    q'' + 2 zeta w q' + w² q = (psi(x_f) F_f + psi(x_r) F_r) / (m / 4)

and a sensor at x measures psi(x) q'' in addition. The forces follow from the motion of the rigid
body: F_f + F_r = m z'', x_f F_f + x_r F_r = -I theta''. The coupling is one-way: at 1 m/s² and
20 Hz the beam bends by 0.06 mm, which the struts do not feel.
"""

from functools import lru_cache

import numpy as np
import scipy

from road_envs.vehicle.parameters import BendingMode, VehicleParameters

BETA_L = 4.730040744862704  # first root of cos(b L) cosh(b L) = 1


def shape(mode: BendingMode, x: np.ndarray | float) -> np.ndarray:
    """Return the shape [-] at positions `x` [m] ahead of the centre of mass."""
    b = BETA_L / mode.length
    inner, outer = np.multiply(b, x), 0.5 * BETA_L
    return 0.5 * (np.cos(inner) / np.cos(outer) + np.cosh(inner) / np.cosh(outer))


def modal_force(mode: BendingMode, car: VehicleParameters) -> np.ndarray:
    """Return the modal force per modal mass (2,) by the body's accelerations z'' and theta''."""
    x = np.array([car.front.x, car.rear.x])
    forces = np.linalg.inv(np.array([[1.0, 1.0], x])) @ np.diag([car.m_b, -car.pitch_inertia])
    return shape(mode, x) @ forces / (0.25 * car.m_b)


def response(mode: BendingMode, f: np.ndarray) -> np.ndarray:
    """Return the response (F,) of q'' to the modal force per modal mass at `f` (F,) [Hz]."""
    r = np.asarray(f) / mode.f
    return -(r**2) / (1.0 - r**2 + 2j * mode.zeta * r)


@lru_cache(maxsize=64)
def section(mode: BendingMode, step: float) -> np.ndarray:
    """Return the digital filter (1, 6) of `response`, for samples every `step` [s]. It is the
    bilinear transform, exact at the mode's frequency; nobody may write into it.
    """
    w = 2.0 / step * np.tan(np.pi * mode.f * step)
    poles = w * (-mode.zeta + 1j * np.sqrt(1.0 - mode.zeta**2) * np.array([1.0, -1.0]))
    return scipy.signal.zpk2sos(*scipy.signal.bilinear_zpk(np.zeros(2), poles, 1.0, fs=1.0 / step))


class BendingMotion:
    """The bending of one body during a drive, chunk by chunk."""

    def __init__(self, mode: BendingMode, car: VehicleParameters, step: float):
        self.mode, self._force = mode, modal_force(mode, car)
        self._section, self._state = section(mode, step), np.zeros((1, 2))

    def advance(self, heave: np.ndarray, pitch: np.ndarray) -> np.ndarray:
        """Return q'' (N,) [m/s²] from the body's accelerations (N,) [m/s²] and [rad/s²]."""
        force = self._force @ np.array([heave, pitch])
        q, self._state = scipy.signal.sosfilt(self._section, force, zi=self._state)
        return q
