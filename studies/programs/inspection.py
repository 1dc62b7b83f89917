"""What `studies.inspect` finds out of a workcell before a study, and how it tells it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import hybrid_opt as ho
from hybrid_opt.building import Maker, build_all
from hybrid_opt.campaign.progress import Progress
from hybrid_opt.carry import Carry, Judgement
from hybrid_opt.cell import Cell
from hybrid_opt.display.view import CarryView, Look
from hybrid_opt.evaluate.evaluations import Evaluations
from hybrid_opt.evaluate.explanation import Explanation, explain, frequent
from hybrid_opt.front import Front
from hybrid_opt.indicators.metrics import BindingBound, binding_bounds
from studies.program import load_workcell
from studies.report.data import shown
from studies.report.pictures_cell import environment, reachable_regions
from studies.report.pictures_meeting import meeting
from studies.report.reach import reach_map
from studies.report.style import in_style, save, settled
from symbolic.array import Array
from symbolic.cell_model import CellModel, own_pairs
from symbolic.errors import SettingsError
from symbolic.records import POSE_SIZE, Workcell
from symbolic.records.task import straight_line
from symbolic.robot.branches import StartBranch, initial_poses

EXPLAINED = 200
"""Most infeasible candidates that are looked at closer."""

POLISH_ATTEMPTS = 10
"""Solves of the short polish: the trajectory itself, then ends, middle and gaps of what it
becomes."""


@dataclass(frozen=True)
class Optimum:
    """Outcome of a short polish of the hand-made trajectory.

    Attributes:
        solutions: of the polished front.
        binding: the bounds that they lie on.
        problem: why there is no polish, '' where there is one.
    """

    solutions: int
    binding: tuple[BindingBound, ...]
    problem: str = ""


class Inspection:
    """What there is to know of a cell; each part is worked out when it is first asked for.

    Attributes:
        candidates: random candidates to judge.
        seed: of their randomness.
        progress: where to show what takes long; nowhere unless another one is set.
    """

    def __init__(
        self,
        workcell: Workcell,
        candidates: int,
        seed: int,
        output: Path | None,
        polish: bool = False,
        view: Path | None = None,
    ) -> None:
        """Nothing is worked out yet.

        Args:
            workcell: the cell.
            candidates: random ones to judge, at least 1.
            seed: of their randomness.
            output: folder for the pictures, None to draw none.
            polish: whether to polish the hand-made trajectory shortly, to see which bounds bind.
            view: file for a page that shows the hand-made trajectory, None for none.

        Raises:
            SettingsError: no candidates.
        """
        if candidates < 1:
            raise SettingsError(f"--candidates is {candidates}; at least 1 is needed")
        self.candidates, self.seed = candidates, seed
        self._cell, self._output, self._polish, self._view = Cell(workcell), output, polish, view
        self.progress = Progress(shown=False)

    @property
    def name(self) -> str:
        """Of the workcell."""
        return self._cell.workcell.name

    @property
    def facts(self) -> dict[str, str]:
        """What is in the file, by heading."""
        return _facts(self._cell.workcell)

    def build(self) -> None:
        """Compile what is not compiled yet; what cannot be is told by who needs it."""
        makers: list[Maker] = [lambda: self._cell.evaluator]
        if self._polish:
            makers.append(lambda: self._cell.polish_functions)
        build_all(makers, self.progress)

    @cached_property
    def branches(self) -> dict[str, tuple[Branch, ...]]:
        """Per robot's name its postures at the start, best first."""
        robots = self._cell.workcell.robots
        return {robot.name: branches_of(self._cell, i) for i, robot in enumerate(robots)}

    @property
    def static_normal_force(self) -> tuple[float, ...]:
        """Of both robots, the level payload at rest [N]."""
        return tuple(self._cell.static_hold.normal_force.tolist())

    @property
    def static_objectives(self) -> tuple[float, ...]:
        """The same over the reference forces."""
        force = self._cell.static_hold.normal_force
        return tuple((force / self._cell.workcell.task.reference_force).tolist())

    @property
    def static_payload_limit(self) -> float:
        """Payload that reaches the reference force at rest [kg]."""
        return self._cell.static_hold.payload_limit

    @property
    def unheld(self) -> str:
        """Why the payload cannot be held still, and what would do; '' where it can."""
        return self._cell.unheld

    @property
    def initial(self) -> Judgement:
        """The verdict on the hand-made trajectory."""
        return _judged(self._carries["initial"])

    @property
    def straight_line(self) -> Judgement:
        """The verdict on the straight line."""
        return _judged(self._carries["straight_line"])

    @cached_property
    def _carries(self) -> dict[str, Carry]:
        line = straight_line(self._cell.workcell.task)
        return {
            "initial": self._cell.carry(self._cell.initial),
            "straight_line": self._cell.carry(line),
        }

    @cached_property
    def _explained(self) -> dict[str, Explanation]:
        """What is in the way of those that fail, by their names."""
        found = {}
        for name, carry in self._carries.items():
            for explanation in explain(self._cell.evaluator, self._cell.evaluate(carry.x)):
                found[name] = explanation
        return found

    @property
    def explained(self) -> dict[str, str]:
        """By 'initial' and 'straight_line' what is in the way of them, where they fail."""
        return {name: str(why) for name, why in self._explained.items()}

    @cached_property
    def _found(self) -> Evaluations:
        rng = np.random.default_rng(self.seed)
        return self._cell.evaluate(self._cell.random(self.candidates, rng))

    @property
    def feasible_share(self) -> float:
        """Of the random candidates."""
        return float(self._found.feasible.mean())

    @property
    def infeasible_by_reason(self) -> dict[str, int]:
        """Of them, by the constraint violated first."""
        return self._found.infeasible_by_reason

    @property
    def _failed(self) -> Evaluations:
        return self._found[~self._found.feasible][:EXPLAINED]

    @property
    def explained_candidates(self) -> int:
        """Infeasible ones of them that were looked at closer."""
        return len(self._failed)

    @cached_property
    def in_the_way(self) -> dict[str, dict[str, int]]:
        """Of these, how often each pair of bodies, joint and robot is in the way first."""
        return frequent(explain(self._cell.evaluator, self._failed))

    @cached_property
    def optimum(self) -> Optimum | None:
        """A short polish, None where none was asked for."""
        return _optimum(self._cell, self.progress) if self._polish else None

    @property
    def active_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of bodies that are checked."""
        return self._cell.geometry.pair_names

    @property
    def excluded_pairs(self) -> tuple[tuple[str, str, str], ...]:
        """Pairs that are not, and why."""
        geometry = self._cell.geometry
        names = [body.name for body in geometry.bodies]
        return tuple((names[p.first], names[p.second], p.reason) for p in geometry.excluded)

    @cached_property
    def files(self) -> tuple[str, ...]:
        """Pictures written.

        Raises:
            SettingsError: the folder cannot be made.
        """
        if self._output is None:
            return ()
        self.progress.note("drawing pictures (--no-pictures leaves them out)")
        return draw(self._cell, self._carries, self._explained, self._output)

    @cached_property
    def view(self) -> str:
        """The page that shows the hand-made trajectory, '' where none was asked for.

        Raises:
            DualArmError: it cannot be written.
        """
        if self._view is None:
            return ""
        return show(self._carries["initial"], self._explained.get("initial"), self._view)

    def document(self) -> dict[str, Any]:
        """All of it as JSON values; records are left to `dataclasses.asdict`."""
        public = [name for name, part in vars(Inspection).items() if _is_part(name, part)]
        return {name: getattr(self, name) for name in ("candidates", "seed", *public)}


def _is_part(name: str, part: object) -> bool:
    return isinstance(part, property | cached_property) and not name.startswith("_")


def _judged(carry: Carry) -> Judgement:
    assert carry.judgement is not None, "carries of a cell are judged"
    return carry.judgement


def _optimum(cell: Cell, progress: Progress) -> Optimum:
    """A short polish of the hand-made trajectory, and the bounds that bind where it ends."""
    verdicts = cell.evaluate(cell.initial)
    if not verdicts.feasible.all():
        return Optimum(0, (), "the hand-made trajectory, its start, is infeasible")
    progress.note("polishing the hand-made trajectory shortly (--no-polish leaves it out)")
    try:
        with progress.stage("short polish", POLISH_ATTEMPTS, "attempts") as advance:
            front = ho.polish(
                cell,
                Front.of_search(cell, "hand-made", verdicts),
                rng=np.random.default_rng(0),
                settings=ho.PolishSettings(attempts=POLISH_ATTEMPTS),
                told=lambda outcome: advance(1),
            )
    except SettingsError as error:
        return Optimum(0, (), str(error))
    return Optimum(len(front), binding_bounds(cell.workcell.task, front.x))


def _facts(workcell: Workcell) -> dict[str, str]:
    task, payload = workcell.task, workcell.payload
    facts = {
        f"robot {robot.name}": f"{robot.urdf.name}, base at {_vector(robot.T_world_base[:3, 3])} m"
        for robot in workcell.robots
    }
    facts["payload"] = (
        f"{payload.mass:g} kg, {_vector(payload.size)} m, centre of mass at "
        f"{_vector(payload.centre_of_mass)} m"
    )
    friction = ", ".join(f"{contact.friction:g}" for contact in workcell.contacts)
    radius = ", ".join(f"{1e3 * contact.patch_radius:g}" for contact in workcell.contacts)
    facts["contacts"] = f"friction {friction}, patch radius {radius} mm"
    facts["task"] = (
        f"{len(task.waypoints)} poses, {len(task.free_indices)} of them free ({task.n_var} "
        f"variables), {task.samples} samples, time law {task.time_law}, "
        f"{task.reference_speed:g} m/s"
    )
    facts["environment"] = ", ".join(body.name for body in workcell.environment) or "empty"
    return facts


def _vector(values: Array) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"


@dataclass(frozen=True)
class Branch:
    """A posture of one arm at the start and the least margins of the hand-made trajectory from
    there; see `symbolic.robot.branches.StartBranch`. The clearance is measured by FCL, 0 where
    bodies intersect and None where nothing can collide. Joints that slide are in mm, others in deg;
    `limit_margins` holds the least distance to a limit of either kind by its unit."""

    joints: tuple[float, ...]
    joint_units: tuple[str, ...]
    kept_samples: int
    clearance_mm: float | None
    limit_margins: dict[str, float]
    manipulability: float
    least_manipulability: float
    chosen: bool


def branches_of(cell: Cell, arm: int) -> tuple[Branch, ...]:
    """The postures of one arm (0 or 1) at the start, best first."""
    model = cell.compiled.model
    return tuple(_branch(cell, model, arm, branch) for branch in model.branches[arm])


def _branch(cell: Cell, model: CellModel, arm: int, branch: StartBranch) -> Branch:
    robot, units = cell.workcell.robots[arm], np.where(model.robots[arm].turning, "deg", "mm")
    factor = np.where(units == "deg", np.degrees(1.0), 1e3)
    path = branch.path[: max(branch.kept, 1)]
    room = np.minimum(path - robot.position_lower, robot.position_upper - path).min(axis=0) * factor
    return Branch(
        joints=tuple((branch.q * factor).round(2).tolist()),
        joint_units=tuple(units.tolist()),
        kept_samples=branch.kept,
        clearance_mm=_clearance_mm(cell, arm, branch),
        limit_margins={str(unit): float(room[units == unit].min()) for unit in np.unique(units)},
        manipulability=branch.manipulability,
        least_manipulability=cell.workcell.robots[arm].min_manipulability,
        chosen=bool(np.allclose(branch.q, model.start[arm])),
    )


def _clearance_mm(cell: Cell, arm: int, branch: StartBranch) -> float | None:
    """FCL's least distance of one arm from all but the other along the samples that it keeps."""
    checker, kept = cell.evaluator.checker, max(branch.kept, 1)
    own = own_pairs(cell.geometry, arm)
    if not own:
        return None
    pose = np.ascontiguousarray(initial_poses(cell.workcell)[:kept, :POSE_SIZE])
    path = np.ascontiguousarray(branch.path[:kept])
    absent = np.zeros((kept, cell.geometry.arms[1 - arm].joints))
    joints = (path, absent) if arm == 0 else (absent, path)
    bounds = np.full((kept, len(cell.geometry.active)), np.inf)
    bounds[:, own] = checker.bounds(pose, *joints)[:, own]
    return 1e3 * checker.min_distance(pose, joints[0], joints[1], bounds)[0]


