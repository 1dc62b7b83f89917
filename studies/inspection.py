"""What there is to know of a workcell before a study; `studies.inspect` prints it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybrid_opt.evaluate.evaluation import FEASIBLE, REASONS, CandidateEvaluator, Evaluations
from hybrid_opt.evaluate.static_hold import static_hold
from hybrid_opt.timing import TimingModel
from studies.report.data import carry_of
from studies.report.figures_cell import environment, reachable_regions
from studies.report.reach import reach_map
from studies.report.style import in_style, save, settled
from symbolic.array import Array
from symbolic.cell_model import CellModel, build_cell_model
from symbolic.errors import SettingsError
from symbolic.robot.branches import StartBranch
from symbolic.workcell.records import Workcell

_CHUNK = 500


@dataclass(frozen=True)
class Judged:
    """The verdict on one trajectory.

    Attributes:
        feasible: whether it satisfies every constraint.
        reason: the constraint violated first, '' if none is.
        position: path parameter of the first violation, None if there is none.
        objectives: peak normal forces over the reference forces, without penalty.
    """

    feasible: bool
    reason: str
    position: float | None
    objectives: tuple[float, ...]


@dataclass(frozen=True)
class Branch:
    """A posture of one arm at the start and the least margins of the hand-made trajectory from
    there; see `symbolic.robot.branches.StartBranch`. clearance_mm is None where nothing can
    collide."""

    joints_deg: tuple[float, ...]
    kept_samples: int
    clearance_mm: float | None
    limit_margin_deg: float
    manipulability: float
    chosen: bool


@dataclass(frozen=True)
class Inspection:
    """What the program prints.

    Attributes:
        name: of the workcell.
        facts: what is in the file, by heading.
        branches: per robot's name its postures at the start, best first.
        static_normal_force: of both robots, the level payload at rest [N].
        static_objectives: the same over the reference forces.
        static_payload_limit: payload that reaches the reference force at rest [kg].
        initial, straight_line: verdicts on the hand-made trajectory and on the straight line.
        candidates: random candidates judged.
        seed: of their randomness.
        feasible_share: of them.
        infeasible_by_reason: of them, by the constraint violated first.
        active_pairs: pairs of bodies that are checked.
        excluded_pairs: pairs that are not, and why.
        files: pictures written.
    """

    name: str
    facts: dict[str, str]
    branches: dict[str, tuple[Branch, ...]]
    static_normal_force: tuple[float, ...]
    static_objectives: tuple[float, ...]
    static_payload_limit: float
    initial: Judged
    straight_line: Judged
    candidates: int
    seed: int
    feasible_share: float
    infeasible_by_reason: dict[str, int]
    active_pairs: tuple[tuple[str, str], ...]
    excluded_pairs: tuple[tuple[str, str, str], ...]
    files: tuple[str, ...]


def inspect(workcell: Workcell, candidates: int, seed: int, output: Path | None) -> Inspection:
    """Look at a workcell.

    Args:
        workcell: the cell.
        candidates: random ones to judge, at least 1.
        seed: of their randomness.
        output: folder for the pictures, None to draw none.

    Raises:
        SettingsError: no candidates.
        DualArmError: the cell cannot be modelled, or the folder not written.
    """
    if candidates < 1:
        raise SettingsError(f"--candidates is {candidates}; at least 1 is needed")
    model = build_cell_model(workcell)
    evaluator = CandidateEvaluator(workcell)
    found = _random_candidates(evaluator, candidates, np.random.default_rng(seed))
    reasons = Counter(REASONS[code] for code in found.tolist() if code != FEASIBLE)
    hold = static_hold(workcell)
    geometry = model.geometry
    names = [body.name for body in geometry.bodies]
    initial = workcell.task.initial.reshape(-1)
    return Inspection(
        name=workcell.name,
        facts=_facts(workcell),
        branches={robot.name: _branches(model, i) for i, robot in enumerate(workcell.robots)},
        static_normal_force=tuple(hold.normal_force.tolist()),
        static_objectives=tuple((hold.normal_force / workcell.task.reference_force).tolist()),
        static_payload_limit=hold.payload_limit,
        initial=_judged(evaluator.evaluate(initial[None])),
        straight_line=_judged(evaluator.evaluate(straight_line(workcell)[None])),
        candidates=candidates,
        seed=seed,
        feasible_share=float((found == FEASIBLE).mean()),
        infeasible_by_reason=dict(reasons.most_common()),
        active_pairs=geometry.pair_names,
        excluded_pairs=tuple(
            (names[p.first], names[p.second], p.reason) for p in geometry.excluded
        ),
        files=() if output is None else _draw(model, initial, output),
    )


def straight_line(workcell: Workcell) -> Array:
    """(n_var,) free waypoints evenly spaced on the straight lines between the fixed ones."""
    waypoints = workcell.task.waypoints
    fixed = [i for i, waypoint in enumerate(waypoints) if waypoint.is_fixed]
    poses = np.array([waypoint.lower for waypoint in waypoints])
    numbers = np.arange(len(waypoints))
    line = np.column_stack(
        [np.interp(numbers, fixed, poses[fixed, component]) for component in range(6)]
    )
    return np.asarray(line[list(workcell.task.free_indices)]).reshape(-1)


def _random_candidates(
    evaluator: CandidateEvaluator, count: int, rng: np.random.Generator
) -> Array:
    """(count,) reasons of uniformly random candidates."""
    reasons = []
    for begin in range(0, count, _CHUNK):
        size = (min(_CHUNK, count - begin), evaluator.n_var)
        x = rng.uniform(evaluator.lower, evaluator.upper, size)
        reasons.append(evaluator.evaluate(x).reason)
    return np.concatenate(reasons)


def _judged(evaluations: Evaluations) -> Judged:
    feasible = bool(evaluations.feasible[0])
    return Judged(
        feasible,
        "" if feasible else REASONS[int(evaluations.reason[0])],
        None if feasible else float(evaluations.position[0]),
        tuple(evaluations.objectives[0].tolist()),
    )


def _branches(model: CellModel, arm: int) -> tuple[Branch, ...]:
    return tuple(_branch(branch, model.start[arm]) for branch in model.branches[arm])


def _branch(branch: StartBranch, start: Array) -> Branch:
    return Branch(
        tuple(np.degrees(branch.q).round(2).tolist()),
        branch.kept,
        1e3 * branch.clearance if np.isfinite(branch.clearance) else None,
        float(np.degrees(branch.limit_margin)),
        branch.manipulability,
        bool(np.allclose(branch.q, start)),
    )


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


def _draw(model: CellModel, initial: Array, output: Path) -> tuple[str, ...]:
    """The paper's Figures 4 and 5 as files."""
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"--output {output}: cannot be made ({error.strerror})") from error
    geometry = model.geometry
    carry = carry_of(CandidateEvaluator(model.workcell), TimingModel(model.workcell), initial, "")
    reach = reach_map(geometry, np.random.default_rng(0))
    with in_style():
        figures = {
            "reachable_regions": settled(reachable_regions(geometry, reach, carry)),
            "cell": settled(environment(geometry, carry)),
        }
    return tuple(
        str(path) for name, figure in figures.items() for path in save(figure, output, name)
    )
