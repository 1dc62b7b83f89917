"""A cell that is changed bit by bit, and a carry in it that is judged after every change."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.bundle import export
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.door import save, search, time_path
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.explanation import explain
from hybrid_opt.job.plan import plan_job
from hybrid_opt.metaheuristics.run import SearchSettings
from hybrid_opt.robust.squeeze import Squeeze, SqueezeSettings, commanded_forces
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array
from symbolic.errors import DualArmError, WorkcellError
from symbolic.path.pieces import same_paths, stated
from symbolic.read.cell_files import collect_cell, unpack_cell
from symbolic.records import POSE_SIZE, Workcell
from symbolic.records.poses import box_placement, inverse, rpy_from_rotation

EVALUATIONS = 400
"""Candidates of a search around the carry at hand: 1.6 s on the rack."""

NEAR = 0.05
"""Standard deviation of its first generation around that carry, over the bounds' width."""

FIRST = 39
"""Carries of that generation that are near; with the one at hand a whole population."""


@dataclass(frozen=True)
class Handle:
    """Something of a cell that has a place.

    Attributes:
        key: in the workcell file: 'task.start', 'environment.top board', 'robots[0].base' or
            'contacts[0]'.
        title: how it is called.
        pose: (4, 4) in the world.
        turns: whether it may be turned; a pad stays on its face.
    """

    key: str
    title: str
    pose: Array
    turns: bool = True


@dataclass(frozen=True, eq=False)
class Verdict:
    """A carry in a cell.

    Attributes:
        cell: the changed cell under the time law 'optimal', None where the change is refused.
        carry: the carry in that cell, None likewise.
        text: whether the carry is feasible, or why not.
        feasible: whether it is.
        commanded: (n, 2) normal forces to command [N], None where the carry is not feasible.
        squeeze: how these came about.
        seconds: time that the verdict took.
    """

    cell: Cell | None
    carry: Carry | None
    text: str
    feasible: bool
    commanded: Array | None
    squeeze: Squeeze | None
    seconds: float


class Session:
    """A cell with what was changed of it, and the carry that is looked at.

    Attributes:
        base: the cell as it was given.
        changes: by key path of the workcell file, see `Cell.changed`.
        x: (n_var,) decision vector of the carry under the time law 'optimal'.
        verdict: the verdict on that carry.
    """

    def __init__(self, cell: Cell, x: Array | None = None) -> None:
        """Look at a carry.

        Args:
            x: its decision vector in `cell.drivable()`; None for the hand-made carry.

        Raises:
            DualArmError: the cell has no drivable form, or x does not fit.
        """
        self.base = cell
        self._drivable = cell if cell.workcell.task.time_law == "optimal" else cell.drivable()
        self.changes: dict[str, Any] = {}
        self.x = np.array(self._drivable.initial if x is None else x, dtype=float)
        self.verdict = self._judged(self._drivable)

    @property
    def cell(self) -> Cell:
        """The changed cell under the time law 'optimal'."""
        return self.verdict.cell or self._drivable

    def change(self, changes: Mapping[str, Any]) -> Verdict:
        """Change more; what is refused changes nothing.

        Args:
            changes: by key path of the workcell file; 'force_limit' is that of the carry [N].
        """
        begin = time.perf_counter()
        wanted = self.changes | dict(changes)
        limit = wanted.pop("force_limit", None)
        try:
            cell = self._drivable.changed(wanted) if wanted else self._drivable
        except WorkcellError as error:
            text = "; ".join(error.problems)
            took = time.perf_counter() - begin
            return Verdict(None, None, f"refused: {text}", False, None, None, took)
        if limit is not None:
            low, high = cell.workcell.task.force_limit
            self.x[-1] = min(max(float(limit), low), high)
        self.changes = wanted
        self.verdict = self._judged(cell, begin)
        return self.verdict

    def move(self, handle: Handle, pose: Array) -> Verdict:
        """Put something at another place (4, 4) of the world, see `handles`."""
        return self.change(moved(self.cell.workcell, handle, pose))

    def optimise(self, rng: np.random.Generator, evaluations: int = EVALUATIONS) -> Verdict:
        """Search around the carry at hand for the one of least product of duration and force."""
        task, cell = self.cell.workcell.task, self.cell
        width = np.where(np.isfinite(task.upper - task.lower), task.upper - task.lower, 0.0)
        near = self.x + NEAR * width * rng.standard_normal((FIRST, task.n_var))
        first = np.clip(np.vstack([self.x, near]), task.lower, task.upper)
        settings = SearchSettings(initial=first)
        front = search(cell, evaluations=evaluations, rng=rng, settings=settings)
        # The path at hand may have waypoints between those that a search draws.
        tried = cell.evaluator.certified(cell.evaluate(np.vstack([self.x, front.x])))
        if tried.feasible.any():
            product = np.where(tried.feasible, np.prod(tried.objectives, axis=1), np.inf)
            self.x = np.array(tried.x[np.argmin(product)])
        self.verdict = self._judged(cell)
        return self.verdict

    def save(self, folder: str | Path) -> Path:
        """Write the changed cell, with the path at hand as its hand-made one, and every file that
        it needs into a folder of its own; returns the workcell file.

        Raises:
            DualArmError: the folder is not empty, or cannot be written.
        """
        folder = Path(folder)
        if folder.exists() and any(folder.iterdir()):
            raise ResultsError(f"{folder}: is not empty; save the cell into a folder of its own")
        task = stated(self.base.workcell.task)
        (x,) = same_paths(self.x, self.cell.workcell.task, task)
        poses = x[: task.n_box].reshape(-1, POSE_SIZE)
        cell = self.base.changed(self.changes | {"task.initial": poses.tolist()})
        return unpack_cell(collect_cell(cell.workcell), folder).source

    def export(self, target: str, folder: str | Path) -> tuple[Path, ...]:
        """Write the whole job around the carry for robots, and the carry itself as carry.json.

        Raises:
            DualArmError: see `hybrid_opt.export`; the carry is not feasible.
        """
        carry = self.verdict.carry
        if carry is None or not self.verdict.feasible:
            raise ResultsError(f"this carry cannot be driven: {self.verdict.text}")
        limits = TimingLimits(force=float(self.x[-1]))
        timing = time_path(self.cell, carry, limits)
        Path(folder).mkdir(parents=True, exist_ok=True)
        save(carry, Path(folder) / "carry.json", {"by": "hand"})
        return export(plan_job(timing), target, folder)

    def _judged(self, cell: Cell, begin: float | None = None) -> Verdict:
        begin = time.perf_counter() if begin is None else begin
        carry = cell.carry(self.x)
        judgement = carry.judgement
        assert judgement is not None, "a cell judges its carries"
        commanded, squeeze = None, None
        text = f"feasible, {carry.duration:.3f} s"
        if judgement.feasible:
            try:
                given = cell.workcell, carry, SqueezeSettings()
                commanded, squeeze = commanded_forces(*given, in_parts=False)
                most = cell.workcell.task.reference_force
                text += f", press with {squeeze.force:.1f} N"
                if (commanded.max(axis=0) > most).any():
                    text += f", more than the reference force of {most.min():.1f} N"
            except DualArmError as error:
                text += f"; {error}"
        else:
            text = f"infeasible: {explain(cell.evaluator, cell.evaluate(self.x))[0]}"
        took = time.perf_counter() - begin
        return Verdict(cell, carry, text, judgement.feasible, commanded, squeeze, took)


