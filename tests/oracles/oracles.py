"""Independent reference solutions for vehicle, suspension, motion and instruments.

No package under test is imported, and the paper's constants are repeated here, so that a wrong
constant in the code is detected. `car`: any object with the attributes of `VehicleParameters`;
`strut_state` (4, 3): held extension, open fraction and share of high damping of each strut. "Paper"
is Ngwangwa, Heyns, Breytenbach & Els.
"""

from types import SimpleNamespace

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.linalg import eigh

G = 9.81
PAPER_AXLE = {"m": 229.0, "I_xx": 33.1, "y_s": 1.1 / 2, "y_t": 1.5 / 2, "k_t": 250e3, "c_t": 1200.0}
PAPER_CAR = SimpleNamespace(  # Table 1, section 2.2, eq. 1; wheelbase of 110 inches
    m_b=1734.0,
    I_xx=688.0,
    I_yy=2440.0,
    front=SimpleNamespace(x=1.395, **PAPER_AXLE),
    rear=SimpleNamespace(x=1.395 - 2.794, **PAPER_AXLE),
)
P_STAT, BORE, N_P = 2.167e6, 1.963e-3, 1.0
X_STAT = {"ride": 0.255, "handling": 0.0509}
MODES_HZ = {  # roll, bounce, pitch, axle hops, axle rolls: computed independently of this project
    "ride": (0.847, 0.955, 1.125, 7.685, 7.687, 14.932, 14.933),
    "handling": (1.774, 1.897, 2.226, 8.665, 8.696, 15.935, 15.953),
}


# --- linear vehicle, from energy ------------------------------------------------------------------


def gas_force(x_stat, extension):
    """Return the force [N] by eq. 1 as printed."""
    return P_STAT * BORE * (x_stat / (x_stat + extension)) ** N_P


def static_rate(mode):
    """Return the spring rate [N/m] of eq. 1 at static length."""
    return N_P * P_STAT * BORE / X_STAT[mode]


def linear_matrices(car, k_s, c_s=(0.0, 0.0), frame=None):
    """Return (M, C, K, K_r, C_r) of the car with linear struts `k_s`, `c_s` (front, rear).

    With a torsional `frame` (frequency, damping ratio) its twist is the eighth coordinate: the
    halves of the body roll by half of it more and less than their mean.

    A spring with the elongation b.q stores k (b.q)^2 / 2 and adds k b b' to K, so that no signs of
    forces have to be chosen. K_r, C_r (7, 4) multiply the road heights and their rates.
    """
    n = 7 if frame is None else 8
    M, C, K = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    K_r, C_r = np.zeros((n, 4)), np.zeros((n, 4))
    M[[0, 1, 2], [0, 1, 2]] = car.m_b, car.I_xx, car.I_yy
    for i, axle in enumerate((car.front, car.rear)):
        M[3 + 2 * i, 3 + 2 * i], M[4 + 2 * i, 4 + 2 * i] = axle.m, axle.I_xx
        for side, sign in enumerate((1.0, -1.0)):
            strut, tyre = np.zeros(n), np.zeros(n)
            strut[:3] = -1.0, -sign * axle.y_s, axle.x
            strut[3 + 2 * i : 5 + 2 * i] = 1.0, sign * axle.y_s
            strut[7:] = -0.5 * sign * axle.y_s * (1.0 - 2.0 * i)
            tyre[3 + 2 * i : 5 + 2 * i] = 1.0, sign * axle.y_t
            K += k_s[i] * np.outer(strut, strut) + axle.k_t * np.outer(tyre, tyre)
            C += c_s[i] * np.outer(strut, strut) + axle.c_t * np.outer(tyre, tyre)
            K_r[:, 2 * i + side], C_r[:, 2 * i + side] = axle.k_t * tyre, axle.c_t * tyre
    if frame is not None:
        omega = 2.0 * np.pi * frame[0]
        M[7, 7] = 0.25 * car.I_xx
        K[7, 7] += M[7, 7] * omega**2
        C[7, 7] += 2.0 * frame[1] * omega * M[7, 7]
    return M, C, K, K_r, C_r


