"""The interior-point method of `interior`, compiled: `bordered.c` and `interior.c`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache as remembered
from pathlib import Path
from typing import get_args

import numpy as np

from codegen.build import c_text, load_or_build_library
from codegen.cache import Cache
from hybrid_opt.polishing.drivable import interior
from hybrid_opt.polishing.drivable.interior import Answer, Ending, QuadraticProgram

Method = Callable[[QuadraticProgram, float], Answer]
"""From a program and a tolerance to an answer, as `interior.solve`."""

CONSTANTS = ("ITERATIONS", "REFINED", "TO_BOUNDARY", "PUSH", "LEAST", "ROUNDING")
"""Of `interior`, which the C is filled with."""

_ARRAYS = (
    *("corner", "beside", "diagonal", "off", "g", "border", "column", "left", "right"),
    *("b", "low", "high", "whole"),
)


class _Program(ctypes.Structure):
    """As in `bordered.c`."""

    _fields_ = (
        *((name, ctypes.c_longlong) for name in ("k", "n", "m")),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
        ("tolerance", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("d", "rows", "bounds", "work")),
    )


def interior_method(cache: Cache | None = None) -> Method:
    """The compiled method.

    Args:
        cache: where the library is kept; by default the user's.

    Raises:
        CodegenError: there is no C compiler; or it cannot be compiled, cached or loaded.
    """
    return _method((cache or Cache()).folder)


@remembered
def _method(folder: Path) -> Method:
    constants = {name: getattr(interior, name) for name in CONSTANTS}
    text = c_text("hybrid_opt.polishing.drivable", ["bordered.c", "interior.c"], constants)
    library = load_or_build_library("interior", text, Cache(folder))
    return _Compiled(library)


class _Compiled:
    """The library's method."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._solve, self._work = library.dual_arm_quadratic, library.dual_arm_work
        self._solve.argtypes = [ctypes.c_void_p]
        self._work.argtypes = [ctypes.c_longlong] * 3
        self._solve.restype = self._work.restype = ctypes.c_longlong

    def __call__(self, program: QuadraticProgram, tolerance: float) -> Answer:
        """As `interior.solve`."""
        H, A = program.H, program.A
        k, n, m = len(H.corner), len(H.diagonal), len(A)
        inputs = {
            **{name: getattr(H, name) for name in ("corner", "beside", "diagonal", "off")},
            **{name: getattr(A, name) for name in ("border", "left", "right")},
            **{name: getattr(program, name) for name in ("g", "low", "high")},
            "b": program.right,
        }
        if program.whole is not None:
            inputs["whole"] = program.whole
        arrays = {name: np.ascontiguousarray(v, dtype=float) for name, v in inputs.items()}
        arrays |= {
            "d": np.empty(k + n),
            "rows": np.empty(len(arrays["b"])),
            "bounds": np.empty(k + n),
            "work": np.empty(self._work(k, n, m)),
        }
        column = np.ascontiguousarray(A.column, dtype=np.int64)
        addresses = {name: array.ctypes.data for name, array in arrays.items()}
        asked = _Program(k, n, m, tolerance=tolerance, column=column.ctypes.data, **addresses)
        ending: Ending = get_args(Ending)[self._solve(ctypes.byref(asked))]
        return Answer(arrays["d"], arrays["rows"], arrays["bounds"], ending)