def draw(
    cell: Cell,
    carries: Mapping[str, Carry],
    explained: Mapping[str, Explanation],
    output: Path,
) -> tuple[str, ...]:
    """The paper's Figures 4 and 5 as files, and each carry's first collision; their names.

    Args:
        cell: the cell.
        carries: by their names, 'initial' among them.
        explained: what is in the way of those that fail.
        output: folder.

    Raises:
        SettingsError: the folder cannot be made.
    """
    _made(output)
    geometry, initial = cell.geometry, shown("", carries["initial"])
    reach = reach_map(geometry, np.random.default_rng(0))
    with in_style():
        figures = {
            "reachable_regions": settled(reachable_regions(geometry, reach, initial)),
            "cell": settled(environment(geometry, initial)),
        }
        for name, why in explained.items():
            if why.pair is not None:
                at = carries[name].pose[why.sample], carries[name].q[why.sample]
                figures[f"collision_{name}"] = settled(meeting(geometry, why.pair, *at, str(why)))
    return tuple(
        str(path) for name, figure in figures.items() for path in save(figure, output, name)
    )


def show(carry: Carry, why: Explanation | None, path: Path) -> str:
    """Write the page that plays a carry; it begins where the carry fails, the bodies that meet
    there in red. Its name.

    Raises:
        SettingsError: its folder cannot be made.
        DisplayError: it cannot be written.
    """
    _made(path.parent)
    look = None if why is None else Look(why.sample, str(why), why.pair or ())
    CarryView(carry, look=look).save(path)
    return str(path)