def natural_frequencies(M, K):
    """Return the undamped natural frequencies [Hz] in ascending order."""
    return np.sqrt(eigh(K, M, eigvals_only=True)) / (2.0 * np.pi)


def response(matrices, f, road):
    """Return complex accelerations (7,) at `f` [Hz] for complex road amplitudes (4,) [m]."""
    M, C, K, K_r, C_r = matrices
    jw = 2j * np.pi * f
    return jw**2 * np.linalg.solve(jw**2 * M + jw * C + K, (K_r + jw * C_r) @ road)


def static_loads(car):
    """Return the loads (strut, tyre) [N] of a front and a rear wheel, by statics."""
    levers = [[2.0, 2.0], [2.0 * car.front.x, 2.0 * car.rear.x]]
    struts = np.linalg.solve(levers, [car.m_b * G, 0.0])
    return struts, struts + 0.5 * G * np.array([car.front.m, car.rear.m])


# --- nonlinear vehicle ----------------------------------------------------------------------------


class CubicCurve:
    """A force curve, PCHIP with linear extrapolation, and its integral."""

    def __init__(self, curve):
        self.inside = PchipInterpolator(curve.x, curve.F)
        self.slope, self.area = self.inside.derivative(), self.inside.antiderivative()
        self.ends = curve.x[0], curve.x[-1]

    def __call__(self, x):
        c = np.clip(x, *self.ends)
        return self.inside(c) + self.slope(c) * (x - c)

    def integral(self, x):
        """Return the integral from 0 to `x`."""
        c = np.clip(x, *self.ends)
        beyond = x - c
        return (
            self.area(c)
            - self.area(0.0)
            + beyond * self.inside(c)
            + 0.5 * beyond**2 * self.slope(c)
        )


NOMINAL = SimpleNamespace(
    **dict.fromkeys(("gas", "damper", "friction", "bushing", "tyre"), (1.0, 1.0, 1.0, 1.0)),
    tyre_progression=0.0,
    roll_stiffness=(0.0, 0.0),
    frame=None,
)


