"""Solution of the linear system of a step: each axle is eliminated as a 2 x 2 block.

What remains is a 3 x 3 system for the body (Schur complement). The matrix M + h d C + (h d)² K of
`rosenbrock` is never assembled. With LANES vehicles every array has the lanes as its last axis.
"""

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd_arrays import add, get, put
from road_envs.vehicle.equations import AXLE, PHI, THETA, Z_B
from road_envs.vehicle.parameters import GRAVITY


@kernel
def factorize(p, s, t, hd, blocks, body):
    """Factorize M + h d C + (h d)² K: axles to `blocks` (12,), the body's LDL' to `body` (6,).

    `s`, `t` (4,) are h d c + (h d)² k of each strut and tyre. For each axle `blocks` holds N, the
    inverse of the axle's own block (n00, n01, n11), and S (s0, s1, s2); -S P is the coupling of
    axle and body, where P maps the body's coordinates to heave and roll at the axle. The Schur
    complement of the body is M_b + sum P' (S - S N S) P.
    """
    a00 = get(p.M, Z_B)
    a01 = a02 = a12 = 0.0 * a00
    a11 = get(p.M, PHI) - hd * hd * GRAVITY * get(p.roll_moment)
    a22 = get(p.M, THETA) - hd * hd * GRAVITY * get(p.pitch_moment)
    for i in range(2):
        left, right, a = 2 * i, 2 * i + 1, AXLE + 2 * i
        y_s, y_t, x = get(p.y_s, left), get(p.y_t, left), get(p.x, i)
        s0, t0 = get(s, left) + get(s, right), get(t, left) + get(t, right)
        s1 = y_s * (get(s, left) - get(s, right))
        s2 = y_s * y_s * s0 + hd * hd * get(p.k_roll, i)
        t1, t2 = y_t * (get(t, left) - get(t, right)), y_t * y_t * t0
        b00, b01, b11 = get(p.M, a) + s0 + t0, s1 + t1, get(p.M, a + 1) + s2 + t2
        det = 1.0 / (b00 * b11 - b01 * b01)
        n00, n01, n11 = b11 * det, -b01 * det, b00 * det
        put(blocks, 6 * i, n00)
        put(blocks, 6 * i + 1, n01)
        put(blocks, 6 * i + 2, n11)
        put(blocks, 6 * i + 3, s0)
        put(blocks, 6 * i + 4, s1)
        put(blocks, 6 * i + 5, s2)
        m00, m01 = n00 * s0 + n01 * s1, n00 * s1 + n01 * s2
        m10, m11 = n01 * s0 + n11 * s1, n01 * s1 + n11 * s2
        r00, r01, r11 = s0 - s0 * m00 - s1 * m10, s1 - s0 * m01 - s1 * m11, s2 - s1 * m01 - s2 * m11
        a00 = a00 + r00
        a01 = a01 + r01
        a02 = a02 - x * r00
        a11 = a11 + r11
        a12 = a12 - x * r01
        a22 = a22 + x * x * r00
    d0 = 1.0 / a00
    l1, l2 = a01 * d0, a02 * d0
    d1 = 1.0 / (a11 - a01 * l1)
    low = a12 - a01 * l2
    put(body, 0, d0)
    put(body, 1, l1)
    put(body, 2, l2)
    put(body, 3, d1)
    put(body, 4, low * d1)
    put(body, 5, 1.0 / (a22 - a02 * l2 - low * low * d1))


@kernel
def solve_factored(p, blocks, body, g):
    """Replace the right-hand side `g` (7,) by the solution, with the factors of `factorize`."""
    z, phi, theta = get(g, Z_B), get(g, PHI), get(g, THETA)
    for i in range(2):
        a, k = AXLE + 2 * i, 6 * i
        n00, n01, n11 = get(blocks, k), get(blocks, k + 1), get(blocks, k + 2)
        s0, s1, s2 = get(blocks, k + 3), get(blocks, k + 4), get(blocks, k + 5)
        h0 = n00 * get(g, a) + n01 * get(g, a + 1)
        h1 = n01 * get(g, a) + n11 * get(g, a + 1)
        put(g, a, h0)
        put(g, a + 1, h1)
        push = s0 * h0 + s1 * h1
        z = z + push
        phi = phi + s1 * h0 + s2 * h1
        theta = theta - get(p.x, i) * push
    phi = phi - get(body, 1) * z
    theta = (theta - get(body, 2) * z - get(body, 4) * phi) * get(body, 5)
    phi = phi * get(body, 3) - get(body, 4) * theta
    z = z * get(body, 0) - get(body, 1) * phi - get(body, 2) * theta
    put(g, Z_B, z)
    put(g, PHI, phi)
    put(g, THETA, theta)
    for i in range(2):
        a, k = AXLE + 2 * i, 6 * i
        n00, n01, n11 = get(blocks, k), get(blocks, k + 1), get(blocks, k + 2)
        s0, s1, s2 = get(blocks, k + 3), get(blocks, k + 4), get(blocks, k + 5)
        heave = z - get(p.x, i) * theta
        f0, f1 = s0 * heave + s1 * phi, s1 * heave + s2 * phi
        add(g, a, n00 * f0 + n01 * f1)
        add(g, a + 1, n01 * f0 + n11 * f1)
