"""A vehicle with independent wheels and passive struts, in the heights of its wheels.

State: height z [m] of the body's centre of mass, roll, pitch (positive: left side up, nose down),
heights of the wheels FL, FR, RL, RR, all from static equilibrium, then their rates. No package
under test is imported. `car`: any object with the attributes of `VehicleParameters`.
"""

import numpy as np
from oracles import CubicCurve, G, static_loads
from scipy.integrate import solve_ivp
from scipy.linalg import eigh


class FourWheels:
    """Forces from the travel of each wheel; anti-roll bars from the difference of two wheels'.

    `springs`: two functions of the extension [m], the forces [N] of a front and a rear spring.
    """

    def __init__(self, car, springs):
        self.car, axles = car, (car.front, car.front, car.rear, car.rear)
        struts = (car.strut.front, car.strut.front, car.strut.rear, car.strut.rear)
        self.springs = [springs[w // 2] for w in range(4)]
        self.damper = [CubicCurve(s.damper) for s in struts]
        self.friction = [CubicCurve(s.friction) for s in struts]
        self.stop = [CubicCurve(s.bump_stop) for s in struts]
        self.x = np.array([a.x for a in axles])
        self.y = np.array([a.y_t for a in axles]) * [1.0, -1.0, 1.0, -1.0]
        self.m = np.array([0.5 * a.m for a in axles])
        self.k_t = np.array([a.k_t for a in axles])
        self.c_t = np.array([a.c_t for a in axles])
        self.bar = np.array([a.k_roll / (2.0 * a.y_t) ** 2 for a in axles])
        self.load = np.repeat(static_loads(car)[1], 2)

    def above(self, body):
        """Return the heights (4,) of the body above the wheels, or their rates."""
        z, roll, pitch = body
        return z + self.y * roll - self.x * pitch

    def strut_forces(self, e, e_dot):
        """Return the forces (4,) [N] of spring, damper, friction, stop and bar on the body."""
        own = [
            self.springs[w](e[w])
            - self.damper[w](e_dot[w])
            - self.friction[w](e_dot[w])
            - self.stop[w](e[w])
            for w in range(4)
        ]
        return np.array(own) - self.bar * (e - e[[1, 0, 3, 2]])

    def rate(self, t, state, road):
        """Return the rate of the state; `road(t)`: heights (4,) [m] and their rates [m/s]."""
        q, v = state[:7], state[7:]
        z_r, w_r = road(t)
        F = self.strut_forces(self.above(q[:3]) - q[3:], self.above(v[:3]) - v[3:])
        spring = np.maximum(self.load + self.k_t * (z_r - q[3:]), 0.0)
        T = np.clip(spring + self.c_t * (w_r - v[3:]), 0.0, 2.0 * spring)
        body = [
            F.sum() / self.car.m_b - G,
            (self.y * F).sum() / self.car.I_xx,
            -(self.x * F).sum() / self.car.I_yy,
        ]
        return np.concatenate([v, body, (T - F) / self.m - G])

    def drive(self, road, t):
        """Return the states (14, N) at the times `t` (N,) [s], from rest."""
        options = {"method": "LSODA", "rtol": 1e-8, "atol": 1e-10, "max_step": 2e-3}
        return solve_ivp(self.rate, (0.0, t[-1]), np.zeros(14), t_eval=t, args=(road,), **options).y


def quarter_car_frequencies(m_s, m_u, k_s, k_t):
    """Return the two undamped natural frequencies [Hz] of a quarter car, in closed form."""
    b, c = k_s / m_s + (k_s + k_t) / m_u, k_s * k_t / (m_s * m_u)
    root = np.sqrt(b * b - 4.0 * c)
    return np.sqrt([0.5 * (b - root), 0.5 * (b + root)]) / (2.0 * np.pi)


def four_wheel_frequencies(car, k_s):
    """Return the seven undamped natural frequencies [Hz], from the energy of each spring."""
    M, K = (
        np.diag(
            [
                car.m_b,
                car.I_xx,
                car.I_yy,
                *(0.5 * np.repeat([a.m for a in (car.front, car.rear)], 2)),
            ]
        ),
        np.zeros((7, 7)),
    )
    for i, axle in enumerate((car.front, car.rear)):
        travel = []
        for side, sign in enumerate((1.0, -1.0)):
            row, tyre = np.zeros(7), np.zeros(7)
            row[:3], row[3 + 2 * i + side] = (1.0, sign * axle.y_t, -axle.x), -1.0
            tyre[3 + 2 * i + side] = 1.0
            K += k_s[i] * np.outer(row, row) + axle.k_t * np.outer(tyre, tyre)
            travel.append(row)
        twist = (travel[0] - travel[1]) / (2.0 * axle.y_t)
        K += axle.k_roll * np.outer(twist, twist)
    return np.sqrt(eigh(K, M, eigvals_only=True)) / (2.0 * np.pi)
