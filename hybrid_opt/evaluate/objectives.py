"""Objectives of a search, each a pure function of the evaluator's outputs; and which points of a
set are non-dominated in them, its front.

The paper's two objectives are the peak normal forces of both robots (Eq. 60). All objectives are
dimensionless, and scaled such that values of interest are below one. The paper's penalty gives
every infeasible candidate values above one, so it works with any selection of objectives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from symbolic.records.problems import shown

Outputs = Mapping[str, Array]
"""Batch outputs of the candidate function, each with a leading axis over candidates."""

Evaluate = Callable[[Outputs, Workcell], Array]
"""Function from the batch outputs of n candidates and the workcell to values (n,), or (n, 2) by
robot."""


@dataclass(frozen=True)
class Objective:
    """One objective to be minimised.

    Attributes:
        name: name on the command line and in results.
        title: name on axes and in tables.
        evaluate: function from the evaluator's outputs and the workcell to values (n,) of n
            candidates.
        needs: names of the outputs that `evaluate` uses; None if unknown, which makes evaluation
            slower.
    """

    name: str
    title: str
    evaluate: Evaluate
    needs: tuple[str, ...] | None = None


PAPER_OBJECTIVES = ("peak_force_1", "peak_force_2")
"""The paper's pair: peak normal force of each robot."""

ROBUST_OBJECTIVES = ("robust_force_1", "robust_force_2")
"""The paper's pair, with the forces of every case of the workcell's uncertainty."""

FORCE_PAIRS = (PAPER_OBJECTIVES, ROBUST_OBJECTIVES)
"""Pairs of objectives that the polish of forces minimises: peak forces of both robots."""


@dataclass(frozen=True)
class ForceKind:
    """Kind of normal force that is limited and minimised in drivable carries: planned or robust.

    Drivable carries, those of drivable cells, are timed from rest to rest within all limits.

    Attributes:
        robust: whether the force holds the box in every case of the workcell's uncertainty.
        drivable: names of the two objectives of drivable cells: duration and largest force.
        name: name of the force in sentences.
        title: title of the largest force on axes.
        pressing: words before the largest force in the description of a carry.
    """

    robust: bool
    drivable: tuple[str, str]
    name: str
    title: str
    pressing: str


PLANNED_FORCE = ForceKind(
    robust=False,
    drivable=("duration", "peak_force"),
    name="force",
    title="largest normal force",
    pressing="pressing with at most",
)
ROBUST_FORCE = ForceKind(
    robust=True,
    drivable=("duration", "robust_force"),
    name="robust force",
    title="largest robust force",
    pressing="held in every case by at most",
)

DRIVABLE_OBJECTIVES = PLANNED_FORCE.drivable
ROBUST_DRIVABLE_OBJECTIVES = ROBUST_FORCE.drivable
DRIVABLE_PAIRS = (DRIVABLE_OBJECTIVES, ROBUST_DRIVABLE_OBJECTIVES)
"""Pairs of objectives of the drivable experiment."""


def _of_robot(robot: int, forces: Evaluate) -> Evaluate:
    return lambda outputs, workcell: forces(outputs, workcell)[:, robot]


def _larger(forces: Evaluate) -> Evaluate:
    return lambda outputs, workcell: np.asarray(forces(outputs, workcell).max(axis=1), dtype=float)


def _peak_forces(outputs: Outputs, workcell: Workcell) -> Array:
    """Compute the peak normal forces (n, 2) of both robots for n candidates, divided by the
    reference forces.

    The peaks cover the whole path if the timing computes them, else only the samples.

    Args:
        outputs: outputs of the evaluator by name.
        workcell: the cell.
    """
    known = outputs.get("peak_force")
    peaks = outputs["normal_force"].max(axis=1) if known is None else known
    return np.asarray(peaks / workcell.task.reference_force)


def _mean_force(outputs: Outputs, workcell: Workcell) -> Array:
    """Compute the normal force averaged over time and both robots, divided by the mean reference
    force, (n,) for n candidates.

    Args:
        outputs: outputs of the evaluator by name.
        workcell: the cell.
    """
    both, time = outputs["normal_force"].mean(axis=2), outputs["time"]
    mean = np.trapezoid(both, time, axis=1) / (time[:, -1] - time[:, 0])
    return np.asarray(mean / float(workcell.task.reference_force.mean()), dtype=float)


def _duration(outputs: Outputs, workcell: Workcell) -> Array:
    """Compute the durations (n,) of n candidates, divided by `duration_unit`.

    Args:
        outputs: outputs of the evaluator by name.
        workcell: the cell.
    """
    duration = outputs["time"][:, -1] / duration_unit(workcell)
    return np.asarray(duration, dtype=float)


