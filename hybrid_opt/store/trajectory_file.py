"""A trajectory stored as one self-contained JSON file, and its re-evaluation.
docs/reference/bundles.md describes the format.

The file holds the decision vector, the start postures, the figures of the carry, its origin, and
the whole workcell with every file that the workcell names. Reading it executes nothing and checks
every field.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.carry import OBJECTIVE
from hybrid_opt.cell import Cell
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.objectives import OBJECTIVES, PAPER_OBJECTIVES
from hybrid_opt.store.files import AGAIN, from_json, read_document, storing
from symbolic.array import Array
from symbolic.errors import BundleError
from symbolic.read.cell_files import (
    CellFiles,
    cell_from_json,
    cell_to_json,
    collect_cell,
    unpack_cell,
)
from symbolic.records import Workcell
from symbolic.records.problems import shown, text_problem
from symbolic.safe_io import replace_file

TRAJECTORY_FORMAT = "dual-arm-carry trajectory"
TRAJECTORY_VERSION = 1
LARGEST_DECISION = 100.0
"""Largest absolute value in a decision vector or start posture [m, rad]; no cell needs more."""

LARGEST_FORCE = 1e5
"""Largest last value of a decision vector; the last value may be a force limit [N]."""

MOST_NUMBERS = 10_000

START_POSTURE_TOLERANCE = 1e-6
"""Largest difference of start postures [rad] that counts as reproduced."""

ABSOLUTE_TOLERANCE = 1e-9

RELATIVE_TOLERANCE = 1e-6
"""Relative difference of a figure between compilers or machines that counts as reproduced."""


@dataclass(frozen=True)
class StoredTrajectory:
    """Content of a trajectory file.

    Attributes:
        x: (n_var,) decision vector.
        start: joint positions (joints,) of each arm at the first sample [rad or m].
        figures: numbers by name that described the carry when it was stored, SI units.
        provenance: origin of the trajectory (algorithm, seed, versions, ...) as JSON values.
        cell: files of the workcell.
    """

    x: Array
    start: tuple[Array, Array]
    figures: Mapping[str, float]
    provenance: Mapping[str, Any]
    cell: CellFiles

    @property
    def objectives(self) -> tuple[str, ...]:
        """Names of the objectives among the stored figures; the paper's objectives if there are
        none.
        """
        named = {f"{OBJECTIVE}{name}": name for name in OBJECTIVES}
        found = tuple(named[figure] for figure in self.figures if figure in named)
        return found or PAPER_OBJECTIVES

    def open_cell(self, folder: Path) -> Cell:
        """Write the stored workcell's files to a folder, and return a cell with this workcell and
        the stored objectives.

        Args:
            folder: folder for the files.

        Raises:
            ResultsError: the stored workcell is not valid, or does not fit the decision vector.
        """
        return Cell(self.unpack(folder), self.objectives)

    def unpack(self, folder: Path) -> Workcell:
        """Write the stored workcell's files to a folder, and return the workcell read from them.

        Args:
            folder: folder for the files.

        Raises:
            ResultsError: the stored workcell is not valid, or does not fit the decision vector or
                the start postures.
        """
        workcell = unpack_cell(self.cell, folder)
        if self.x.shape != (workcell.task.n_var,):
            raise ResultsError(
                f"decision: {len(self.x)} values; the stored workcell has {workcell.task.n_var}"
            )
        for i, (robot, start) in enumerate(zip(workcell.robots, self.start, strict=True)):
            if start.shape != robot.position_lower.shape:
                raise ResultsError(
                    f"start[{i}]: expected {len(robot.position_lower)} numbers, one per joint"
                )
        return workcell


def write_trajectory(
    path: str | Path,
    cell: Workcell | CompiledCell,
    x: Array,
    figures: Mapping[str, float],
    provenance: Mapping[str, Any],
) -> None:
    """Store a trajectory with its workcell; an existing file is replaced in one step.

    Args:
        path: the file to write; its folder has to exist.
        cell: the workcell, unchanged since it was read, or its compiled cell, which saves time if
            several trajectories are stored.
        x: (n_var,) decision vector.
        figures: finite numbers by name that describe the carry, as from `Carry.figures`.
        provenance: origin of the trajectory as JSON values: algorithm, seed, versions and others.

    Raises:
        ResultsError: the workcell was changed after reading, or a value cannot be stored.
    """
    compiled, x = CompiledCell.of(cell), np.asarray(x, dtype=float)
    workcell = compiled.workcell
    if x.shape != (workcell.task.n_var,) or not np.isfinite(x).all():
        raise ResultsError(
            f"decision vector: expected {workcell.task.n_var} finite numbers", code="shape"
        )
    for name, value in figures.items():
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (is_number and math.isfinite(value)):
            raise ResultsError(f"{name}: found {shown(value)}; expected a finite number")
    outputs = compiled.evaluators["candidate"](x, *_standing_still(workcell))
    document = {
        "format": TRAJECTORY_FORMAT,
        "version": TRAJECTORY_VERSION,
        "decision": x.tolist(),
        "start": [outputs["q_1"][0].tolist(), outputs["q_2"][0].tolist()],
        "figures": dict(figures),
        "provenance": dict(provenance),
        "cell": cell_to_json(collect_cell(workcell)),
    }
    try:
        text = json.dumps(document, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ResultsError(f"the trajectory cannot be stored as JSON: {error}") from error
    path = Path(path)
    with storing(path, AGAIN):
        replace_file(path, f"{text}\n".encode())


def _standing_still(workcell: Workcell) -> tuple[Array, ...]:
    """Return the arguments that the candidate function takes after the decision vector x.

    For drivable cells these are times (n,) [s], path speeds (n,) and path accelerations (n,).
    Speeds and accelerations are zero here, because start postures do not depend on the timing. For
    other cells the tuple is empty.

    Args:
        workcell: the cell.
    """
    if not workcell.task.law.is_drivable:
        return ()
    still = np.zeros(workcell.task.samples)
    return np.linspace(0.0, 1.0, workcell.task.samples), still, still


def read_trajectory(path: str | Path) -> StoredTrajectory:
    """Read and check a trajectory file.

    Args:
        path: path of the file.

    Raises:
        ResultsError: the file cannot be read, or a field is wrong.
    """
    path = Path(path)
    data = read_document(path, TRAJECTORY_FORMAT, TRAJECTORY_VERSION)
    read = from_json(_Content, data, path, "store the trajectory anew", is_open=False)
    try:
        cell = cell_from_json(read.cell)
    except BundleError as error:
        raise ResultsError(f"{path}: {error}") from error
    x, *start = (np.array(values) for values in (read.decision, *read.start))
    return StoredTrajectory(x, (start[0], start[1]), read.figures, read.provenance, cell)


@dataclass(frozen=True)
class _Content:
    """JSON values of a trajectory file."""

    format: str
    version: int
    decision: tuple[float, ...]
    start: tuple[tuple[float, ...], tuple[float, ...]]
    figures: Mapping[str, float]
    provenance: Mapping[str, Any]
    cell: Any

    def __post_init__(self) -> None:
        """Check numbers and names of the file.

        Raises:
            ValueError: a list has more than `MOST_NUMBERS` numbers, a number exceeds the largest
                that any cell can have, or the name of a figure is not printable.
        """
        vectors = {"decision": self.decision, "start[0]": self.start[0], "start[1]": self.start[1]}
        for name, values in (vectors | {"figures": tuple(self.figures.values())}).items():
            if len(values) > MOST_NUMBERS:
                raise ValueError(f"{name}: {len(values)} numbers; allowed are {MOST_NUMBERS}")
        for name, values in vectors.items():
            most = [LARGEST_DECISION] * len(values)
            if name == "decision":
                most[-1:] = [LARGEST_FORCE]
            for k, (value, limit) in enumerate(zip(values, most, strict=False)):
                if abs(value) > limit:
                    allowed = f"allowed is {-limit:g} to {limit:g}"
                    raise ValueError(f"{name}[{k}]: found {value:g}; {allowed}")
        for name in self.figures:
            if problem := text_problem(name):
                raise ValueError(f"figures: found the name {shown(name)}; {problem}")


@dataclass(frozen=True)
class FigureComparison:
    """A stored figure of a carry beside its recomputed value.

    Attributes:
        name: name of the figure.
        stored: value in the trajectory file, SI units.
        recomputed: value from a new evaluation; None if the figure cannot be recomputed.
    """

    name: str
    stored: float
    recomputed: float | None

    @property
    def same(self) -> bool:
        """True if the stored and the recomputed value agree within the tolerances."""
        if self.recomputed is None:
            return False
        allowed = ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * abs(self.stored)
        return abs(self.stored - self.recomputed) <= allowed


@dataclass(frozen=True)
class Replay:
    """Result of evaluating a stored trajectory again.

    Attributes:
        cell: the cell from the trajectory file.
        figures: comparison of every stored figure with its recomputed value.
        start_difference: largest difference of a joint position at the first sample [rad].
    """

    cell: Cell
    figures: tuple[FigureComparison, ...]
    start_difference: float

    @property
    def reproduced(self) -> bool:
        """True if all stored figures and the joint positions at the first sample were reproduced
        within tolerances.
        """
        return self.start_difference <= START_POSTURE_TOLERANCE and all(
            figure.same for figure in self.figures
        )


def replay(stored: StoredTrajectory, cell: Cell) -> Replay:
    """Evaluate a stored trajectory again and compare the results with the stored ones.

    Args:
        stored: the stored trajectory.
        cell: the cell from `StoredTrajectory.open_cell`.

    Returns:
        Stored and recomputed value of every figure, and the largest difference of a joint position
        at the first sample.

    Raises:
        DualArmError: the model of the cell cannot be built.
    """
    carry = cell.carry(stored.x)
    recomputed = carry.figures
    differences = [
        float(np.abs(arm.q[0] - start).max())
        for arm, start in zip(carry.arms, stored.start, strict=True)
    ]
    return Replay(
        cell,
        tuple(
            FigureComparison(name, value, recomputed.get(name))
            for name, value in stored.figures.items()
        ),
        max(differences),
    )
