"""Constraint violations and collisions of candidates on their samples.

The compiled `kernel.c` evaluates several candidates side by side (in lanes). It calls the cell's
functions sample by sample, sums up the violations, and computes a lower bound of every pair's
distance. For pairs that the bound leaves open Coal tries a proof; FCL decides the rest. Quantities
per sample are returned only on request.

`evaluate_numpy` computes the same in NumPy from the outputs of the candidate function. It is the
reference of the kernel, and evaluates the candidates of drivable cells, whose carries are timed
from rest to rest within all limits.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.build import load_or_build_program
from codegen.errors import CodegenError, FormError
from codegen.function import available_cores
from codegen.native import OTHER_COMPILER, thread_pool, warn_one_lane
from hybrid_opt.collision.checker import PROOF_MARGIN, CollisionChecker
from hybrid_opt.collision.joint_tables import CELLS, CELLS_PER_RADIAN, MOST_ANGLE
from hybrid_opt.collision.solids import compiled_distances
from hybrid_opt.compiled_cell import CompiledCell
from symbolic.array import Array
from symbolic.functions import (
    CONSTRAINTS,
    FORCE_CONSTRAINTS,
    force_sizes,
    forces_come_last,
    kernel_functions,
    kernel_numbers,
    sample_sizes,
)
from symbolic.geometry.pairs import CellGeometry
from symbolic.records import POSE_SIZE, Workcell

_LEAST_ROOM = 4096
"""Number of open pairs for which there is room beyond those of one pass."""

_RESTING = np.dtype([("pair", np.int64), ("place", np.float64, 3), ("departure", np.float64)])

_TABLE = np.dtype([("bounds", np.uintp), ("robot", np.int64), ("joint", np.int64)])


@dataclass(frozen=True)
class SampledVerdicts:
    """Constraint violations and collisions of n candidates on their samples.

    Attributes:
        outputs: 'time' (n, samples) [s], 'violation' and 'violation_time' (n, constraints), and
            further outputs of `symbolic.functions.candidate_function` on request.
        first_sample: (n,) index of the first sample that violates a constraint; the number of
            samples if there is none.
        first_reason: (n,) index of the first constraint violated at this sample; -1 if there is
            none.
        colliding: (n, samples) True for samples in collision. Samples after an arm has lost the
            path are False.
    """

    outputs: Mapping[str, Array]
    first_sample: NDArray[np.int64]
    first_reason: NDArray[np.int64]
    colliding: NDArray[np.bool_]


def evaluate_numpy(outputs: Mapping[str, Array], checker: CollisionChecker) -> SampledVerdicts:
    """Compute violations and collisions of n candidates in NumPy.

    Args:
        outputs: all per-sample outputs of the candidate function, (n, samples, ...) by name.
        checker: collision checker of the workcell.
    """
    violated = np.asarray(outputs["constraint"] > 0.0)
    bad = np.asarray(np.any(violated, axis=2))
    n, samples = bad.shape
    first = np.where(bad.any(axis=1), np.argmax(bad, axis=1), samples)
    at = np.minimum(first, samples - 1)
    reason = np.where(first < samples, np.argmax(violated[np.arange(n), at], axis=1), -1)
    colliding = np.zeros((n, samples), dtype=bool)
    totals = np.column_stack([outputs["violation"], outputs["time"]])
    finite = np.isfinite(totals).all(axis=1)
    for row in np.flatnonzero(finite).tolist():
        placed = reached_samples(outputs, row)
        colliding[row, : len(placed[0])] = checker.check(*placed).colliding
    return SampledVerdicts(outputs, first, reason, colliding)


def reached_samples(outputs: Mapping[str, Array], row: int) -> tuple[Array, Array, Array]:
    """Return the motion of a candidate before the first sample at which an arm does not reach the
    box.

    Only these k samples are checked for collisions.

    Args:
        outputs: per-sample outputs of the candidate function for a batch of candidates.
        row: index of the candidate in the batch.

    Returns:
        Box poses (k, 6) [m, rad]; joint positions (k, joints) of the first and of the second arm
        [rad or m].
    """
    lost = (outputs["lost_1"][row] > 0.0) | (outputs["lost_2"][row] > 0.0)
    reached = int(np.argmax(lost)) if lost.any() else len(lost)
    pose, q_1, q_2 = (outputs[name][row, :reached] for name in ("pose", "q_1", "q_2"))
    return pose, q_1, q_2


def collision_shares(colliding: NDArray[np.bool_], time: Array) -> Array:
    """Compute the share (n,) of the duration that n candidates spend in collision.

    A colliding sample counts with half of each neighbouring time step.

    Args:
        colliding: (n, samples) True for samples in collision.
        time: (n, samples) times of the samples [s].
    """
    shares, halves = np.zeros(len(time)), np.diff(time) / 2.0
    durations = np.zeros(time.shape)
    durations[:, :-1] += halves
    durations[:, 1:] += halves
    for row in np.flatnonzero(colliding.any(axis=1)).tolist():
        shares[row] = durations[row, colliding[row]].sum() / time[row, -1]
    return shares


class Kernel:
    """Compiled evaluation of several candidates side by side, in lanes.

    Threads must not share one, because it owns a checker.

    Attributes:
        lanes: number of candidates evaluated side by side.
    """

    def __init__(
        self, library: ctypes.CDLL, checker: CollisionChecker, numbers: Array, start: Array
    ) -> None:
        """Prepare the evaluation of one cell: its collision shapes, parameters and start postures.

        Args:
            library: compiled kernel, from `load_kernel`.
            checker: collision checker, which decides the pairs that the kernel leaves open.
            numbers: (n,) parameters of the cell, group after group.
            start: (joints of both arms,) joint positions of the first arm, then of the second, that
                hold the box at the start [rad].
        """
        self._evaluate = library.dual_arm_evaluate
        self._evaluate.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_longlong]
        self._evaluate.restype = ctypes.c_longlong
        self.lanes = int(library.dual_arm_lanes())
        self._checker, self._numbers, self._start = checker, numbers, start
        workcell = checker.geometry.workcell
        self._samples = workcell.task.samples
        self._sizes = sample_sizes(workcell)
        self._open_pair = open_pair(workcell)
        self._judge, self._kept = _judge_data(checker)
        self._room = self.lanes * self._samples * len(checker.geometry.possible) + _LEAST_ROOM

    def evaluate(
        self,
        x: Array,
        wanted: Sequence[str] = (),
        with_collisions: bool = True,
        threads: int = 1,
        begin: Array | None = None,
        all_forces: bool = False,
    ) -> SampledVerdicts:
        """Evaluate decision vectors on their samples.

        Args:
            x: (n, n_var) decision vectors.
            wanted: names of the outputs to be returned per sample, all of them in `sample_sizes`.
            with_collisions: False to skip the collision check.
            threads: number of threads; 0 for one per core. The results do not depend on it. FCL
                runs in the calling thread.
            begin: (joints of both arms,) joint positions that hold the box at the start [rad]; None
                for the cell's start branches.
            all_forces: has an effect only in cells whose contact forces are computed by an
                optimisation. True computes the forces of all candidates. False leaves them at zero
                for candidates that violate another constraint.

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
        """Run the compiled kernel on the candidates of one thread. Return the pairs of bodies that
        the library FCL has to decide.

        Args:
            arrays: inputs and outputs of the kernel by name, one row per candidate.
            wanted: addresses of the arrays of per-sample outputs; None for outputs that are not
                wanted.
            begin: (joints of both arms,) joints at the start [rad]; None for the cell's start
                branches.
            choices: `with_collisions` and `all_forces` as in `evaluate`.
        """
        n = len(arrays["x"])
        room = np.empty(self._room if choices["with_collisions"] else 0, self._open_pair)
        pointers = (ctypes.c_void_p * len(wanted))(*wanted)
        batch = BatchData(
            n=n,
            begin=(self._start if begin is None else begin).ctypes.data,
            numbers=self._numbers.ctypes.data,
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
        """Decide by the collision checker which of n pairs of bodies collide.

        Args:
            left: (n,) records `open_pair` of the pairs that the kernel could not decide, n at least
                1.

        Returns:
            (n,) True for pairs in collision.
        """
        configuration = self._checker.split(left["configuration"])
        return self._checker.collisions(*configuration, np.arange(len(left)), left["pair"])


def load_kernel(
    compiled: CompiledCell,
    checker: CollisionChecker,
    outputs: Callable[[Array], Mapping[str, Array]],
    lanes: int = 0,
) -> Kernel | None:
    """Load or build the kernel of a cell, a compiled evaluation of several candidates side by side.

    The kernel is used only if it gives the same bits as the functions that it is made of.

    Args:
        compiled: the workcell with its compiled functions.
        checker: collision checker of the workcell.
        outputs: function from decision vectors to outputs of the candidate function.
        lanes: number of candidates side by side; 0 for the machine's width.

    Returns:
        The kernel; None on a machine without lanes, or, with a warning, if the kernel fails.
    """

    def make() -> Mapping[str, Any]:
        return kernel_functions(compiled.symbols)

    key = compiled.key("kernel")
    own = (
        _definitions(checker.geometry)
        + _given(compiled)
        + files("hybrid_opt").joinpath("evaluate", "kernel.c").read_text()
    )
    try:
        library = compiled.memoise(
            (key, lanes),
            lambda: load_or_build_program("kernel", key, make, own, compiled.cache, lanes),
        )
    except FormError as error:
        warn_one_lane("kernel", str(error))
        return None
    if library.dual_arm_lanes() < 2:
        return None
    groups = [np.zeros(0), *(compiled.vector(name) for name in _groups(compiled))]
    kernel = Kernel(library, checker, np.concatenate(groups), np.concatenate(compiled.start))
    task = compiled.workcell.task
    x = np.random.default_rng(0).uniform(task.lower, task.upper, (kernel.lanes + 1, task.n_var))
    every = tuple(sample_sizes(compiled.workcell))
    if _same(kernel.evaluate(x, every, all_forces=True), evaluate_numpy(outputs(x), checker)):
        return kernel
    warn_one_lane("kernel", f"it differs from the functions that it is made of; {OTHER_COMPILER}")
    return None


def _same(found: SampledVerdicts, expected: SampledVerdicts) -> bool:
    """Return True if two evaluations have the same first violations, collisions and outputs, to the
    last bit.

    Args:
        found: an evaluation. Only outputs that it contains are compared.
        expected: the other evaluation, with at least these outputs.
    """
    pairs = [(values, expected.outputs[name]) for name, values in found.outputs.items()]
    pairs += [
        (getattr(found, name), getattr(expected, name))
        for name in ("first_sample", "first_reason", "colliding")
    ]
    return all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)


