"""Linear algebra on one thread, where the products are too small for several to help."""

from contextlib import ContextDecorator

from threadpoolctl import threadpool_limits


def single_blas_thread() -> ContextDecorator:
    """Return a decorator that keeps BLAS to one thread inside a function."""
    limit: ContextDecorator = threadpool_limits.wrap(limits=1, user_api="blas")
    return limit
