"""Linear algebra on one thread, where the products are too small for several to help."""

from collections.abc import Iterator
from contextlib import contextmanager

from road_envs.core.extras import optional_import


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Keep BLAS to one thread inside the block, or inside the function that this decorates.

    Raises MissingExtraError without threadpoolctl.
    """
    with optional_import("fitting"):
        from threadpoolctl import threadpool_limits
    with threadpool_limits(limits=1, user_api="blas"):
        yield