def _definitions(geometry: CellGeometry) -> str:
    """Return C macro definitions of the numbers of samples, joints and bodies, for which kernel.c
    is compiled."""
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
        "N_NEAR": geometry.near,
        "N_PAIRS": len(geometry.possible),
        "N_PIECES": sum(len(body.pieces) for body in geometry.bodies),
        "N_CONSTRAINTS": len(CONSTRAINTS),
        "N_OUTPUTS": len(sizes),
        "SAMPLE_SIZE": sum(sizes.values()),
        "CONSTRAINT_AT": starts["constraint"],
        "CONSTRAINT_OUTPUT": list(sizes).index("constraint"),
        "TABLE_CELLS": CELLS,
        "TABLE_CELLS_PER_RADIAN": repr(CELLS_PER_RADIAN),
        "TABLE_MOST_ANGLE": MOST_ANGLE,
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


def _groups(compiled: CompiledCell) -> list[str]:
    """Return the names of the groups of the cell's parameters that the compiled kernel takes, in
    order.

    These are all groups except those for commanded forces (`SQUEEZES`).
    """
    from symbolic.parameters import SQUEEZES

    return [name for name in compiled.numbers.sizes if name not in SQUEEZES]


def _given(compiled: CompiledCell) -> str:
    """Return C macros for kernel.c that say where each function's parameters stand in the array of
    all parameters of the cell."""
    numbers, groups = compiled.numbers, _groups(compiled)
    sizes = [numbers.sizes[name] for name in groups]
    at = dict(zip(groups, np.cumsum([0, *sizes]).tolist(), strict=False))
    lines = [f"#define N_NUMBERS {sum(sizes)}"]
    for name, taken in kernel_numbers(numbers.workcell, numbers.screen).items():
        parts = [
            f"s->arg[(k) + {i}] = {name}_SHARED ? (const lanes_real*)(batch->numbers + {at[group]})"
            f" : s->numbers + {at[group]};"
            for i, group in enumerate(taken)
        ]
        lines.append(f"#define {name}_GIVEN(k) {' '.join(parts)}")
    return "\n".join(lines) + "\n"


