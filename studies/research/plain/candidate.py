"""A whole candidate and its verdict written plainly: the oracles of `symbolic.functions` and
`hybrid_opt.evaluate`.

Numeric Pinocchio, NumPy and SciPy in Python loops; only tolerances are shared with the symbolic
model. It iterates exactly as the symbolic model does, so both may be compared to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from studies.research.plain.arm import PlainArm
from studies.research.plain.collisions import PlainCollisionChecker, PlainCollisions
from studies.research.plain.motion import redundant_path, sample_load, timed_motion
from symbolic.array import Array
from symbolic.functions import CONSTRAINTS, FRICTION_TOLERANCE
from symbolic.records import Workcell
from symbolic.robot.arm import REACH_TOLERANCE


@dataclass(frozen=True)
class PlainCandidate:
    """Result of the plain reference code for a candidate, without collisions.

    Attributes:
        outputs: every output of the symbolic evaluator by name, one row per sample.
        violated: names of the violated constraints in the order of `CONSTRAINTS`; () for a feasible
            candidate.
        reason: the constraint that is violated first along the path, or ''.
    """

    outputs: dict[str, Array]
    violated: tuple[str, ...]
    reason: str


class PlainEvaluator:
    """Evaluator of candidates of one workcell without collisions; it reads the robots' models once.

    Args:
        workcell: the cell.
        start: joints (n,) of each arm at the first waypoint [rad or m].
    """

    def __init__(self, workcell: Workcell, start: tuple[Array, Array]) -> None:
        self.workcell = workcell
        self.start = start
        self.arms = [
            PlainArm(
                workcell.robots[i],
                workcell.contacts[i],
                tuple(joint for joint, _ in workcell.task.redundant_entries[i]),
                workcell.task.orientation,
            )
            for i in (0, 1)
        ]

    def __call__(self, x: Array) -> PlainCandidate:
        """Compute motion, loads and constraints of a decision vector (n_var,), no collisions."""
        time, pose, rate, second = timed_motion(self.workcell.task, x)
        loads = [
            sample_load(self.workcell, *sample) for sample in zip(pose, rate, second, strict=True)
        ]
        load = {name: np.array([each[name] for each in loads]) for name in loads[0]}
        values = redundant_path(self.workcell.task, x)
        outputs = {"time": time, "pose": pose, "rate": rate, "second_rate": second}
        outputs |= {name: value for name, value in load.items() if not name.startswith("wrench")}
        for i, arm in enumerate(self.arms):
            columns = [entry - 6 for _, entry in self.workcell.task.redundant_entries[i]]
            followed = arm.follow(self.start[i], pose, load[f"wrench_{i + 1}"], values[:, columns])
            outputs |= {f"{name}_{i + 1}": value for name, value in followed.items()}
        constraint = np.array([self._constraints(outputs, k) for k in range(len(time))])
        violated = np.maximum(constraint, 0.0)
        outputs["constraint"] = constraint
        outputs["violation"] = violated.max(axis=0)
        outputs["violation_time"] = np.array(
            [np.trapezoid((column > 0.0).astype(float), time) / time[-1] for column in violated.T]
        )
        here = _violated(constraint)
        names = tuple(name for name in CONSTRAINTS if any(name in each for each in here))
        return PlainCandidate(outputs, names, next((each[0] for each in here if each), ""))

    def _constraints(self, outputs: dict[str, Array], k: int) -> list[float]:
        """Return the values of all `CONSTRAINTS` at sample k, in this order.

        Args:
            outputs: arrays of the motion and the loads by name, one row per sample.
            k: index of the sample.
        """
        workcell, values = self.workcell, {}
        friction = []
        for i, contact in enumerate(workcell.contacts):
            arm = i + 1
            lost = bool(outputs[f"lost_{arm}"][k])
            residual = outputs[f"ik_residual_{arm}"][k]
            least = workcell.robots[i].min_manipulability
            values[f"reach_{arm}"] = (
                max(residual - REACH_TOLERANCE, 1.0) if lost else -REACH_TOLERANCE
            )
            values[f"joint_limits_{arm}"] = 0.0 if lost else -outputs[f"limit_margin_{arm}"][k]
            values[f"singularity_{arm}"] = (
                0.0 if lost else 1.0 - outputs[f"manipulability_{arm}"][k] / least
            )
            values[f"pressure_{arm}"] = outputs["pressure_shift"][k, i] / contact.patch_radius - 1.0
            excess = (
                outputs["tangential_force"][k, i] - contact.friction * outputs["normal_force"][k, i]
            )
            friction.append(excess / (workcell.payload.mass * 9.81) - FRICTION_TOLERANCE)
        values["friction"] = max(friction)
        return [float(values[name]) for name in CONSTRAINTS]


def _violated(constraint: Array) -> list[list[str]]:
    """Return the names of the violated constraints of each of n samples, in order.

    Args:
        constraint: (n, constraints) values of `CONSTRAINTS`; positive values are violations.
    """
    return [
        [name for name, value in zip(CONSTRAINTS, values, strict=True) if value > 0.0]
        for values in constraint
    ]


def evaluate(workcell: Workcell, start: tuple[Array, Array], x: Array) -> PlainCandidate:
    """Evaluate one decision vector by `PlainEvaluator`.

    Args:
        workcell: the cell.
        start: (n,) start posture of each arm [rad or m].
        x: (n_var,) decision vector.
    """
    return PlainEvaluator(workcell, start)(x)


@dataclass(frozen=True)
class PlainVerdict:
    """Result of the plain reference code for a candidate, collisions included.

    Attributes:
        candidate: result without collisions.
        collisions: collisions at the samples that both arms reach.
        objectives: (2,) peak normal forces over the reference forces.
        feasible: True if no constraint is violated and no bodies collide.
        reason: first violation along the path: one of `CONSTRAINTS` or "collision", '' if feasible.
        position: path parameter of the first violation, NaN if feasible.
        violation_time: time in violation over the duration, by the name of the violation.
    """

    candidate: PlainCandidate
    collisions: PlainCollisions
    objectives: Array
    feasible: bool
    reason: str
    position: float
    violation_time: dict[str, float]


class PlainJudge:
    """Evaluator of candidates with collisions; it reads robots and shapes once.

    Args:
        workcell: the cell.
        start: joints (n,) of each arm at the first waypoint [rad].
    """

    def __init__(self, workcell: Workcell, start: tuple[Array, Array]) -> None:
        self.workcell = workcell
        self.evaluator = PlainEvaluator(workcell, start)
        self.checker = PlainCollisionChecker(workcell)

    def __call__(self, x: Array) -> PlainVerdict:
        """Decide whether a decision vector (n_var,) is feasible, collisions included, and compute
        its objectives.
        """
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
        for k, here in enumerate(_violated(outputs["constraint"])):
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
