"""Facts about a workcell before a study, for `studies.inspect`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hybrid_opt as ho
from hybrid_opt.carry import Carry, Judgement
from hybrid_opt.cell import Cell
from hybrid_opt.compiled_cell import InterpretedCell, is_interpretable
from hybrid_opt.evaluate.explanation import Explanation, explain, frequent
from hybrid_opt.front import Front
from hybrid_opt.indicators.metrics import BindingBound, binding_bounds
from hybrid_opt.progress import Progress, as_callback
from hybrid_opt.robust.budget import budget_text
from studies.program import ProgramResult, load_workcell, print_findings
from symbolic.array import Array
from symbolic.cell_model import own_pairs
from symbolic.errors import SettingsError
from symbolic.geometry.bodies import MeshReader, collision_bodies
from symbolic.records import Workcell
from symbolic.records.task import straight_line
from symbolic.robot.branches import StartBranch

EXPLAINED = 100
"""Largest number of infeasible candidates that are examined."""

SHORT_POLISH_ATTEMPTS = 10
"""Number of attempts of the short polish: first the trajectory itself, then ends, middle and gaps
of the resulting front."""


@dataclass(frozen=True)
class Optimum:
    """Result of a short polish that starts at the hand-made trajectory.

    Attributes:
        solutions: number of solutions of the polished front.
        binding: bounds of decision variables that solutions lie on.
        problem: reason why no polish was possible, else ''.
    """

    solutions: int
    binding: tuple[BindingBound, ...]
    problem: str = ""


def inspected(
    workcell: Workcell,
    candidates: int,
    seed: int,
    output: Path | None = None,
    *,
    polish: bool = False,
    view: Path | None = None,
    pairs: bool = False,
    progress: Progress | None = None,
) -> Iterator[ProgramResult]:
    """Yield all findings about a cell. Each is computed when it is requested.

    Args:
        workcell: the cell.
        candidates: number of random candidates, at least 1.
        seed: seed of the random candidates.
        output: folder for the pictures; None to draw none.
        polish: True to polish the hand-made trajectory briefly, to find active bounds.
        view: file for a page that shows the hand-made trajectory; None for none.
        pairs: True to list every pair of bodies.
        progress: receives messages on the progress of the polish; None for none.

    Raises:
        DualArmError: the model cannot be built, or a picture cannot be written.
    """
    progress = progress or Progress(shown=False)
    is_interpreted = not polish and is_interpretable(workcell)
    cell = Cell(workcell, compiled=InterpretedCell(workcell) if is_interpreted else None)
    yield ProgramResult({"candidates": candidates, "seed": seed})
    facts = _facts(workcell)
    yield ProgramResult(
        {"name": workcell.name, "facts": facts},
        (workcell.name, "", *(f"  {heading}: {text}" for heading, text in facts.items()), ""),
    )
    if not is_interpreted:
        # Not imported at the top: it brings the searches, which nothing else here needs.
        from hybrid_opt.campaign.stages import Maker, build_all

        makers: list[Maker] = [lambda: cell.evaluator]
        if polish:
            makers.append(lambda: cell.polish_functions)
        # Whoever needs what cannot be compiled reports it.
        build_all(makers, progress)
    yield _at_rest(cell)
    carries = {
        "initial": cell.carry(cell.initial),
        "straight_line": cell.carry(straight_line(workcell.task)),
    }
    whys: dict[str, Explanation] = {}
    for (name, carry), title in zip(
        carries.items(), ("Hand-made trajectory", "Straight line"), strict=True
    ):
        assert carry.judgement is not None, "carries of a cell are judged"
        for why in explain(cell.evaluator, cell.evaluate(carry.x)):
            whys[name] = why
        told = (f"  {whys[name]}",) if name in whys else ()
        yield ProgramResult(
            {name: carry.judgement}, (f"{title}: {_judged_text(carry.judgement)}", *told)
        )
    yield ProgramResult({"explained": {name: str(why) for name, why in whys.items()}})
    yield _postures(cell)
    yield from _candidates(cell, candidates, seed)
    yield _meshes(workcell)
    yield _pairs(cell, pairs)
    optimum = _optimum(cell, progress) if polish else None
    lines = () if optimum is None else ("", *_optimum_lines(optimum))
    yield ProgramResult({"optimum": optimum}, lines)
    files: tuple[str, ...] = ()
    if output is not None:
        progress.note("drawing pictures (--no-pictures leaves them out)")
        files = draw(cell, carries, whys, output)
    yield ProgramResult({"files": files}, ("", "Pictures: " + ", ".join(files)) if files else ())
    shown = "" if view is None else show(carries["initial"], whys.get("initial"), view)
    yield ProgramResult(
        {"view": shown}, ("", f"View: {shown} (open it in a browser)") if shown else ()
    )


def _at_rest(cell: Cell) -> ProgramResult:
    """Compute the normal forces that hold the level payload at rest, and whether the reference
    forces allow them."""
    hold, static_hold_error = cell.static_hold, cell.static_hold_error
    force = hold.normal_force
    share = force / cell.workcell.task.reference_force
    still, objectives = (
        ", ".join(f"{value:.{digits}f}" for value in values)
        for values, digits in ((force, 2), (share, 4))
    )
    lines = [
        f"At rest, level: normal forces {still} N, objectives {objectives}; payload at the "
        f"reference force {hold.payload_limit:.2f} kg"
    ]
    lines += [f"Infeasible, whatever the path: {static_hold_error}"] if static_hold_error else []
    lines.append(f"G{budget_text(cell.workcell)[1:]}")
    values = {
        "static_normal_force": tuple(force.tolist()),
        "static_objectives": tuple(share.tolist()),
        "static_payload_limit": hold.payload_limit,
        "unheld": static_hold_error,
        "grip": lines[-1],
    }
    return ProgramResult(values, tuple(lines))


def _postures(cell: Cell) -> ProgramResult:
    """Return the postures with which each robot can hold the box at the start, best first."""
    robots = cell.workcell.robots
    found = cell.compiled.model.branches
    branches = {
        robot.name: tuple(_branch(cell, i, branch) for branch in found[i])
        for i, robot in enumerate(robots)
    }
    lines = ["", "Postures at the start, best first (* used), along the hand-made trajectory"]
    for name, own in branches.items():
        lines.append(f"  {name}")
        lines += [f"  {'*' if b.chosen else ' '} {_branch_text(b)}" for b in own]
    return ProgramResult({"branches": branches}, tuple(lines))


def _candidates(cell: Cell, count: int, seed: int) -> Iterator[ProgramResult]:
    """Evaluate random candidates. Yield how many are feasible, then why the infeasible ones are
    infeasible.

    Args:
        cell: the cell.
        count: number of candidates.
        seed: seed of the random numbers.
    """
    found = cell.evaluate(cell.random(count, np.random.default_rng(seed)))
    share, reasons = float(found.feasible.mean()), found.infeasible_by_reason
    lines = [
        "",
        f"{count} random candidates within the bounds (seed {seed}): "
        f"{100.0 * share:.1f} % feasible",
    ]
    for name, number in reasons.items():
        lines.append(f"  {name.replace('_', ' ')}: {number} ({100.0 * number / count:.1f} %)")
    yield ProgramResult({"feasible_share": share, "infeasible_by_reason": reasons}, tuple(lines))
    failed = found[~found.feasible][:EXPLAINED]
    in_the_way = frequent(explain(cell.evaluator, failed))
    lines = []
    for heading, title in _IN_THE_WAY.items():
        counts = list(in_the_way[heading].items())[:MOST_TOLD]
        if counts:
            lines += ["", f"{title}, in {len(failed)} of the infeasible ones:"]
            lines += [f"  {name}: {number}" for name, number in counts]
    yield ProgramResult(
        {"explained_candidates": len(failed), "in_the_way": in_the_way}, tuple(lines)
    )


def _meshes(workcell: Workcell) -> ProgramResult:
    """Return the size of each mesh file, and of the convex pieces that it is split into."""
    reader = MeshReader()
    collision_bodies(workcell, reader)
    sizes = {
        path.name: {
            "parts": mesh.parts,
            "open_parts": mesh.open_parts,
            "vertices": mesh.vertices,
            "pieces": len(mesh.hulls),
            "corners": sum(len(hull.vertices) for hull in mesh.hulls),
        }
        for (path, _), mesh in reader.known.items()
    }
    lines = [
        f"  {name}: {size['vertices']} vertices in {size['parts']} part(s) became "
        f"{size['corners']} in {size['pieces']} convex piece(s)"
        + (f"; {size['open_parts']} part(s) with holes became hulls" if size["open_parts"] else "")
        for name, size in sizes.items()
    ]
    return ProgramResult({"meshes": sizes}, ("", "Meshes:", *lines) if lines else ())


def _pairs(cell: Cell, listed: bool) -> ProgramResult:
    """Return the pairs of bodies that are checked for collisions, and those that are not, with the
    reasons.

    Args:
        cell: the cell.
        listed: True to list every pair by name.
    """
    geometry = cell.geometry
    names, active = [body.name for body in geometry.bodies], geometry.pair_names
    excluded = tuple((names[p.first], names[p.second], p.reason) for p in geometry.excluded)
    lines = [
        "",
        f"Collision pairs: {len(active)} checked, {len(excluded)} left out"
        + ("" if listed else " (--pairs lists them, and why)"),
    ]
    if listed:
        lines += [f"  {first} – {second}" for first, second in active]
        lines += [f"  {first} – {second}: {why}" for first, second, why in excluded]
    return ProgramResult({"active_pairs": active, "excluded_pairs": excluded}, tuple(lines))


def _optimum(cell: Cell, progress: Progress) -> Optimum:
    """Polish the hand-made trajectory of a cell briefly, to find the bounds of decision variables
    that are active at the optimum.

    Args:
        cell: the cell.
        progress: receives messages on the progress.

    Returns:
        The result of the polish, and the active bounds.
    """
    verdicts = cell.evaluate(cell.initial)
    if not verdicts.feasible.all():
        return Optimum(0, (), "the hand-made trajectory, its start, is infeasible")
    try:
        with progress.stage("short polish", SHORT_POLISH_ATTEMPTS, "attempts") as advance:
            front = ho.polish(
                Front.of_search(cell, "hand-made", verdicts),
                rng=np.random.default_rng(0),
                settings=ho.PolishSettings(attempts=SHORT_POLISH_ATTEMPTS),
                progress=as_callback(advance),
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
        f"variables), {task.samples} samples, time law {task.law.name}, "
        f"{task.reference_speed:g} m/s"
    )
    facts["environment"] = ", ".join(body.name for body in workcell.environment) or "empty"
    return facts


def _vector(values: Array) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"


@dataclass(frozen=True)
class Branch:
    """A posture of one arm at the start (`symbolic.robot.branches.StartBranch`), with the smallest
    margins along the hand-made trajectory from this posture.

    Attributes:
        joints: joint positions of the posture, in the unit of each joint.
        joint_units: 'deg' for turning and 'mm' for sliding joints.
        kept_samples: number of samples of the trajectory that the arm can follow from this posture.
        clearance_mm: least distance of the arm from other bodies [mm]; 0 if bodies intersect, None
            if nothing can collide.
        limit_margins: least distance of a joint from its limits, by unit.
        manipulability: least manipulability along the trajectory [m^3].
        least_manipulability: manipulability that the robot's description requires [m^3].
        chosen: True if the cell uses this posture.
    """

    joints: tuple[float, ...]
    joint_units: tuple[str, ...]
    kept_samples: int
    clearance_mm: float | None
    limit_margins: dict[str, float]
    manipulability: float
    least_manipulability: float
    chosen: bool


def _branch(cell: Cell, arm: int, branch: StartBranch) -> Branch:
    model = cell.compiled.model
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
    """Measure the least distance of one arm from all other bodies by FCL [mm].

    It is measured along those samples of the hand-made trajectory that the arm can follow from a
    start branch. The result is None if no pair of bodies includes the arm.

    Args:
        cell: the cell.
        arm: index of the arm.
        branch: the start branch.
    """
    checker, kept = cell.evaluator.checker, max(branch.kept, 1)
    own = own_pairs(cell.geometry, arm)
    if not own:
        return None
    pose = np.ascontiguousarray(cell.carry(cell.initial).pose[:kept])
    path = np.ascontiguousarray(branch.path[:kept])
    absent = np.zeros((kept, cell.geometry.arms[1 - arm].joints))
    joints = (path, absent) if arm == 0 else (absent, path)
    bounds = np.full((kept, len(cell.geometry.active)), np.inf)
    bounds[:, own] = checker.bounds(pose, *joints)[:, own]
    return 1e3 * checker.min_distance(pose, joints[0], joints[1], bounds)


def draw(
    cell: Cell,
    carries: Mapping[str, Carry],
    explained: Mapping[str, Explanation],
    output: Path,
) -> tuple[str, ...]:
    """Draw the regions that the pads reach and the cell at the start (the paper's Figures 4 and 5)
    and, for each carry that fails by a collision, the colliding bodies.

    Args:
        cell: the cell.
        carries: carries by name; 'initial' is among them.
        explained: first failure of each carry that fails, by the name of the carry.
        output: folder of the pictures.

    Returns:
        Names of the files.

    Raises:
        SettingsError: the folder cannot be made.
    """
    # Not imported at the top: without pictures nothing of it is needed.
    from studies.report.drawing import DrawnCarry, in_style, save, settled
    from studies.report.pictures_cell import environment, meeting, reach_map, reachable_regions

    make_folder(output)
    geometry, initial = cell.geometry, DrawnCarry("", carries["initial"])
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
    drawn = figures.items()
    return tuple(str(path) for name, one in drawn for path in save(one, output, name, pdf=False))


def show(carry: Carry, why: Explanation | None, path: Path) -> str:
    """Write a page that plays a carry from its first failure on, with colliding bodies in red.

    Args:
        carry: the carry.
        why: the first failure; None for a feasible carry.
        path: path of the page.

    Returns:
        Name of the file.

    Raises:
        SettingsError: the folder of the file cannot be made.
        DisplayError: the file cannot be written.
    """
    from hybrid_opt.display.scene import CarryView, Look

    make_folder(path.parent)
    look = None if why is None else Look(why.sample, str(why), why.pair or ())
    CarryView(carry, look=look).save(path)
    return str(path)


def make_folder(folder: Path) -> None:
    """Make the folder of `--output`.

    Raises:
        SettingsError: it cannot be made.
    """
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
"""Largest number of obstacles that are listed."""


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
    """Inspect the workcell in the options, and print the findings. Return the exit code.

    Raises:
        DualArmError: the workcell is invalid, or a picture cannot be written.
    """
    if options.reach:
        # Not imported at the top: it brings the proposals, which nothing else here needs.
        from studies.programs.reach import inspect_reach

        return inspect_reach(options)
    output = options.output
    findings = inspected(
        load_workcell(options.workcell),
        options.candidates,
        options.seed,
        None if options.no_pictures else output,
        polish=options.polish,
        view=output / "view.html" if options.view else None,
        pairs=options.pairs,
        progress=Progress(),
    )
    print_findings(findings, options.json)
    return 0
