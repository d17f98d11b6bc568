"""Preconditioned conjugate gradients for truncated solves.

SciPy's `cg` stops on the Euclidean norm of the residual and does not return the number of
iterations. The solves here end early, by the norm of the preconditioner: it weighs well and badly
scaled unknowns alike, and the result of an unfinished solve depends on where it ends.
"""

from collections.abc import Callable

import numpy as np

Operator = Callable[[np.ndarray], np.ndarray]


def conjugate_gradients(
    A: Operator,
    b: np.ndarray,
    M: Operator,
    max_iterations: int,
    tolerance: float,
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, int]:
    """Solve A x = b approximately from `start` or zero; return x and the number of iterations.

    `b` may have any shape. `M` is the preconditioner. Ends after `max_iterations`, or when
    sqrt(r' M r) of the residual r has fallen to `tolerance` of sqrt(b' M b).
    """
    x, r, z = np.zeros_like(b), b.copy(), M(b)
    rz = float(np.vdot(r, z))
    target = tolerance**2 * rz
    if start is not None:
        x, r = start.copy(), b - A(start)
        z = M(r)
        rz = float(np.vdot(r, z))
    p = z.copy()
    for k in range(max_iterations):
        if not rz > target:
            return x, k
        Ap = A(p)
        alpha = rz / float(np.vdot(p, Ap))
        x += alpha * p
        r -= alpha * Ap
        z = M(r)
        rz, before = float(np.vdot(r, z)), rz
        p = z + (rz / before) * p
    return x, max_iterations
