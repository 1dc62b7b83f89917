"""The full verdict on a candidate, written plainly: the oracle of `hybrid_opt.evaluate`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from studies.research.plain.candidate import PlainCandidate, PlainEvaluator
from studies.research.plain.collisions import PlainCollisionChecker, PlainCollisions
from symbolic.array import Array
from symbolic.functions import CONSTRAINTS
from symbolic.records import Workcell


@dataclass(frozen=True)
class PlainVerdict:
    """Verdict of the plain reference on a candidate with collisions.

    Attributes:
        candidate: everything but the collisions.
        collisions: on the samples that both arms reach.
        objectives: (2,) the paper's peak normal forces over the reference forces.
        feasible: whether no constraint is violated and nothing collides.
        reason: what is violated first along the path: one of `CONSTRAINTS`, "collision", or an
            empty string.
        position: path parameter of the first violation; NaN where feasible.
        violation_time: time in violation over the duration, per name of those reasons.
    """

    candidate: PlainCandidate
    collisions: PlainCollisions
    objectives: Array
    feasible: bool
    reason: str
    position: float
    violation_time: dict[str, float]


class PlainJudge:
    """The plain reference with collisions; reads robots and shapes once.

    Args:
        workcell: the cell.
        start: joints (n,) of each arm at the first waypoint [rad].
    """

    def __init__(self, workcell: Workcell, start: tuple[Array, Array]) -> None:
        self.workcell = workcell
        self.evaluator = PlainEvaluator(workcell, start)
        self.checker = PlainCollisionChecker(workcell)

    def __call__(self, x: Array) -> PlainVerdict:
        """Evaluate a decision vector (n_var,)."""
        candidate = self.evaluator(x)
        outputs = candidate.outputs
        time, n = outputs["time"], len(outputs["time"])
        reached = n
        for k in reversed(range(n)):
            if outputs["lost_1"][k] or outputs["lost_2"][k]:
                reached = k
        collisions = self.checker.check(
            *(outputs[name][:reached] for name in ("time", "pose", "q_1", "q_2"))
        )
        reason, position = "", float("nan")
        for k in range(n):
            here = [
                name
                for name, value in zip(CONSTRAINTS, outputs["constraint"][k], strict=True)
                if value > 0.0
            ]
            if k < reached and collisions.colliding[k]:
                here.append("collision")
            if here:
                reason, position = here[0], k / (n - 1)
                break
        shares = dict(zip(CONSTRAINTS, outputs["violation_time"].tolist(), strict=True))
        # Both steps beside the last sample before an arm is lost count.
        hit = np.zeros(n)
        hit[:reached] = collisions.colliding
        shares["collision"] = float(np.trapezoid(hit, time) / time[-1])
        peaks = outputs["normal_force"].max(axis=0)
        return PlainVerdict(
            candidate=candidate,
            collisions=collisions,
            objectives=np.asarray(peaks / self.workcell.task.reference_force),
            feasible=not reason,
            reason=reason,
            position=position,
            violation_time=shares,
        )
