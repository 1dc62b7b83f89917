"""One attempt of a solver, whatever comes of it.

An exception is caught here. What ends or blocks the process, a crash or a hang, is noticed by those
who gave it the work (`hybrid_opt.work`); they put down the attempt as `Lost` and go on after it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import casadi

from hybrid_opt.polishing.point import Solution


@dataclass(frozen=True)
class Lost:
    """An attempt without a solution; reason: killed, timeout, or what was raised."""

    reason: str


def solve_safely(solve: Callable[[], Solution]) -> Solution | Lost:
    """The solution, or what was raised instead."""
    try:
        return solve()
    except Exception as error:
        return Lost(f"{type(error).__name__}: {error}".splitlines()[0])


def use_one_thread() -> None:
    """Keep IPOPT's BLAS from spinning on cores that other workers use: its matrices are too small
    for threads. It is loaded with the first solve, too late for `hybrid_opt.work.threads`."""
    for library in Path(casadi.__file__).parent.glob("*openblas*.so*"):
        with suppress(OSError, AttributeError):
            ctypes.CDLL(str(library)).openblas_set_num_threads(1)
