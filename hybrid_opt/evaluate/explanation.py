"""Reasons why a candidate is infeasible, in words that name what to change."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from hybrid_opt.evaluate.evaluation import COLLISION, REASONS, CandidateEvaluator, Evaluations
from hybrid_opt.evaluate.kernel import reached_samples
from symbolic.array import Array
from symbolic.read.arms import arm_model, link_frame, turning_joints
from symbolic.records import Contact, Robot
from symbolic.records.poses import box_placement, inverse

DAMPED_STEPS = 60
"""Number of damped steps that bring an arm as near to a pose as it can get."""

RADIAN_LENGTH = 0.1
"""Length that an orientation error of one radian counts as beside a distance [m]."""

DAMPING = 1e-4
"""Damping of these steps, squared [m^2]."""


@dataclass(frozen=True)
class Explanation:
    """The first failure of one infeasible candidate.

    Attributes:
        reason: one of `hybrid_opt.evaluate.evaluation.REASONS`.
        position: path parameter of the failure, 0 to 1.
        sample: index of the nearest sample, from 0.
        pair: names of the two bodies that collide; None for another reason.
        joint: name 'robot/joint' of the joint that is beyond its limit; None for another reason.
        excess: distance of this joint beyond its limit [rad, or m for a sliding joint].
        unit: unit of the excess.
        robot: name of the arm that does not reach its contact; None for another reason.
        missing: distance of this arm's flange from the position that it has to reach [m].
    """

    reason: str
    position: float
    sample: int
    pair: tuple[str, str] | None = None
    joint: str | None = None
    excess: float = 0.0
    unit: str = "rad"
    robot: str | None = None
    missing: float = 0.0

    def __str__(self) -> str:
        where = f"at {100.0 * self.position:.0f} % of the path (sample {self.sample})"
        if self.pair is not None:
            return f"{self.pair[0]} meets {self.pair[1]} {where}"
        if self.joint is not None:
            return f"{self.joint} is {self.excess:.3f} {self.unit} beyond its limit {where}"
        if self.robot is not None:
            return f"{self.robot} lacks {self.missing:.3f} m to its contact {where}"
        return f"{self.reason.replace('_', ' ')} {where}"


def explain(evaluator: CandidateEvaluator, evaluations: Evaluations) -> tuple[Explanation, ...]:
    """Explain why each infeasible candidate fails.

    Args:
        evaluator: the evaluator of the candidates.
        evaluations: evaluations by this evaluator.

    Returns:
        One explanation per infeasible candidate, in the order of the candidates.
    """
    rows = np.flatnonzero(~evaluations.feasible)
    found = []
    for row in rows.tolist():
        outputs = evaluator.outputs(evaluations.x[row][None])
        reason, position = REASONS[int(evaluations.reason[row])], float(evaluations.position[row])
        found.append(_explained(evaluator, outputs, reason, position))
    return tuple(found)


def frequent(explanations: Iterable[Explanation]) -> dict[str, dict[str, int]]:
    """Count failures of candidates by their causes.

    Args:
        explanations: reasons why candidates fail.

    Returns:
        Three tables with the number of failures by name, the largest first: 'pairs' by colliding
        pair of bodies, 'joints' by joint beyond its limit, 'reach' by robot that does not reach.
    """
    counts: dict[str, Counter[str]] = {"pairs": Counter(), "joints": Counter(), "reach": Counter()}
    for one in explanations:
        if one.pair is not None:
            counts["pairs"][" – ".join(one.pair)] += 1
        if one.joint is not None:
            counts["joints"][one.joint] += 1
        if one.robot is not None:
            counts["reach"][one.robot] += 1
    return {name: dict(count.most_common()) for name, count in counts.items()}


def _explained(
    evaluator: CandidateEvaluator, outputs: Mapping[str, Array], reason: str, position: float
) -> Explanation:
    workcell = evaluator.workcell
    n = workcell.task.samples
    sample = round(position * (n - 1)) if np.isfinite(position) else 0
    kind, _, arm = reason.rpartition("_")
    if reason == COLLISION:
        touch = evaluator.checker.check(*reached_samples(outputs, 0)).first_touch
        if touch is not None:
            return Explanation(reason, position, sample, pair=(touch.first, touch.second))
    elif kind == "joint_limits":
        robot = workcell.robots[int(arm) - 1]
        q = outputs[f"q_{arm}"][0, sample]
        beyond = np.maximum(robot.position_lower - q, q - robot.position_upper)
        joint = int(np.argmax(beyond))
        model = arm_model(robot)
        name = f"{robot.name}/{list(model.names)[1 + joint]}"
        unit = "rad" if turning_joints(model)[joint] else "m"
        return Explanation(
            reason, position, sample, joint=name, excess=float(beyond[joint]), unit=unit
        )
    elif kind == "reach":
        index = int(arm) - 1
        robot, held = workcell.robots[index], workcell.contacts[index]
        last = outputs[f"q_{arm}"][0, max(sample - 1, 0)]
        T_world_box = box_placement(workcell.task.orientation, outputs["pose"][0, sample])
        missing = missing_reach(robot, held, T_world_box, last)
        return Explanation(reason, position, sample, robot=robot.name, missing=missing)
    return Explanation(reason, position, sample)


def missing_reach(robot: Robot, contact: Contact, T_world_box: Array, q: Array) -> float:
    """Compute how far the flange of an arm stays from the position at which it would hold the box
    [m].

    Damped least squares reduce the errors of position and orientation together, within the joint
    limits. The result is the position error of the best posture found. From another initial posture
    the flange may come nearer.

    Args:
        robot: the arm.
        contact: contact of this arm on the box.
        T_world_box: (4, 4) pose of the box.
        q: (n,) initial posture [rad].
    """
    model = arm_model(robot)
    data, flange = model.createData(), link_frame(model, robot.flange)
    T_box_flange = contact.T_box_pad @ inverse(robot.T_flange_pad)
    target = inverse(robot.T_world_base) @ T_world_box @ T_box_flange
    least, distance = np.inf, np.inf
    for _ in range(DAMPED_STEPS):
        pin.framesForwardKinematics(model, data, q)
        here = data.oMf[flange]
        away = target[:3, 3] - here.translation
        turn = pin.log3(target[:3, :3] @ here.rotation.T)
        error = float(np.hypot(np.linalg.norm(away), RADIAN_LENGTH * np.linalg.norm(turn)))
        if error < least:
            least, distance = error, float(np.linalg.norm(away))
        J = pin.computeFrameJacobian(model, data, q, flange, pin.LOCAL_WORLD_ALIGNED)
        step = J.T @ np.linalg.solve(J @ J.T + DAMPING * np.eye(6), np.concatenate([away, turn]))
        q = np.clip(q + step, robot.position_lower, robot.position_upper)
    return distance
