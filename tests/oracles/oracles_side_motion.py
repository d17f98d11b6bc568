"""Roll with side motion: mass, damping and stiffness matrices from energies, in fixed axes.

No package under test is imported. `car`: any object with the attributes of `VehicleParameters`.
"""

import numpy as np


def camber(car, i):
    """Return the lean of the wheels of axle i by phi and phi_a: a wheel at the end of its arm."""
    axle = car.axles[i]
    if axle.kind == "solid":
        return np.array([0.0, 1.0])
    # an arm of the length l, hinged at l from the wheel to a body that rolls by phi: the hinge
    # rises by (y_t - l) phi, the wheel by y_t phi_a
    arm = car.side.swing_arm[i]
    return np.array([arm - axle.y_t, axle.y_t]) / arm


def lagrangian_matrices(car, v):
    """Return M, D, K (11, 11) of z_b, phi, theta, z_f, phi_f, z_r, phi_r, y, psi and the axles' own
    displacements, and the contacts' side displacements, from energies written out for this test.
    """
    s, axles = car.side, car.axles
    k = np.array([car.strut.front.spring.k, car.strut.rear.spring.k])
    c = [d.F[-1] / d.x[-1] for d in (car.strut.front.damper, car.strut.rear.damper)]
    M, D, K = np.zeros((3, 11, 11))
    np.fill_diagonal(M, [car.m_b, car.I_xx, car.I_yy, *np.zeros(4), car.m_b, s.I_zz, 0.0, 0.0])
    contacts = []
    weight = car.m_b * 9.81 * np.array([-axles[1].x, axles[0].x]) / car.wheelbase
    for i, (axle, h) in enumerate(zip(axles, s.roll_centre, strict=True)):
        z, r = 3 + 2 * i, 4 + 2 * i
        M[z, z], M[r, r] = M[z, z] + axle.m, M[r, r] + axle.I_xx
        centre, contact = np.zeros((2, 11))
        centre[[7, 8, 9 + i]] = 1.0, axle.x, 1.0
        centre[[1, r]] = np.array([car.h_cg - h, h]) - s.wheel_radius * camber(car, i)
        contact[[1, r, 7, 8, 9 + i]] = car.h_cg - h, h, 1.0, axle.x, 1.0
        K[9 + i, 9 + i], D[9 + i, 9 + i] = s.joint_stiffness[i], s.joint_damping[i]
        M += axle.m * np.outer(centre, centre)
        if s.fore_and_aft:  # the body's weight stands ahead of the wheels' centres
            lever = car.h_cg - s.wheel_radius
            M[2, 2] += axle.m * lever**2
            K[2, 2] -= weight[i] * lever
        contacts.append(contact)
        for sign in (1.0, -1.0):
            e, u = np.zeros((2, 11))
            e[[0, 1, 2, z, r]] = 1.0, sign * axle.y_s, -axle.x, -1.0, -sign * axle.y_s
            u[[z, r]] = 1.0, sign * axle.y_t
            K += k[i] * np.outer(e, e) + axle.k_t * np.outer(u, u)
            D += c[i] * np.outer(e, e) + axle.c_t * np.outer(u, u)
        bar = np.zeros(11)
        bar[[1, r]] = 1.0, -1.0
        K += axle.k_roll * np.outer(bar, bar)
        # a body held at its roll centre loses height by (h_cg - h) phi² / 2; so does an axle
        K[1, 1] -= weight[i] * (car.h_cg - h)
        K[r, r] -= weight[i] * h + axle.m * 9.81 * s.wheel_radius * camber(car, i)[1] ** 2
    n = 11 if s.has_joints else 9  # rigid joints: without these two
    return M[:n, :n], D[:n, :n], K[:n, :n], [contact[:n] for contact in contacts]


def independent_roll(car, f, v):
    """Return roll acceleration per difference of paths by the matrices above, in fixed axes."""
    M, D, K, contacts = lagrangian_matrices(car, v)
    found = []
    for frequency in f:
        s = 2j * np.pi * frequency
        Z = s**2 * M + s * D + K
        for a, p in enumerate(contacts):
            C, sigma = car.side.C_alpha[a], car.side.relaxation[a]
            slip = s * p - v * np.eye(p.size)[8]  # in fixed axes the heading is psi
            Z = Z + 2.0 * C * np.outer(p, slip) / (sigma * s + v)
            # in axes that go with the car, F acts on V and r: the same to first order
        push = np.zeros(len(M), dtype=complex)
        for a, axle in enumerate(car.axles):
            delay = np.exp(-s * car.wheelbase / v) if a else 1.0
            stiffness = axle.k_t + s * axle.c_t
            push[4 + 2 * a] += delay * axle.y_t * stiffness * 2.0
        found.append(s**2 * np.linalg.solve(Z, push)[1])
    return np.array(found)
