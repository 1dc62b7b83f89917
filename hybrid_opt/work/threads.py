"""How many threads linear algebra may take."""

from __future__ import annotations

from threadpoolctl import threadpool_limits


def one_thread() -> threadpool_limits:
    """Linear algebra in one thread, to be used with `with`.

    Workers fill the cores, and on matrices as small as ours several threads wait for one another:
    without it a drivable front of two attempts took 18.4 core-seconds in place of 9.3.
    """
    return threadpool_limits(1, user_api="blas")