def configuration_size(workcell: Workcell) -> int:
    """Return the number of entries of a configuration: box pose and joints of both arms."""
    return POSE_SIZE + sum(len(robot.position_lower) for robot in workcell.robots)


def open_pair(workcell: Workcell) -> np.dtype[np.void]:
    """Return the record type `open_pair` of kernel.c: a pair of bodies at a sample whose collision
    the library FCL has to decide.
    """
    return np.dtype(
        [
            ("candidate", np.int64),
            ("sample", np.int64),
            ("pair", np.int64),
            ("configuration", np.float64, configuration_size(workcell)),
        ]
    )


class JudgeData(ctypes.Structure):
    """The C structure `judge_data` of kernel.c: pairs of bodies, and margins of their distances."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("pairs", "columns")),
        *((name, ctypes.c_void_p) for name in ("resting", "tables", "free_beyond", "tolerance")),
        *((name, ctypes.c_longlong) for name in ("n_pairs", "has_far", "n_resting")),
        ("shrunk_payload", ctypes.c_longlong),
        ("margin", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("bodies", "decide")),
    ]


class BatchData(ctypes.Structure):
    """The C structure `batch_data` of kernel.c: inputs and outputs of the evaluation of a batch of
    candidates.
    """

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("x", "begin", "numbers")),
        *((name, ctypes.c_longlong) for name in ("n", "with_collisions", "all_forces", "room")),
        *((name, ctypes.c_void_p) for name in ("time", "violation", "violation_time")),
        *((name, ctypes.c_void_p) for name in ("first_sample", "first_reason", "reached")),
        *((name, ctypes.c_void_p) for name in ("colliding", "wanted", "open")),
        ("n_open", ctypes.c_longlong),
    ]


def _judge_data(checker: CollisionChecker) -> tuple[JudgeData, dict[str, NDArray[Any]]]:
    """Describe the pairs of bodies of a cell, and their margins, to the compiled kernel.

    The returned arrays and the checker must stay alive as long as the kernel, since the C structure
    holds pointers to them.

    Args:
        checker: collision checker of the cell.

    Returns:
        The C structure, and by name the arrays to which its pointers refer.
    """
    geometry = checker.geometry
    tables = np.zeros(len(geometry.active), dtype=_TABLE)
    for table in checker.tables:
        tables[table.pair] = table.bounds.ctypes.data, table.robot, table.joint
    arrays = {
        "tables": tables,
        "pairs": np.array([(p.first, p.second) for p in geometry.active], dtype=np.int64),
        "columns": geometry.columns.astype(np.int64),
        "resting": np.array(checker.resting_places, dtype=_RESTING),
        "free_beyond": np.ascontiguousarray(checker.free_beyond),
        "tolerance": np.ascontiguousarray(geometry.tolerance),
    }
    data = JudgeData(
        n_pairs=len(arrays["pairs"]),
        has_far=len(geometry.asked) > 1,
        n_resting=len(arrays["resting"]),
        shrunk_payload=checker.distances.shrunk_payload,
        margin=PROOF_MARGIN,
        bodies=checker.distances.native.address,
        decide=compiled_distances().DECIDE,
        **{name: array.ctypes.data for name, array in arrays.items()},
    )
    return data, arrays