def _made(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"--output {folder}: cannot be made ({error.strerror})") from error


_IN_THE_WAY = {
    "pairs": "Pairs that collide first",
    "joints": "Joints beyond a limit first",
    "reach": "Robots that do not reach first",
}
MOST_TOLD = 10
"""Most obstacles that are told."""


def told(found: Inspection, pairs: bool = False) -> Iterator[str]:
    """An inspection for people, in lines that come as soon as they are known.

    Args:
        pairs: whether every pair of bodies is listed.
    """
    yield from (found.name, "")
    yield from (f"  {heading}: {text}" for heading, text in found.facts.items())
    still = ", ".join(f"{force:.2f}" for force in found.static_normal_force)
    share = ", ".join(f"{value:.4f}" for value in found.static_objectives)
    yield ""
    yield (
        f"At rest, level: normal forces {still} N, objectives {share}; payload at the reference "
        f"force {found.static_payload_limit:.2f} kg"
    )
    if found.unheld:
        yield f"Infeasible, whatever the path: {found.unheld}"
    found.build()
    yield f"Hand-made trajectory: {_judged_text(found.initial)}"
    yield from _why(found, "initial")
    yield f"Straight line: {_judged_text(found.straight_line)}"
    yield from _why(found, "straight_line")
    yield from ("", "Postures at the start, best first (* used), along the hand-made trajectory")
    for robot, branches in found.branches.items():
        yield f"  {robot}"
        yield from (f"  {'*' if b.chosen else ' '} {_branch_text(b)}" for b in branches)
    yield ""
    yield (
        f"{found.candidates} random candidates within the bounds (seed {found.seed}): "
        f"{100.0 * found.feasible_share:.1f} % feasible"
    )
    for name, count in found.infeasible_by_reason.items():
        yield f"  {name.replace('_', ' ')}: {count} ({100.0 * count / found.candidates:.1f} %)"
    for heading, title in _IN_THE_WAY.items():
        counts = list(found.in_the_way[heading].items())[:MOST_TOLD]
        if counts:
            yield from ("", f"{title}, in {found.explained_candidates} of the infeasible ones:")
            yield from (f"  {name}: {count}" for name, count in counts)
    checked, left_out = len(found.active_pairs), len(found.excluded_pairs)
    yield ""
    yield f"Collision pairs: {checked} checked, {left_out} left out" + (
        "" if pairs else " (--pairs lists them, and why)"
    )
    if pairs:
        yield from (f"  {first} – {second}" for first, second in found.active_pairs)
        yield from (f"  {first} – {second}: {why}" for first, second, why in found.excluded_pairs)
    if found.optimum is not None:
        yield from ("", *_optimum_lines(found.optimum))
    if found.files:
        yield from ("", "Pictures: " + ", ".join(found.files))
    if found.view:
        yield from ("", f"View: {found.view} (open it in a browser)")