def handles(workcell: Workcell) -> tuple[Handle, ...]:
    """Parts of a cell that may be dragged: start, goal, bodies around, bases and pads."""
    task, bodies = workcell.task, workcell.environment
    first, last = (
        box_placement(task.orientation, task.waypoints[k].lower[:POSE_SIZE]) for k in (0, -1)
    )
    found = [Handle("task.start", "start", first), Handle("task.goal", "goal", last)]
    names = [body.name for body in bodies]
    found += [
        Handle(f"environment.{body.name}", body.name, body.pose)
        for body in bodies
        if names.count(body.name) == 1
    ]
    for k, robot in enumerate(workcell.robots):
        found.append(Handle(f"robots[{k}].base", f"base of {robot.name}", robot.T_world_base))
    for k, (robot, contact) in enumerate(zip(workcell.robots, workcell.contacts, strict=True)):
        pose = first @ contact.T_box_pad
        found.append(Handle(f"contacts[{k}]", f"pad of {robot.name}", pose, turns=False))
    return tuple(found)


def moved(workcell: Workcell, handle: Handle, pose: Array) -> dict[str, Any]:
    """The changes, by key path, that put a handle at another place (4, 4) of the world."""
    xyz = [round(value, 6) for value in pose[:3, 3].tolist()]
    rpy = [round(value, 6) for value in rpy_from_rotation(pose[:3, :3]).tolist()]
    section = handle.key.partition(".")[0].partition("[")[0]
    if section == "task":
        orientation = workcell.task.orientation
        if orientation.is_vector:
            turn = Rotation.from_matrix(pose[:3, :3] @ orientation.reference.T)
            rpy = [round(value, 6) for value in turn.as_rotvec().tolist()]
        return {handle.key: [*xyz, *rpy]}
    if section == "robots":
        return {handle.key: {"xyz": xyz, "rpy": rpy}}
    if section == "environment":
        return {f"{handle.key}.xyz": xyz, f"{handle.key}.rpy": rpy}
    contact = workcell.contacts[int(handle.key[len("contacts[") : -1])]
    task = workcell.task
    box = box_placement(task.orientation, task.waypoints[0].lower[:POSE_SIZE])
    shift = (inverse(box) @ pose)[:3, 3] - contact.T_box_pad[:3, 3]
    normal = contact.T_box_pad[:3, 2]
    place = contact.T_box_pad[:3, 3] + shift - normal * (normal @ shift)
    return {f"{handle.key}.xyz": [round(value, 6) for value in place.tolist()]}
