"""Whole evaluations in lanes: from decision vectors to what is left for FCL.

`kernel.c` calls the cell's functions sample by sample, several candidates side by side, sums up the
violations, bounds every pair's distance, and proves of most pairs that the bounds leave open that
they are apart or intersect. Quantities per sample leave it only where they are asked for.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.compiled import thread_pool, warn_one_lane
from codegen.errors import CodegenError
from codegen.function import available_cores
from codegen.program import load_or_build_program
from hybrid_opt.collision.checker import CollisionChecker
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.kernel_data import (
    BatchData,
    configuration_size,
    judge_arrays,
    judge_data,
    open_pair,
)
from hybrid_opt.evaluate.sampled import SampledVerdicts, one_by_one
from symbolic.array import Array
from symbolic.functions import (
    CONSTRAINTS,
    FORCE_CONSTRAINTS,
    force_sizes,
    forces_come_last,
    sample_sizes,
)
from symbolic.geometry.pairs import CellGeometry

_LEAST_ROOM = 4096
"""Open pairs that are collected before they are handed on, beside those of one pass."""


class Kernel:
    """A cell's evaluation in lanes. Not to be shared between threads, as its checker.

    Attributes:
        lanes: candidates side by side.
    """

    def __init__(self, library: ctypes.CDLL, checker: CollisionChecker) -> None:
        """Prepare the shapes; `load_kernel` gives the library."""
        self._evaluate = library.dual_arm_evaluate
        self._evaluate.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_longlong]
        self._evaluate.restype = ctypes.c_longlong
        self.lanes = int(library.dual_arm_lanes())
        self._checker = checker
        workcell = checker.geometry.workcell
        self._samples = workcell.task.samples
        self._sizes = sample_sizes(workcell)
        self._open_pair = open_pair(workcell)
        self._keep = judge_arrays(checker)
        self._judge = judge_data(checker, self._keep)
        self._room = self.lanes * self._samples * len(checker.geometry.active) + _LEAST_ROOM

    def evaluate(
        self,
        x: Array,
        wanted: Sequence[str] = (),
        with_collisions: bool = True,
        threads: int = 1,
        begin: Array | None = None,
        all_forces: bool = False,
    ) -> SampledVerdicts:
        """Evaluate decision vectors (n, n_var).

        Args:
            wanted: of `sample_sizes`, what is needed per sample.
            with_collisions: False leaves collisions out.
            begin: joints of both arms, side by side, that hold the box at the start; None for
                those of the cell's start branches.
            threads: to spread the candidates over; 0 for one per core. Has no influence on the
                results; FCL's part runs in the calling thread.
            all_forces: False leaves forces at zero, in cells whose forces a program finds, where
                something else is violated already.

        Raises:
            CodegenError: memory is short.
        """
        n, samples = len(x), self._samples
        outputs = {
            "time": np.empty((n, samples)),
            "violation": np.empty((n, len(CONSTRAINTS))),
            "violation_time": np.empty((n, len(CONSTRAINTS))),
        }
        asked = {name: np.empty((n, samples, self._sizes[name])) for name in wanted}
        whole = {name: np.empty(n, np.int64) for name in ("first_sample", "first_reason")}
        extra: dict[str, NDArray[Any]] = {
            "x": x,
            "reached": np.empty(n, np.int64),
            "colliding": np.zeros((n, samples), dtype=np.uint8),
        }
        arrays: dict[str, NDArray[Any]] = {**outputs, **whole, **extra}
        n_threads = min(threads or available_cores(), max(n // self.lanes, 1))
        bounds = [n * k // n_threads for k in range(n_threads + 1)]

        def run(first: int, end: int) -> list[NDArray[np.void]]:
            rows = slice(first, end)
            addresses = [
                asked[name][rows].ctypes.data if name in asked else None for name in self._sizes
            ]
            found = self._run(
                {k: v[rows] for k, v in arrays.items()},
                addresses,
                begin,
                with_collisions=with_collisions,
                all_forces=all_forces,
            )
            for part in found:
                part["candidate"] += first
            return found

        if n_threads == 1:
            found = [run(0, n)]
        else:
            found = list(thread_pool().map(run, bounds[:-1], bounds[1:]))
        colliding = extra["colliding"].view(np.bool_)
        # One part at a time: NumPy takes long to join records.
        for left in (part for parts in found for part in parts if len(part)):
            hit = self._judged(left)
            colliding[left["candidate"][hit], left["sample"][hit]] = True
        # A scalar per sample has no axis of its own.
        outputs |= {
            name: values[:, :, 0] if self._sizes[name] == 1 else values
            for name, values in asked.items()
        }
        return SampledVerdicts(outputs, colliding=colliding, **whole)

    def _run(
        self,
        arrays: Mapping[str, NDArray[Any]],
        wanted: Sequence[int | None],
        begin: Array | None,
        **choices: bool,
    ) -> list[NDArray[np.void]]:
        """The kernel on candidates of one thread; the pairs that it leaves open."""
        n = len(arrays["x"])
        room = np.empty(self._room if choices["with_collisions"] else 0, self._open_pair)
        pointers = (ctypes.c_void_p * len(wanted))(*wanted)
        batch = BatchData(
            n=n,
            begin=None if begin is None else begin.ctypes.data,
            room=self._room,
            wanted=ctypes.addressof(pointers),
            open=room.ctypes.data,
            **choices,
            **{name: array.ctypes.data for name, array in arrays.items()},
        )
        at, found = 0, []
        while at < n:
            at = self._evaluate(ctypes.byref(batch), ctypes.byref(self._judge), at)
            if at < 0:
                raise CodegenError(
                    "candidates cannot be evaluated: memory is short; evaluate fewer at once"
                )
            found.append(room[: batch.n_open].copy())
        return found

    def _judged(self, left: NDArray[np.void]) -> NDArray[np.bool_]:
        """FCL's word on open pairs, at least one."""
        # Pairs of one sample lie side by side: placed once.
        place = left["candidate"] * self._samples + left["sample"]
        new = np.concatenate([[True], place[1:] != place[:-1]])
        configuration = left["configuration"][new]
        pose, q_1, q_2 = self._checker.split(configuration)
        rows = (np.cumsum(new) - 1).tolist()
        return np.array(self._checker.collisions(pose, q_1, q_2, rows, left["pair"].tolist()))


