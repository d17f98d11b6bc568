"""Preconditioned conjugate gradients for truncated solves.

They end early, by the norm of the preconditioner, which weighs well and badly scaled unknowns
alike. SciPy's `cg` has the Euclidean norm, and does not return the number of iterations.
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
    """Solve A x = b of any shape, with the preconditioner `M`, from `start` or zero, until the
    residual's sqrt(r' M r) is `tolerance` of sqrt(b' M b). Return x and the number of iterations.
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
