"""How many threads linear algebra may take."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from functools import lru_cache

from threadpoolctl import ThreadpoolController


def one_thread() -> AbstractContextManager[object]:
    """Linear algebra in one thread, to be used with `with`.

    Workers fill the cores, and on matrices as small as ours several threads wait for one another:
    without it a drivable front of two attempts took 18.4 core-seconds in place of 9.3.
    """
    limited: AbstractContextManager[object]
    limited = _controller(len(sys.modules)).limit(limits=1, user_api="blas")
    return limited


@lru_cache(maxsize=1)
def _controller(modules: int) -> ThreadpoolController:
    """Controller of the libraries loaded with this number of modules: a new one takes 4 ms."""
    return ThreadpoolController()