def load_kernel(
    compiled: CompiledCell,
    checker: CollisionChecker,
    outputs: Callable[[Array], Mapping[str, Array]],
    lanes: int = 0,
) -> Kernel | None:
    """The kernel of a cell that was read from a file.

    It is only used where it gives the bits of the functions that it is made of.

    Args:
        outputs: of decision vectors, as the candidate function has them.
        lanes: candidates side by side; 0 for what suits the machine.

    Returns:
        None where there can be no kernel; with one warning where it can be but fails.
    """
    if not compiled.is_identified:
        return None

    def make() -> Mapping[str, Any]:
        from symbolic.functions import kernel_functions

        return kernel_functions(compiled.model)

    own = _definitions(checker.geometry) + "".join(
        files("hybrid_opt").joinpath(*path).read_text()
        for path in (("collision", "prejudge.c"), ("evaluate", "kernel.c"))
    )
    library = load_or_build_program(
        "kernel", compiled.key("kernel"), make, own, compiled.cache, lanes
    )
    if library is None:
        return None
    kernel = Kernel(library, checker)
    task = compiled.workcell.task
    x = np.random.default_rng(0).uniform(task.lower, task.upper, (kernel.lanes + 1, task.n_var))
    every = tuple(sample_sizes(compiled.workcell))
    if _same(kernel.evaluate(x, every, all_forces=True), one_by_one(outputs(x), checker)):
        return kernel
    warn_one_lane("kernel", "it differs from the functions that it is made of")
    return None


def _same(found: SampledVerdicts, expected: SampledVerdicts) -> bool:
    """Whether two evaluations agree to the last bit, in all that the first one has."""
    pairs = [(values, expected.outputs[name]) for name, values in found.outputs.items()]
    pairs += [
        (getattr(found, name), getattr(expected, name))
        for name in ("first_sample", "first_reason", "colliding")
    ]
    return all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)


def _definitions(geometry: CellGeometry) -> str:
    """The numbers that kernel.c is written for."""
    workcell = geometry.workcell
    sizes = sample_sizes(workcell)
    ends = np.cumsum(list(sizes.values()))
    starts = dict(zip(sizes, [0, *ends.tolist()], strict=False))
    joints = [arm.joints for arm in geometry.arms]
    numbers = {
        "N_VAR": workcell.task.n_var,
        "N_SAMPLES": workcell.task.samples,
        "POSE_SIZE": workcell.task.extended_size,
        "MOST_JOINTS": max(joints),
        "CONFIGURATION": configuration_size(workcell),
        "N_PAIRS": len(geometry.active),
        "N_PIECES": sum(len(body.pieces) for body in geometry.bodies),
        "N_CONSTRAINTS": len(CONSTRAINTS),
        "N_OUTPUTS": len(sizes),
        "SAMPLE_SIZE": sum(sizes.values()),
        "CONSTRAINT_AT": starts["constraint"],
        "CONSTRAINT_OUTPUT": list(sizes).index("constraint"),
    }
    lists = {
        "N_JOINTS": joints,
        "OUTPUT_SIZE": list(sizes.values()),
        "OUTPUT_AT": list(starts.values()),
        "Q_AT": [starts["q_1"], starts["q_2"]],
        "LOST_AT": [starts["lost_1"], starts["lost_2"]],
    }
    if forces_come_last(workcell):
        of_forces = force_sizes(workcell)
        ends = np.cumsum(list(of_forces.values()))
        numbers |= {
            "FORCES_COME_LAST": 1,
            "N_FORCES": len(of_forces) - 1,
            "FORCES_SIZE": sum(of_forces.values()),
            "N_FORCE_CONSTRAINTS": len(FORCE_CONSTRAINTS),
        }
        lists |= {
            "FORCES_AT": [0, *ends[:-1].tolist()],
            "FORCES_OUTPUT": [list(sizes).index(name) for name in list(of_forces)[:-1]],
        }
    lines = [f"#define {name} {value}" for name, value in numbers.items()]
    for name, values in lists.items():
        entries = ", ".join(map(str, values))
        lines.append(f"static const int {name}[{len(values)}] = {{{entries}}};")
    return "\n".join(lines) + "\n"
