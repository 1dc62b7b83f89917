"""An inspection of a workcell before a study; `studies.inspect` prints it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hybrid_opt as ho
from hybrid_opt.carry import Judgement
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.explanation import Explanation, explain, frequent
from hybrid_opt.front import Front
from hybrid_opt.indicators.bounds import BindingBound, binding_bounds
from studies.inspection_pictures import draw, show
from symbolic.array import Array
from symbolic.cell_model import CellModel, own_pairs
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from symbolic.records.task import straight_line
from symbolic.robot.branches import StartBranch, initial_poses

EXPLAINED = 200
"""Most infeasible candidates that are looked at closer."""

POLISH_ATTEMPTS = 10
"""Solves of the short polish: the trajectory itself, then ends, middle and gaps of what it
becomes."""


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


@dataclass(frozen=True)
class Inspection:
    """Everything that the program prints.

    Attributes:
        name: of the workcell.
        facts: what is in the file, by heading.
        branches: per robot's name its postures at the start, best first.
        static_normal_force: of both robots, the level payload at rest [N].
        static_objectives: the same over the reference forces.
        static_payload_limit: payload that reaches the reference force at rest [kg].
        initial, straight_line: verdicts on the hand-made trajectory and on the straight line.
        explained: by 'initial' and 'straight_line' what is in the way of them, where they fail.
        candidates: random candidates judged.
        seed: of their randomness.
        feasible_share: of them.
        infeasible_by_reason: of them, by the constraint violated first.
        explained_candidates: infeasible ones of them that were looked at closer.
        in_the_way: of these, how often each pair of bodies, joint and robot is in the way first.
        optimum: a short polish, None where none was asked for.
        active_pairs: pairs of bodies that are checked.
        excluded_pairs: pairs that are not, and why.
        files: pictures written.
        view: the page that shows the hand-made trajectory, '' where none was asked for.
    """

    name: str
    facts: dict[str, str]
    branches: dict[str, tuple[Branch, ...]]
    static_normal_force: tuple[float, ...]
    static_objectives: tuple[float, ...]
    static_payload_limit: float
    initial: Judgement
    straight_line: Judgement
    explained: dict[str, str]
    candidates: int
    seed: int
    feasible_share: float
    infeasible_by_reason: dict[str, int]
    explained_candidates: int
    in_the_way: dict[str, dict[str, int]]
    optimum: Optimum | None
    active_pairs: tuple[tuple[str, str], ...]
    excluded_pairs: tuple[tuple[str, str, str], ...]
    files: tuple[str, ...]
    view: str


def inspect(
    workcell: Workcell,
    candidates: int,
    seed: int,
    output: Path | None,
    polish: bool = False,
    view: Path | None = None,
) -> Inspection:
    """Look at a workcell.

    Args:
        workcell: the cell.
        candidates: random ones to judge, at least 1.
        seed: of their randomness.
        output: folder for the pictures, None to draw none.
        polish: whether to polish the hand-made trajectory shortly, to see which bounds bind.
        view: file for a page that shows the hand-made trajectory, None for none.

    Raises:
        SettingsError: no candidates.
        DualArmError: the cell cannot be modelled, or the folder not written.
    """
    if candidates < 1:
        raise SettingsError(f"--candidates is {candidates}; at least 1 is needed")
    cell = Cell(workcell)
    model = cell.compiled.model
    found = cell.evaluate(cell.random(candidates, np.random.default_rng(seed)))
    hold = cell.static_hold
    geometry = model.geometry
    names = [body.name for body in geometry.bodies]
    initial = cell.carry(cell.initial)
    line = cell.carry(straight_line(workcell.task))
    assert initial.judgement is not None
    assert line.judgement is not None
    failed = found[~found.feasible][:EXPLAINED]
    explained = _explained(cell, {"initial": initial.x, "straight_line": line.x})
    carries = {"initial": initial, "straight_line": line}
    return Inspection(
        name=workcell.name,
        facts=_facts(workcell),
        branches={robot.name: _branches(cell, model, i) for i, robot in enumerate(workcell.robots)},
        static_normal_force=tuple(hold.normal_force.tolist()),
        static_objectives=tuple((hold.normal_force / workcell.task.reference_force).tolist()),
        static_payload_limit=hold.payload_limit,
        initial=initial.judgement,
        straight_line=line.judgement,
        explained={name: str(why) for name, why in explained.items()},
        candidates=candidates,
        seed=seed,
        feasible_share=float(found.feasible.mean()),
        infeasible_by_reason=found.infeasible_by_reason,
        explained_candidates=len(failed),
        in_the_way=frequent(explain(cell.evaluator, failed)),
        optimum=_optimum(cell) if polish else None,
        active_pairs=geometry.pair_names,
        excluded_pairs=tuple(
            (names[p.first], names[p.second], p.reason) for p in geometry.excluded
        ),
        files=() if output is None else draw(cell, carries, explained, output),
        view="" if view is None else show(initial, explained.get("initial"), view),
    )


def _explained(cell: Cell, candidates: dict[str, Array]) -> dict[str, Explanation]:
    """Explanations of the trajectories that fail, by their names."""
    found = {}
    for name, x in candidates.items():
        for explanation in explain(cell.evaluator, cell.evaluate(x)):
            found[name] = explanation
    return found


def _optimum(cell: Cell) -> Optimum:
    """A short polish of the hand-made trajectory, and the bounds that bind where it ends."""
    verdicts = cell.evaluate(cell.initial)
    if not verdicts.feasible.all():
        return Optimum(0, (), "the hand-made trajectory, its start, is infeasible")
    try:
        front = ho.polish(
            cell,
            Front.of_search(cell, "hand-made", verdicts),
            rng=np.random.default_rng(0),
            settings=ho.PolishSettings(attempts=POLISH_ATTEMPTS),
        )
    except SettingsError as error:
        return Optimum(0, (), str(error))
    return Optimum(len(front), binding_bounds(cell.workcell.task, front.x))


def _branches(cell: Cell, model: CellModel, arm: int) -> tuple[Branch, ...]:
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
    pose = np.ascontiguousarray(initial_poses(cell.workcell)[:kept])
    path = np.ascontiguousarray(branch.path[:kept])
    absent = np.zeros((kept, cell.geometry.arms[1 - arm].joints))
    joints = (path, absent) if arm == 0 else (absent, path)
    bounds = np.full((kept, len(cell.geometry.active)), np.inf)
    bounds[:, own] = checker.bounds(pose, *joints)[:, own]
    return 1e3 * checker.min_distance(pose, joints[0], joints[1], bounds)[0]


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
