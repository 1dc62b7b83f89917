"""Constraints of the smooth problem at single places of the path: clearances and joint margins.

The joints follow from the box pose: `solve_function` runs Newton's method from given joints, and
every row then depends on the pose alone. Its derivatives are those of the implicit function. With
the closure F(pose, q) = 0 and a row c(pose, q),

    dq/dpose = -F_q^-1 F_pose,     nu = -F_q^-T c_q,     T = [I; dq/dpose],
    grad = T^T c_y,                Hessian = T^T (c_yy + sum_k nu_k F_k,yy) T,     y = (pose, q),

which holds at a solution of F only: no derivative is taken through the Newton steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import casadi as ca

from symbolic.arm import flange_target, manipulability, newton_step, pose_error
from symbolic.cell_model import CellModel
from symbolic.clearance import clearance_expressions
from symbolic.rotation import rotation_matrix
from symbolic.softness import Softness

SOLVE_STEPS = 7
"""Newton steps from the reference joints; the last ones square an error below 1e-4."""

WIDTH = 2e-4
"""Width of the smoothed kinks of clearances [m]."""


@dataclass(frozen=True, order=True)
class RowKind:
    """One kind of row, satisfied where its value is at least the required one.

    clearance: smooth lower bound of the distance of the active pair `index` [m].
    lower, upper: distance of joint `index` of robot `arm` to its limit [rad].
    singularity: |det J| of robot `arm` over its least value, minus 1.
    """

    kind: Literal["clearance", "lower", "upper", "singularity"]
    index: int = -1
    arm: int = -1


def solve_function(model: CellModel, arm: int) -> ca.Function:
    """pose (6,), q_reference (6,) -> q (6,), the joints of an arm that hold the box there."""
    pose, reference = ca.SX.sym("pose", 6), ca.SX.sym("q_reference", 6)
    target = flange_target(
        model.workcell.robots[arm],
        model.workcell.contacts[arm],
        pose[:3],
        rotation_matrix(pose[3:]),
    )
    q = reference
    for _ in range(SOLVE_STEPS):
        q = newton_step(model.robots[arm], q, *target)
    name = f"solve_{arm + 1}"
    return ca.Function(name, [pose, reference], ca.cse([q]), ["pose", "q_reference"], ["q"])


class RowFunctions:
    """The functions of every kind of row, built when first asked for.

    Each takes pose, q_1, q_2 (6,) [m, rad], where the joints hold the box at the pose.
    """

    def __init__(self, model: CellModel, width: float = WIDTH) -> None:
        """width [m]: of the smoothed kinks of clearances."""
        self._model = model
        self._width = width
        self._pose = ca.SX.sym("pose", 6)
        self._q = (ca.SX.sym("q_1", 6), ca.SX.sym("q_2", 6))
        self.value = lru_cache(maxsize=None)(self._value)
        self.gradient = lru_cache(maxsize=None)(self._gradient)
        self.hessian = lru_cache(maxsize=None)(self._hessian)

    def _value(self, kind: RowKind) -> ca.Function:
        """pose, q_1, q_2 -> value."""
        return self._function("value", kind, [], self._expression(kind))

    def _gradient(self, kind: RowKind) -> ca.Function:
        """pose, q_1, q_2 -> gradient (6,) with respect to the pose."""
        row = self._expression(kind)
        gradient = ca.gradient(row, self._pose)
        for arm in self._arms(row):
            gradient += ca.mtimes(self._follow(arm).T, ca.gradient(row, self._q[arm]))
        return self._function("gradient", kind, [], gradient)

    def _hessian(self, kind: RowKind) -> ca.Function:
        """pose, q_1, q_2, weight -> weight times the Hessian (6, 6) with respect to the pose."""
        row, weight = self._expression(kind), ca.SX.sym("weight")
        arms = self._arms(row)
        lagrangian = row
        multipliers, symbols, follow = [], [], [ca.SX.eye(6)]
        for arm in arms:
            symbol = ca.SX.sym("nu", 6)
            closure_by_joints = ca.jacobian(self._closures[arm], self._q[arm])
            multipliers.append(-ca.solve(closure_by_joints.T, ca.gradient(row, self._q[arm])))
            symbols.append(symbol)
            lagrangian += ca.dot(symbol, self._closures[arm])
            follow.append(self._follow(arm))
        unknowns = ca.vertcat(self._pose, *[self._q[arm] for arm in arms])
        full = (
            ca.substitute([ca.hessian(lagrangian, unknowns)[0]], symbols, multipliers)[0]
            if arms
            else ca.hessian(lagrangian, unknowns)[0]
        )
        T = ca.vertcat(*follow)
        return self._function("hessian", kind, [weight], weight * ca.mtimes([T.T, full, T]))

    def _function(
        self, what: str, kind: RowKind, further: Sequence[ca.SX], result: ca.SX
    ) -> ca.Function:
        label = f"{what}_{kind.kind}_{kind.index + 1}_{kind.arm + 1}"
        return ca.Function(label, [self._pose, *self._q, *further], ca.cse([ca.densify(result)]))

    def _expression(self, kind: RowKind) -> ca.SX:
        if kind.kind == "clearance":
            return self._clearances[kind.index]
        robot, q = self._model.workcell.robots[kind.arm], self._q[kind.arm]
        if kind.kind == "lower":
            return q[kind.index] - float(robot.position_lower[kind.index])
        if kind.kind == "upper":
            return float(robot.position_upper[kind.index]) - q[kind.index]
        measure = manipulability(self._model.robots[kind.arm].jacobian(q))
        return measure / robot.min_manipulability - 1.0

    def _arms(self, row: ca.SX) -> list[int]:
        return [arm for arm in (0, 1) if ca.depends_on(row, self._q[arm])]

    def _follow(self, arm: int) -> ca.SX:
        """dq/dpose (6, 6) of an arm."""
        closure = self._closures[arm]
        by_joints = ca.jacobian(closure, self._q[arm])
        return -ca.solve(by_joints, ca.jacobian(closure, self._pose))

    @cached_property
    def _closures(self) -> tuple[ca.SX, ca.SX]:
        """Per arm F (6,), zero where the joints hold the box at the pose."""
        cell, rotation = self._model.workcell, rotation_matrix(self._pose[3:])
        first, second = (
            pose_error(
                *flange_target(cell.robots[arm], cell.contacts[arm], self._pose[:3], rotation),
                *self._model.robots[arm].placement(self._q[arm]),
            )[0]
            for arm in (0, 1)
        )
        return first, second

    @cached_property
    def _clearances(self) -> ca.SX:
        placements = [self._model.robots[arm].joint_placements(self._q[arm]) for arm in (0, 1)]
        return clearance_expressions(
            self._model.geometry,
            rotation_matrix(self._pose[3:]),
            self._pose[:3],
            placements[0],
            placements[1],
            Softness(self._width),
        )