def _peak_torque_use(outputs: Outputs, workcell: Workcell) -> Array:
    """Compute the largest ratio (n,), for n candidates, of a joint torque to the joint's torque
    limit. Only torques of the contact wrenches count.

    Args:
        outputs: outputs of the evaluator by name.
        workcell: the cell.
    """
    uses = [
        (np.abs(outputs[f"joint_torque_{i + 1}"]) / robot.torque_max).max(axis=(1, 2))
        for i, robot in enumerate(workcell.robots)
    ]
    return np.asarray(np.maximum(uses[0], uses[1]), dtype=float)


def _force_imbalance(outputs: Outputs, workcell: Workcell) -> Array:
    """Compute the largest difference between the two normal forces, divided by the mean reference
    force, (n,) for n candidates.

    Args:
        outputs: outputs of the evaluator by name.
        workcell: the cell.
    """
    forces = outputs["normal_force"]
    difference: Array = np.abs(forces[:, :, 0] - forces[:, :, 1]).max(axis=1)
    return difference / float(workcell.task.reference_force.mean())


def _joint_length(outputs: Outputs, workcell: Workcell) -> Array:
    """Compute the length of the path in the joint space of both arms, divided by the norm of the
    vector of joint ranges, (n,) for n candidates.

    Args:
        outputs: outputs of the evaluator by name.
        workcell: the cell.
    """
    steps = [np.diff(outputs[name], axis=1) for name in _JOINTS]
    length = np.sqrt(sum((step**2).sum(axis=2) for step in steps)).sum(axis=1)
    ranges = workcell.stack_joint_limits("position_upper") - workcell.stack_joint_limits(
        "position_lower"
    )
    return np.asarray(length / np.linalg.norm(ranges), dtype=float)


def _friction_use(outputs: Outputs, workcell: Workcell) -> Array:
    """Compute for n candidates the largest share (n,) of the available friction that the carry
    uses, if both arms press with their reference forces.

    Args:
        outputs: outputs of the evaluator by name.
        workcell: the cell.
    """
    # Not imported at the top: programs' options name objectives without CasADi.
    from symbolic.contact.registry import contact_model

    forces = outputs["normal_force"], outputs["tangential_force"]
    return contact_model(workcell).friction_use(*forces)


def _robust_forces(outputs: Outputs, workcell: Workcell) -> Array:
    """Compute the peak robust force (n, 2) of each arm for n candidates, divided by the arm's
    reference force.

    Robust forces hold the box in every case of the uncertainty (`hybrid_opt.robust`). Arm 2 presses
    with the commanded force; the force of arm 1, which is position-controlled, follows. The peaks
    cover the whole path if the timing limits robust forces, else only the samples.

    Args:
        outputs: outputs of the evaluator by name.
        workcell: the cell.
    """
    if "robust_force" in outputs:
        return np.asarray(outputs["robust_force"] / workcell.task.reference_force)
    # Imported here: only this objective needs its compiled functions.
    from hybrid_opt.carry import BoxMotion
    from hybrid_opt.robust.force import robust_model

    n, samples = outputs["pose"].shape[:2]
    flat = [outputs[name].reshape(n * samples, 6) for name in ("pose", "rate", "second_rate")]
    commanded, leading = robust_model(workcell).hold(BoxMotion(*flat), workcell.uncertainty)
    both = np.stack([leading, commanded], axis=1).reshape(n, samples, 2)
    uses: Array = both.max(axis=1) / workcell.task.reference_force
    return uses


def duration_unit(workcell: Workcell) -> float:
    """Compute the duration [s] for which the objective `duration` is 1.

    It is twice the time of the hand-made trajectory at the reference speeds, with straight motions
    between its waypoints.
    """
    return 2.0 * workcell.task.initial_time


_FORCE = ("normal_force",)
_TORQUES = ("joint_torque_1", "joint_torque_2")
_JOINTS = ("q_1", "q_2")

