"""The dense interior-point method with its steps compiled: `interior.c`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache as remembered
from pathlib import Path

import numpy as np

from codegen.build import c_text, load_or_build_library
from codegen.cache import Cache
from hybrid_opt.polishing import interior, interior_steps
from hybrid_opt.polishing.interior import DenseSolver, Error, State
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers import Answer, Program

Method = Callable[[Program, PolishSettings], Answer]
"""As `interior.dense`."""

_CONSTANTS = {
    name: float(getattr(module, name))
    for module, names in (
        (
            interior,
            ("TO_BOUNDARY", "RAISED", "LEAST", "ARMIJO", "PENALTY", "NEGLIGIBLE", "DISTANT"),
        ),
        (interior_steps, ("SHIFT", "SHIFTED", "LONGEST", "DUAL_RANGE")),
    )
    for name in names
} | dict(zip(("SHORTENED_LEAST", "SHORTENED_MOST"), interior.SHORTENED, strict=True))
"""What the C is filled with."""

_GIVEN = ("row", "sign", "shift", "cost", "low", "high", "inner_low", "inner_high")
_CALLED = ("values", "jacobian", "W")
_STATE = ("z", "slack", "dual", "h", "A")
_FOUND = ("trial", "ruling", "errors", "blocking")


class _Step(ctypes.Structure):
    """As in `interior.c`."""

    _fields_ = (
        *((name, ctypes.c_longlong) for name in ("n", "m")),
        *((name, ctypes.c_void_p) for name in (*_GIVEN, *_CALLED, *_STATE, *_FOUND)),
        ("mu", ctypes.c_double),
        ("work", ctypes.c_void_p),
        *((name, ctypes.c_double) for name in ("price", "before", "slope", "alpha")),
    )


def dense_method(cache: Cache | None = None) -> Method:
    """The compiled method.

    Args:
        cache: where the library is kept; by default the user's.

    Raises:
        CodegenError: there is no C compiler; or it cannot be compiled, cached or loaded.
    """
    return _method((cache or Cache()).folder)


@remembered
def _method(folder: Path) -> Method:
    text = c_text("hybrid_opt.polishing", ["interior.c"], _CONSTANTS)
    library = load_or_build_library("dense_interior", text, Cache(folder))
    steps = _Steps(library)
    return lambda program, settings: CompiledSolver(program, settings, steps).solve()


class _Steps:
    """The library's functions; each takes the address of a `_Step`."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.work = library.dual_arm_dense_work
        self.work.argtypes, self.work.restype = [ctypes.c_longlong] * 2, ctypes.c_longlong
        self.ruling = self._named(library, "ruling", None)
        self.direction = self._named(library, "direction", ctypes.c_longlong)
        self.judge = self._named(library, "judge", ctypes.c_longlong)
        self.heed = self._named(library, "heed", ctypes.c_longlong)
        self.move = self._named(library, "move", None)
        self.errors = self._named(library, "errors", None)

    @staticmethod
    def _named(
        library: ctypes.CDLL, name: str, result: type[ctypes.c_longlong] | None
    ) -> Callable[[int], int]:
        function = library[f"dual_arm_dense_{name}"]
        function.argtypes, function.restype = [ctypes.c_void_p], result
        called: Callable[[int], int] = function
        return called


class CompiledSolver(DenseSolver):
    """One solve of one program, its steps in C, which works on the iterate's own arrays."""

    def __init__(self, program: Program, settings: PolishSettings, steps: _Steps) -> None:
        super().__init__(program, settings)
        self._steps = steps

    def _start(self) -> State:
        now, rows = super()._start(), self._rows
        m, n = now.A.shape
        n_rows, wide = len(self._program.below), -(-n // _VECTOR) * _VECTOR
        A = np.zeros((m, wide))
        A[:, :n] = now.A
        self._values, self._jacobian = np.empty(n_rows), np.empty((n_rows, n))
        self._W, self._trial = np.empty((n, n)), np.empty(n)
        self._ruling, self._errors = np.zeros(n_rows), np.empty(4)
        arrays: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]] = {
            "row": rows.rows.astype(np.int64),
            "sign": rows.sign,
            "shift": rows.shift,
            "cost": self._program.cost,
            "low": self._low,
            "high": self._high,
            "inner_low": self._inner[0],
            "inner_high": self._inner[1],
            "values": self._values,
            "jacobian": self._jacobian,
            "W": self._W,
            **{name: getattr(now, name) for name in ("z", "slack", "dual", "h")},
            "A": A,
            "trial": self._trial,
            "ruling": self._ruling,
            "errors": self._errors,
            "blocking": np.zeros(m, dtype=np.int8),
            "work": np.empty(self._steps.work(n, m)),
        }
        self._arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        addresses = {name: array.ctypes.data for name, array in self._arrays.items()}
        self._step = _Step(n, m, mu=self._mu, price=0.0, **addresses)
        self._address = ctypes.addressof(self._step)
        z, slack, dual, h = (self._arrays[name] for name in ("z", "slack", "dual", "h"))
        return State(z, slack, dual, h, A[:, :n])

    def _error(self, now: State) -> Error:
        self._steps.errors(self._address)
        return Error(*self._errors.tolist())

    def _advance(self, now: State) -> bool:
        steps, step, program = self._steps, self._address, self._program
        self._step.mu = self._mu
        steps.ruling(step)
        self._W[...] = program.curvature(now.z, self._ruling)
        if not steps.direction(step):
            return False
        for _ in range(interior.TRIALS):
            self._values[...] = program.values(self._trial)
            if steps.judge(step) == _TAKEN:
                self._jacobian[...] = program.constraints(self._trial)[1]
                steps.move(step)
                return True
        return bool(steps.heed(step))


_VECTOR, _TAKEN = 8, 0
"""As in `interior.c`."""