class NonlinearCar:
    """The paper's equations 2 to 8, corrected, in its own notation and axes, and the energies.

    z is positive downwards, pitch beta nose up; positive roll alpha, theta, phi lifts the left
    side. In eq. 7 the left tyre's heave terms are negative. A tyre that would pull has no force,
    and a damper force is limited to the spring force. The order of wheels is lf, rf, lr, rr.
    `variation` has factors of the parts of one manufactured car, tyres of rising secant stiffness,
    bushings between body and axles, and a flexible frame, whose twist is the eighth coordinate.
    """

    def __init__(self, car, variation=NOMINAL):
        self.car, self.strut, self.variation = car, car.strut, variation
        s = car.strut
        self.damper = CubicCurve(s.damper.ride), CubicCurve(s.damper.handling)
        self.friction = CubicCurve(s.friction.ride), CubicCurve(s.friction.handling)
        self.bushing = CubicCurve(s.bushing)
        self.stops = CubicCurve(s.bump_stop.front), CubicCurve(s.bump_stop.rear)
        axles = (car.front, car.front, car.rear, car.rear)
        self.k_t, self.c_t = np.array([[a.k_t, a.c_t] for a in axles]).T
        self.k_t = self.k_t * variation.tyre
        loads = static_loads(car)[1]
        self.delta = np.repeat([loads[0] / car.front.k_t, loads[1] / car.rear.k_t], 2)
        if car.tyre_static_deflection != "equilibrium":
            self.delta[:] = car.tyre_static_deflection

    def gas(self, strut_state, e):
        """Return the gas forces [N] at extensions `e` (4,), linear below the shortest column."""
        s = self.strut
        held, opened = strut_state[:, 0], strut_state[:, 1]
        e_2 = held + opened * e * s.x_2 / (s.x_1 + s.x_2)
        x = s.x_1 + (e - e_2)
        least = np.maximum(x, s.column_min)
        F = np.array(self.variation.gas) * s.p_stat * s.A * (s.x_1 / least) ** s.n_p
        return F * (1.0 - s.n_p * (x - least) / least)

    def strut_forces(self, strut_state, e, e_dot):
        """Return the forces (4,) [N] of the struts, positive in extension."""
        share = strut_state[:, 2]
        d_w, f_w = np.array(self.variation.damper), np.array(self.variation.friction)
        losses = [
            d_w * d(e_dot) + f_w * f(e_dot) for d, f in zip(self.damper, self.friction, strict=True)
        ]
        stops = np.concatenate([self.stops[0](e[:2]), self.stops[1](e[2:])])
        damping = (1.0 - share) * losses[0] + share * losses[1]
        return (
            self.gas(strut_state, e)
            - damping
            - np.array(self.variation.bushing) * self.bushing(e)
            - stops
        )

    def extensions(self, z_b, alpha, beta, z_uf, theta, z_ur, phi, twist=0.0):
        """Return the extensions (4,) of the struts, or their rates, in the paper's coordinates."""
        car = self.car
        fore, aft = alpha + 0.5 * twist, alpha - 0.5 * twist
        b, a, d_f, d_r = car.front.x, -car.rear.x, car.front.y_s, car.rear.y_s
        return np.array(
            [
                (z_uf - d_f * theta) - (z_b - d_f * fore - b * beta),
                (z_uf + d_f * theta) - (z_b + d_f * fore - b * beta),
                (z_ur - d_r * phi) - (z_b - d_r * aft + a * beta),
                (z_ur + d_r * phi) - (z_b + d_r * aft + a * beta),
            ]
        )

    def accelerations(self, strut_state, q, v, z_r, w_r, manoeuvre=None):
        """Return accelerations (7,) in the project's axes, by the corrected equations 2 to 8.

        `manoeuvre`, if given, is (l_roll, l_pitch, a_x, a_y): the body is then an inverted pendulum
        of these lengths [m] in the field of gravity less the accelerations [m/s2].
        """
        car = self.car
        to_paper = np.array([-1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0])[: len(q)]
        now, rate = to_paper * q, to_paper * v
        F_lf, F_rf, F_lr, F_rr = self.strut_forces(
            strut_state, self.extensions(*now), self.extensions(*rate)
        )
        psi = now[7] if len(q) == 8 else 0.0
        R_f = self.variation.roll_stiffness[0] * (now[1] + 0.5 * psi - now[4])
        R_r = self.variation.roll_stiffness[1] * (now[1] - 0.5 * psi - now[6])
        z_b2 = (car.m_b * G - F_rr - F_lr - F_lf - F_rf) / car.m_b  # eq. 2
        M_f = F_lf * car.front.y_s - F_rf * car.front.y_s - R_f
        M_r = F_lr * car.rear.y_s - F_rr * car.rear.y_s - R_r
        alpha2 = (M_f + M_r) / car.I_xx  # eq. 5
        beta2 = ((F_lf + F_rf) * car.front.x - (F_rr + F_lr) * -car.rear.x) / car.I_yy  # eq. 6
        if manoeuvre is not None:
            l_roll, l_pitch, a_x, a_y = manoeuvre
            alpha2 += car.m_b * l_roll * (a_y + G * now[1]) / car.I_xx
            beta2 += car.m_b * l_pitch * (a_x + G * now[2]) / car.I_yy
        axles = []
        struts = [(car.front, F_lf, F_rf, R_f), (car.rear, F_lr, F_rr, R_r)]
        for i, (axle, F_l, F_r, R) in enumerate(struts):
            z, roll, z_1, roll_1 = *now[3 + 2 * i : 5 + 2 * i], *rate[3 + 2 * i : 5 + 2 * i]
            (r_l, r_r), (w_l, w_r_) = -z_r[2 * i : 2 * i + 2], -w_r[2 * i : 2 * i + 2]
            c, d, delta = axle.y_t, axle.y_s, self.delta[2 * i]

            k_l, c_l = self.tyre_coefficients(2 * i, z - c * roll - r_l, z_1 - c * roll_1 - w_l)
            k_r, c_r = self.tyre_coefficients(
                2 * i + 1, z + c * roll - r_r, z_1 + c * roll_1 - w_r_
            )
            left = k_r * z + k_r * c * roll + c_r * z_1 + c_r * c * roll_1  # eq. 3, 4
            left += k_l * z - k_l * c * roll + c_l * z_1 - c_l * c * roll_1
            right = k_r * r_r + c_r * w_r_ - k_r * delta + k_l * r_l + c_l * w_l - k_l * delta
            z_2 = (right + axle.m * G + F_r + F_l - left) / axle.m
            left = -c * k_l * z + c * c * k_l * roll - c * c_l * z_1 + c * c * c_l * roll_1  # 7, 8
            left += c * k_r * z + c * c * k_r * roll + c * c_r * z_1 + c * c * c_r * roll_1
            right = -c * k_l * r_l - c * c_l * w_l + c * k_l * delta
            right += c * k_r * r_r + c * c_r * w_r_ - c * k_r * delta + d * (F_r - F_l)
            axles += [z_2, (right - left + R) / axle.I_xx]
        if len(q) == 8:
            inertia, omega = 0.25 * car.I_xx, 2.0 * np.pi * self.variation.frame.f
            spring = omega**2 * psi + 2.0 * self.variation.frame.zeta * omega * rate[7]
            axles.append(0.5 * (M_f - M_r) / inertia - spring)
        return to_paper * np.array([z_b2, alpha2, beta2, *axles])

    def tyre_coefficients(self, wheel, u, u_1):
        """Return secant stiffness and damping of a tyre at `u` beyond its static deflection."""
        x = u + self.delta[wheel]
        k = self.k_t[wheel] * (1.0 + self.variation.tyre_progression * u)
        if x <= 0.0 or k * x + self.c_t[wheel] * u_1 <= 0.0:
            return 0.0, 0.0
        return (2.0 * k, 0.0) if self.c_t[wheel] * u_1 > k * x else (k, self.c_t[wheel])

    def energy(self, strut_state, q, v, z_r):
        """Return the mechanical energy [J]: kinetic, potential, gas, bushings, stops, tyres."""
        car, s = self.car, self.strut
        masses = np.array([car.m_b, car.I_xx, car.I_yy, car.front.m, car.front.I_xx, car.rear.m,
                           car.rear.I_xx, 0.25 * car.I_xx])[: len(q)]  # fmt: skip
        psi, variation = (q[7] if len(q) == 8 else 0.0), self.variation
        e, y_t = np.empty(4), np.array([1.0, -1.0, 1.0, -1.0])
        wheels = np.empty(4)
        for w, axle in enumerate((car.front, car.front, car.rear, car.rear)):
            height, roll = q[3 + 2 * (w // 2)], q[4 + 2 * (w // 2)]
            body = q[1] + (0.5 if w < 2 else -0.5) * psi
            e[w] = q[0] - axle.x * q[2] - height + y_t[w] * axle.y_s * (body - roll)
            wheels[w] = height + y_t[w] * axle.y_t * roll
        share = 1.0 - strut_state[:, 1] * s.x_2 / (s.x_1 + s.x_2)
        x = s.x_1 + share * e - strut_state[:, 0]
        beyond, x = np.minimum(x - s.column_min, 0.0), np.maximum(x, s.column_min)
        pA = s.p_stat * s.A * np.array(variation.gas)
        if s.n_p == 1.0:
            gas = -pA * s.x_1 / share * np.log(x / s.x_1)
        else:
            n = 1.0 - s.n_p
            gas = -pA * s.x_1**s.n_p / share * (x**n - s.x_1**n) / n
        # below the shortest column the force rises along its tangent
        F = pA * (s.x_1 / x) ** s.n_p
        gas -= (F * beyond - 0.5 * s.n_p * F / x * beyond**2) / share
        stops = (np.array(variation.bushing) * self.bushing.integral(e)).sum()
        stops += self.stops[0].integral(e[:2]).sum() + self.stops[1].integral(e[2:]).sum()
        x, rise = np.maximum(self.delta + z_r - wheels, 0.0), variation.tyre_progression
        tyres = self.k_t * (0.5 * (1.0 - rise * self.delta) * x**2 + rise * x**3 / 3.0)
        position = G * (car.m_b * q[0] + car.front.m * q[3] + car.rear.m * q[5])
        rolls = np.array([q[1] + 0.5 * psi - q[4], q[1] - 0.5 * psi - q[6]])
        turned = 0.5 * np.array(variation.roll_stiffness) @ rolls**2
        if variation.frame is not None:
            turned += 0.5 * 0.25 * car.I_xx * (2.0 * np.pi * variation.frame.f * psi) ** 2
        return 0.5 * masses @ v**2 + position + gas.sum() + stops + tyres.sum() + turned


# --- road, valve, integrator, instruments ---------------------------------------------------------


class SplineRoad:
    """A road as a Catmull-Rom spline through the samples, level outside."""

    def __init__(self, z, ds, start=0.0):
        z = np.pad(np.asarray(z, float), ((0, 0), (3, 3)), mode="edge")
        s = start + ds * (np.arange(z.shape[1]) - 3)
        slope = np.zeros_like(z)
        slope[:, 1:-1] = (z[:, 2:] - z[:, :-2]) / (2.0 * ds)
        self.ends = s[0], s[-1]
        self.z = CubicHermiteSpline(s, z, slope, axis=1)
        self.dz = self.z.derivative()

    def wheel_inputs(self, s, wheelbase, v):
        """Return heights and rates (4,) with the front axle at `s` and the speed `v`."""
        at = np.clip([s, s - wheelbase], *self.ends)
        return self.z(at).T.ravel(), v * self.dz(at).T.ravel()


def trajectory(car, strut_state, road, v, s_0, y_0, times, variation=NOMINAL, **options):
    """Return states (14, N) at `times` by SciPy's `solve_ivp`, with constant strut states."""
    oracle, wheelbase, n = NonlinearCar(car, variation), car.front.x - car.rear.x, len(y_0) // 2

    def rate(t, y):
        z_r, w_r = road.wheel_inputs(s_0 + v * t, wheelbase, v)
        return np.concatenate([y[n:], oracle.accelerations(strut_state, y[:n], y[n:], z_r, w_r)])

    found = solve_ivp(rate, (0.0, times[-1]), y_0, t_eval=times, **options)
    assert found.success
    return found.y


def second_accumulator(e, e_dot, stiff, times, *, u_0, e_2_0, ratio, lag, equalisation):
    """Return the extension e_2(t) of the second accumulator for e(t), commanded at t = 0."""

    def rate(t, y):
        u = y[0]
        flow = u * ratio * e_dot(t) + u * (ratio * e(t) - y[1]) / equalisation
        return [((0.0 if stiff else 1.0) - u) / lag, flow]

    found = solve_ivp(rate, (0.0, times[-1]), [u_0, e_2_0], t_eval=times, rtol=1e-9, atol=1e-12)
    return found.y[1]


def ode23s_step(f, jacobian, f_t, t, y, h):
    """Return the state after one step of the pair of Shampine & Reichelt (1997), section 3.1, with
    full matrices; its error estimate; and a function of x, 0 to 1, the state at t + x h.
    """
    d, e_32 = 1.0 / (2.0 + np.sqrt(2.0)), 6.0 + np.sqrt(2.0)
    W, T, F_0 = np.eye(y.size) - h * d * jacobian(t, y), h * d * f_t(t, y), f(t, y)
    k_1 = np.linalg.solve(W, F_0 + T)
    F_1 = f(t + 0.5 * h, y + 0.5 * h * k_1)
    k_2 = np.linalg.solve(W, F_1 - k_1) + k_1
    F_2 = f(t + h, y + h * k_2)
    k_3 = np.linalg.solve(W, F_2 - e_32 * (k_2 - F_1) - 2.0 * (k_1 - F_0) + T)

    def dense(x):
        return y + h * (x * (1.0 - x) * k_1 + x * (x - 2.0 * d) * k_2) / (1.0 - 2.0 * d)

    return y + h * k_2, h / 6.0 * (k_1 - 2.0 * k_2 + k_3), dense


def point_acceleration(heave, roll, pitch, x, y):
    """Return the vertical part of a + (angular acceleration x lever) at a body point."""
    return heave + np.cross([roll, pitch, 0.0], [x, y, 0.0])[2]


def butterworth_gain(f, f_c, order, fs):
    """Return the gain of a digital Butterworth low-pass (bilinear transform)."""
    warped = np.tan(np.pi * np.asarray(f) / fs) / np.tan(np.pi * f_c / fs)
    return 1.0 / np.sqrt(1.0 + warped ** (2 * order))