OBJECTIVES: dict[str, Objective] = {
    objective.name: objective
    for objective in (
        *(
            Objective(
                f"peak_force_{robot + 1}",
                f"peak normal force of robot {robot + 1} / reference",
                _of_robot(robot, _peak_forces),
                _FORCE,
            )
            for robot in (0, 1)
        ),
        Objective(
            "peak_force", "larger peak normal force / reference", _larger(_peak_forces), _FORCE
        ),
        Objective("mean_force", "mean normal force / reference", _mean_force, ("time", *_FORCE)),
        Objective("duration", "duration / twice the initial polygon's time", _duration, ("time",)),
        Objective("peak_torque_use", "peak joint torque / maximum", _peak_torque_use, _TORQUES),
        Objective("joint_length", "joints' way / that of their ranges", _joint_length, _JOINTS),
        Objective("force_imbalance", "peak |N1 - N2| / reference", _force_imbalance, _FORCE),
        Objective(
            "robust_force",
            "peak force that holds in all cases / reference",
            _larger(_robust_forces),
        ),
        *(
            Objective(
                f"robust_force_{robot + 1}",
                f"peak force of robot {robot + 1} that holds in all cases / reference",
                _of_robot(robot, _robust_forces),
            )
            for robot in (0, 1)
        ),
        Objective(
            "friction_use",
            "peak friction use at the reference squeeze",
            _friction_use,
            ("normal_force", "tangential_force"),
        ),
    )
}
"""All objectives by name."""


def objectives() -> dict[str, str]:
    """Return the titles of all objectives that a `Cell` may minimise, by name."""
    return {name: objective.title for name, objective in OBJECTIVES.items()}


_ROBUST = tuple(OBJECTIVES[name].evaluate for name in ("robust_force", *ROBUST_OBJECTIVES))


def force_kind(objectives: Sequence[str | Objective]) -> ForceKind:
    """Return the kind of force that drivable cells limit: cells whose carries are timed from rest
    to rest within all limits.

    It is the robust force, which holds the box in every case of the uncertainty, if an objective
    minimises a robust force. Otherwise it is the planned force, which holds the box if everything
    is exactly as described.

    Raises:
        SettingsError: an objective is unknown or given twice, or none is given.
    """
    chosen = select_objectives(objectives)
    robust = any(objective.evaluate in _ROBUST for objective in chosen)
    return ROBUST_FORCE if robust else PLANNED_FORCE


def select_objectives(wanted: Sequence[str | Objective]) -> tuple[Objective, ...]:
    """Return objectives as records, in the given order.

    Args:
        wanted: names of objectives in `OBJECTIVES`, or records.

    Raises:
        SettingsError: a name is unknown or given twice, or none is given.
    """
    unknown = [name for name in wanted if isinstance(name, str) and name not in OBJECTIVES]
    if unknown:
        raise SettingsError(
            f"unknown objective {', '.join(map(shown, unknown))}; known are "
            f"{', '.join(OBJECTIVES)}",
            code="unknown-objective",
        )
    found = tuple(OBJECTIVES[entry] if isinstance(entry, str) else entry for entry in wanted)
    names = [objective.name for objective in found]
    if not names or len(set(names)) != len(names):
        raise SettingsError(
            f"objectives {', '.join(names)}: name at least one, each once", code="repeated"
        )
    return found


# --- fronts ---


def non_dominated(objectives: ArrayLike, feasible: ArrayLike | None = None) -> NDArray[np.bool_]:
    """Return a mask (n,) of the feasible points that no other feasible point dominates.

    Of equal points only the first is marked. A point with a NaN or infinite objective is never
    marked.

    Args:
        objectives: (n, n_obj) points.
        feasible: (n,) True for feasible points; None if all are feasible.
    """
    # Not imported at the top: moocore takes long to start.
    import moocore

    values = np.asarray(objectives, dtype=np.float64)
    candidates = np.isfinite(values).all(axis=1)
    if feasible is not None:
        candidates &= np.asarray(feasible, dtype=bool)
    mask = np.zeros(len(values), dtype=bool)
    index = np.flatnonzero(candidates)
    if len(index) > 0:
        mask[index[moocore.is_nondominated(values[index])]] = True
    return mask


def front_rows(objectives: ArrayLike, feasible: ArrayLike | None = None) -> NDArray[np.intp]:
    """Return the row indices (k,) of the non-dominated feasible points, sorted by first objective,
    then by the next ones.

    Args:
        objectives: (n, n_obj) points.
        feasible: (n,) True for feasible points; None if all are feasible.
    """
    values = np.asarray(objectives, dtype=np.float64)
    rows = np.flatnonzero(non_dominated(values, feasible))
    return rows[np.lexsort(values[rows].T[::-1])]


def front_of(objectives: ArrayLike, feasible: ArrayLike | None = None) -> Array:
    """Return the objectives (k, n_obj) of the non-dominated feasible points, by increasing first
    objective.

    Args:
        objectives: (n, n_obj) points.
        feasible: (n,) True for feasible points; None if all are feasible.
    """
    values = np.asarray(objectives, dtype=np.float64)
    return np.asarray(values[front_rows(values, feasible)])