def _why(found: Inspection, name: str) -> list[str]:
    return [f"  {found.explained[name]}"] if name in found.explained else []


def _optimum_lines(optimum: Optimum) -> list[str]:
    if optimum.problem:
        return [f"Bounds at the optimum: not known: {optimum.problem}"]
    head = f"Bounds at the optimum ({optimum.solutions} points of a short polish)"
    if not optimum.binding:
        return [f"{head}: none binds"]
    return [
        f"{head}: these bind, wider ones may allow better carries",
        *(f"  {bound}: {bound.solutions} of {optimum.solutions}" for bound in optimum.binding),
    ]


def _branch_text(branch: Branch) -> str:
    joints = " ".join(
        f"{value:7.1f}" if unit == "deg" else f"{value:7.1f} {unit}"
        for value, unit in zip(branch.joints, branch.joint_units, strict=True)
    )
    limits = ", ".join(f"{margin:.0f} {unit}" for unit, margin in branch.limit_margins.items())
    near = "unlimited" if branch.clearance_mm is None else f"{branch.clearance_mm:.1f} mm"
    if branch.clearance_mm == 0.0:
        near = "none (collides)"
    return (
        f"[{joints}] deg: keeps {branch.kept_samples} samples, clearance {near}, limits {limits}, "
        f"manipulability {branch.manipulability:.4f} m^3 (at least {branch.least_manipulability:g})"
    )


def _judged_text(judgement: Judgement) -> str:
    forces = ", ".join(f"{value:.4f}" for value in judgement.objectives.values())
    return f"{judgement}, objectives {forces}" if judgement.feasible else str(judgement)


def inspect(options: argparse.Namespace) -> int:
    """Inspect the workcell that the options name, and print what is found; returns the exit code.

    Raises:
        DualArmError: the workcell is wrong, or a picture cannot be written.
    """
    output = options.output or Path("inspect") / options.workcell.stem
    found = Inspection(
        load_workcell(options.workcell),
        options.candidates,
        options.seed,
        None if options.no_pictures else output,
        options.polish,
        output / "view.html" if options.view else None,
    )
    found.progress = Progress()
    if options.json:
        found.build()
        print(json.dumps(found.document(), default=asdict, indent=2))
    else:
        for line in told(found, options.pairs):
            print(line, flush=True)
    return 0
