"""A dual-arm cell: its description, and its compiled functions, which are loaded when they are
needed.

`Cell` is the only class of the library that holds resources. All its results are frozen records.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from functools import cached_property
from importlib.resources import files
from multiprocessing import parent_process
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator, Evaluations, concatenated
from hybrid_opt.evaluate.objectives import (
    PAPER_OBJECTIVES,
    ForceKind,
    Objective,
    force_kind,
    select_objectives,
)
from hybrid_opt.static_hold import StaticHold, hold_error, static_hold, static_hold_error
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.geometry.pairs import CellGeometry
from symbolic.path.spline import coarse_task, resample_decisions
from symbolic.read.cell import changed, load
from symbolic.read.cell_files import CellFiles, collect_cell, drivable_files, unpack_cell
from symbolic.records import Workcell
from symbolic.records.poses import read_only
from symbolic.records.task import initial_decision

if TYPE_CHECKING:
    # Not imported at run time before they are needed: a search needs none of them.
    from hybrid_opt.collision.certify import Certificate
    from hybrid_opt.polishing.functions import PolishFunctions
    from hybrid_opt.robust.budget import GripBudget
    from hybrid_opt.timing.model import TimingModel
    from hybrid_opt.timing.solve import PathTimer

_EVALUATED_AT_ONCE = 500
"""Candidates evaluated at once; every sample of each is held in memory."""


class Cell:
    """A workcell with its compiled functions.

    Functions are compiled at their first use and cached on disk; later uses load them, also in
    other programs. A cell must not be shared between threads.

    Attributes:
        workcell: the description of the cell.
        compiled: the compiled functions of the workcell, made from one symbolic model.
    """

    def __init__(
        self,
        workcell: Workcell,
        objectives: Sequence[str | Objective] = PAPER_OBJECTIVES,
        threads: int | None = None,
        compiled: CompiledCell | None = None,
    ) -> None:
        """Describe a cell; nothing is compiled yet.

        Args:
            workcell: the description of the cell.
            objectives: objectives that searches minimise: names in `OBJECTIVES`, or `Objective`
                records.
            threads: number of threads that evaluate candidates, 0 for one per core; the results do
                not depend on the number. None means one per core, or one in a worker process.
            compiled: the functions of the cell. None compiles them, or loads them from the cache;
                an `InterpretedCell` evaluates them without a compiler.

        Raises:
            SettingsError: an objective is unknown, or given twice.
        """
        self.workcell = workcell
        self.compiled = CompiledCell(workcell) if compiled is None else compiled
        self._threads = threads
        select_objectives(objectives)
        self._objectives = tuple(objectives)
        self._folder: TemporaryDirectory[str] | None = None  # of its files

    def __reduce__(self) -> tuple[type[Cell], tuple[Any, ...]]:
        """Return what pickle needs to build the cell again in another process: constructor and
        arguments, without compiled functions, which that process loads anew."""
        return Cell, (self.workcell, self._objectives, self._threads)

    @classmethod
    def load(
        cls,
        path: str | Path,
        objectives: Sequence[str | Objective] = PAPER_OBJECTIVES,
        threads: int | None = None,
    ) -> Cell:
        """Return the cell of a workcell file.

        Args:
            path: path of the workcell file.
            objectives: objectives that searches minimise: names in `OBJECTIVES`, or `Objective`
                records.
            threads: number of threads that evaluate candidates, 0 for one per core; None as in the
                constructor.

        Raises:
            WorkcellError: the file is wrong; the message lists every problem.
            SettingsError: an objective is unknown, or given twice.
        """
        select_objectives(objectives)
        return cls(load(Path(path)), objectives, threads)

    @classmethod
    def from_files(
        cls,
        files: CellFiles,
        objectives: Sequence[str | Objective] = PAPER_OBJECTIVES,
        threads: int | None = None,
    ) -> Cell:
        """Return the cell of a workcell's files in memory, which are unpacked to a temporary
        folder. The folder lasts as long as the cell.

        Args:
            files: content of the workcell file and of the files that it names.
            objectives: objectives that searches minimise: names in `OBJECTIVES`, or `Objective`
                records.
            threads: number of threads that evaluate candidates, 0 for one per core; None as in the
                constructor.

        Raises:
            SettingsError: an objective is unknown, or given twice.
        """
        folder = TemporaryDirectory()
        cell = cls(unpack_cell(files, Path(folder.name)), objectives, threads)
        cell._folder = folder
        return cell

    def with_start_branches(self, branches: tuple[int, int]) -> Cell:
        """Return a copy of the cell with fixed start branches.

        Args:
            branches: for each arm, index of its start branch, in place of "search" in the workcell
                file.

        Raises:
            WorkcellError: the workcell is not valid with these branches.
        """
        known = self.workcell
        decided = load(known.source, decided=branches, text=known.text)
        return Cell(decided, self._objectives, self._threads)

    def changed(self, changes: Mapping[str, Any]) -> Cell:
        """Return a copy of the cell with changed parameters, without compiling again.

        The changed cell can be stored, searched, polished and exported like any other cell.

        Args:
            changes: new values by key path in the workcell file: 'payload.mass',
                'contacts.friction' (both contacts), 'contacts[0].friction',
                'environment.top board.xyz'.

        Raises:
            WorkcellError: a path leads nowhere, or the changed cell is wrong; the message lists
                every problem.
        """
        cell = Cell(changed(self.workcell, changes), self._objectives, self._threads)
        cell.compiled = self.compiled.with_parameters(cell.workcell)
        cell._folder = self._folder
        return cell

    def drivable(self) -> Cell:
        """Return the drivable variant of the cell (docs/explanation/timing.md).

        Carries of this variant are timed from rest to rest as fast as all limits of robots, payload
        and pads allow. The objectives are the duration and the peak force; the force is the robust
        force if this cell minimises robust forces, else the planned force. The new workcell file
        lies in a temporary folder that lasts as long as the cell.

        Raises:
            BundleError: the workcell file cannot be changed, or was changed since it was read.
            SettingsError: an objective is unknown.
        """
        files = drivable_files(collect_cell(self.workcell))
        return Cell.from_files(files, self.force_kind.drivable, self._threads)

    @property
    def threads(self) -> int:
        """Number of threads that evaluate candidates, 0 for one per core."""
        if self._threads is not None:
            return self._threads
        return 0 if parent_process() is None else 1

    @cached_property
    def evaluator(self) -> CandidateEvaluator:
        """Evaluator of candidates.

        Raises:
            SettingsError: an objective is unknown.
            DualArmError: the model cannot be built.
        """
        return CandidateEvaluator(
            self.workcell, self._objectives, self.threads, compiled=self.compiled
        )

    @cached_property
    def timing_model(self) -> TimingModel:
        """Model that computes drivable timings of carries."""
        from hybrid_opt.timing.model import TimingModel

        return TimingModel(self.compiled, robust=self.force_kind.robust)

    @cached_property
    def path_timer(self) -> PathTimer:
        """Compiled solver that computes the fastest timings of many paths."""
        from hybrid_opt.timing.solve import PathTimer

        return PathTimer(self.compiled, threads=self.threads)

    @cached_property
    def polish_functions(self) -> PolishFunctions:
        """Compiled functions of the polish."""
        from hybrid_opt.polishing.functions import polish_functions

        return polish_functions(self.compiled)

    @cached_property
    def grip_budget(self) -> GripBudget:
        """Normal forces that hold the payload at rest in every case of the uncertainty, compared
        with the reference forces.
        """
        from hybrid_opt.robust.budget import grip_budget

        return grip_budget(self.workcell)

    @cached_property
    def static_hold(self) -> StaticHold:
        """Forces that hold the payload level and at rest."""
        return static_hold(self.workcell)

    @cached_property
    def static_hold_error(self) -> str:
        """Reason why the payload cannot be held at rest, with a remedy; '' if it can be held."""
        return static_hold_error(self.workcell) or static_hold_error(
            self.workcell, self.evaluator.outputs
        )

    def require_hold(self) -> None:
        """Raise an error if the payload cannot be held at rest.

        Raises:
            WorkcellError: the payload cannot be held; the text states the needed and allowed
                values, and remedies.
        """
        if self.static_hold_error:
            raise hold_error(self.workcell, self.static_hold_error)

    @cached_property
    def holding_evaluator(self) -> CandidateEvaluator:
        """Evaluator of candidates, as `evaluator`, after a check that the payload can be held at
        rest.

        Raises:
            WorkcellError: the payload cannot be held at rest.
        """
        self.require_hold()
        return self.evaluator

    @property
    def geometry(self) -> CellGeometry:
        """Collision bodies, and the pairs of bodies that are checked for collision."""
        return self.evaluator.checker.geometry

    @cached_property
    def force_kind(self) -> ForceKind:
        """Kind of force that force limits of drivable carries bound.

        It is the robust force, which holds the box in every case of the uncertainty, if the
        objectives contain robust forces. Otherwise it is the planned force, which holds the box if
        everything is exactly as described.

        Raises:
            SettingsError: an objective is unknown.
        """
        return force_kind(self._objectives)

    @property
    def objectives(self) -> tuple[str | Objective, ...]:
        """Objectives that searches minimise, as names or records, as given at construction."""
        return self._objectives

    @property
    def objective_names(self) -> tuple[str, ...]:
        """Names of the objectives that searches minimise."""
        return self.evaluator.objective_names

    @property
    def n_var(self) -> int:
        """Length of the decision vector."""
        return self.workcell.task.n_var

    @property
    def lower(self) -> Array:
        """(n_var,) lower bounds of the decision vector [m, rad]."""
        return self.workcell.task.lower

    @property
    def upper(self) -> Array:
        """(n_var,) upper bounds of the decision vector [m, rad]."""
        return self.workcell.task.upper

    @cached_property
    def initial(self) -> Array:
        """(n_var,) decision vector of the hand-made trajectory in the workcell file; read-only."""
        return read_only(initial_decision(self.workcell.task))

    def evaluate(self, x: Array) -> Evaluations:
        """Evaluate candidates at the task's samples.

        Args:
            x: (n, n_var) decision vectors, or one (n_var,).

        Raises:
            SettingsError: x has the wrong shape.
        """
        x = np.atleast_2d(x)
        begins = range(0, max(len(x), 1), _EVALUATED_AT_ONCE)
        return concatenated(
            [self.evaluator.evaluate(x[k : k + _EVALUATED_AT_ONCE]) for k in begins]
        )

    def random(self, count: int, rng: np.random.Generator) -> Array:
        """Draw random decision vectors (count, n_var).

        The waypoints of the workcell file are drawn uniformly within their bounds. If the task
        inserts further waypoints between them, these are interpolated on the drawn path.

        Args:
            count: number of decision vectors.
            rng: random generator.
        """
        task, drawn = self.workcell.task, coarse_task(self.workcell.task)
        x = rng.uniform(drawn.lower, drawn.upper, (count, drawn.n_var))
        return resample_decisions(x, drawn, task)

    def carry(self, x: Array) -> Carry:
        """Compute every physical quantity of the carry of one decision vector (n_var,), under the
        task's time law.

        Raises:
            SettingsError: x has the wrong shape.
        """
        return self.evaluator.carry(x)

    def certify(self, x: Array | Carry) -> Certificate:
        """Certify that one carry is free of collisions along its continuous path.

        Args:
            x: decision vector (n_var,) of the carry, or the carry itself.

        Raises:
            SettingsError: x has the wrong shape.
            LostPathError: an arm cannot follow the path, so that no certificate is possible.
        """
        return self.evaluator.certificate(x.x if isinstance(x, Carry) else x)

    def __repr__(self) -> str:
        task, payload = self.workcell.task, self.workcell.payload
        robots = " and ".join(repr(robot.name) for robot in self.workcell.robots)
        wanted = ", ".join(o if isinstance(o, str) else o.name for o in self._objectives)
        return (
            f"Cell {self.workcell.name!r}: robots {robots} carry {payload.mass:g} kg along "
            f"{len(task.waypoints)} poses, {len(task.free_indices)} of them free "
            f"({task.n_var} variables); minimises {wanted}"
        )

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(repr(self))}</p>"


def example(name: str = "rack", objectives: Sequence[str | Objective] = PAPER_OBJECTIVES) -> Cell:
    """Load a cell that ships with the project.

    Args:
        name: name of the workcell file in `studies/workcells`, without its ending.
        objectives: objectives that searches minimise, names or `Objective` records.

    Raises:
        SettingsError: there is none of that name; the message lists them.
    """
    folder = Path(str(files("studies"))) / "workcells"
    known = sorted(path.stem for path in folder.glob("*.toml"))
    if name not in known:
        raise SettingsError(
            f"no cell {name!r} ships; known are {', '.join(known)}", code="unknown-cell"
        )
    return Cell.load(folder / f"{name}.toml", objectives)
