"""Derivative of the step by dual numbers, computed with the uncompiled Python of the kernels.

    NUMBA_DISABLE_JIT=1 python dual_numbers.py cases.npz derivatives.npz

Reads `n_cases` and for each case its plant (`constants` as bytes, `velocity`, `displacement`),
`strut_state`, `y` (14,), `road` (16,), `a_xy` (4,), `h` and the changes `dy`, `droad`; writes the
changes of the end (14,) and of the signals at the beginning (29,).
"""

import sys

import numpy as np

from road_envs.simulation import rosenbrock
from road_envs.vehicle.equations import PLANT_DTYPE, Motion
from road_envs.vehicle.suspension import VehicleBuffers


class Dual:
    """Dual number x + d eps, eps² = 0; not convertible to float, so no derivative gets lost."""

    __array_ufunc__ = None

    def __init__(self, x, d=0.0):
        self.x, self.d = x, d

    def __add__(self, other):
        other = dual(other)
        return Dual(self.x + other.x, self.d + other.d)

    def __mul__(self, other):
        other = dual(other)
        return Dual(self.x * other.x, self.d * other.x + self.x * other.d)

    def __pow__(self, n):
        return Dual(self.x**n, n * self.x ** (n - 1.0) * self.d)

    def __truediv__(self, other):
        return self * dual(other) ** -1.0

    def __rtruediv__(self, other):
        return other * self**-1.0

    def __neg__(self):
        return Dual(-self.x, -self.d)

    def __sub__(self, other):
        return self + -dual(other)

    def __rsub__(self, other):
        return dual(other) - self

    __radd__, __rmul__ = __add__, __mul__

    def __gt__(self, other):
        return self.x > dual(other).x

    def __lt__(self, other):
        return self.x < dual(other).x

    def __int__(self):
        return int(self.x)


def dual(x):
    """Return `x` as a Dual; a plain number has the derivative 0."""
    return x if isinstance(x, Dual) else Dual(float(x))


def duals(x, d):
    """Return an object array of dual numbers."""
    return np.array([Dual(a, b) for a, b in zip(x.tolist(), d.tolist(), strict=True)], dtype=object)


def main(cases, derivatives):
    """Read the cases, write their derivatives."""
    given = np.load(cases)
    end, signals = [], []
    for i in range(int(given["n_cases"])):
        case = {key.split("/")[1]: given[key] for key in given if key.startswith(f"{i}/")}
        constants = np.frombuffer(case["constants"].tobytes(), dtype=PLANT_DTYPE).view(np.recarray)
        work = rosenbrock.step_workspace(np.empty(rosenbrock.WORKSPACE_ROWS, dtype=object))
        y, out = duals(case["y"], case["dy"]), np.empty(rosenbrock.N_SIGNALS, dtype=object)
        road = duals(case["road"], case["droad"])
        inputs = rosenbrock.StepInputs(road, case["a_xy"], float(case["h"]), 0.0)
        vehicle = VehicleBuffers(
            constants, case["velocity"], case["displacement"], case["strut_state"]
        )
        rosenbrock.step(vehicle, Motion(y[:7], y[7:]), inputs, work, out)
        end.append([dual(a).d for a in y])
        signals.append([dual(a).d for a in out])
    np.savez(derivatives, end=end, signals=signals)


if __name__ == "__main__":
    main(*sys.argv[1:])
