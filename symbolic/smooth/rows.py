"""Constraints of the smooth problem at single places of the path: clearances and joint margins.

The joints follow from the box pose: `solve_function` runs Newton's method from given joints, and
every row then depends on the pose alone. Its derivatives are those of the implicit function. With
the closure F(pose, q) = 0 and a row c(pose, q),

    dq/dpose = -F_q^-1 F_pose,     nu = -F_q^-T c_q,     T = [I; dq/dpose],
    grad = T^T c_y,                Hessian = T^T (c_yy + sum_k nu_k F_k,yy) T,     y = (pose, q),

which holds at a solution of F only: no derivative is taken through the Newton steps.

Where the payload passes the edge of an obstacle, another direction separates the two after it than
before, and the clearance has a kink between. Rows that hold the larger of both gaps would tie each
place of the path to its side of the edge. So the height of the kink is a row of its own: with the
gaps g, before and after, and their rates g' along the path, both taken at a place near the kink,

    height = (g_after' g_before - g_before' g_after) / (g_after' - g_before'),

where the two straight lines meet, wherever along the path that is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import casadi as ca

from symbolic.cell_model import CellModel
from symbolic.geometry.scene import Scene
from symbolic.geometry.softness import Softness
from symbolic.physics.rotation import rotation_matrix
from symbolic.robot.arm import flange_target, manipulability, newton_step, pose_error

SOLVE_STEPS = 5
"""Newton steps from the reference joints, which the solver renews in every round."""

WIDTH = 2e-4
"""Width of the smoothed kinks of clearances [m]; what the smooth bounds fall short is made up for
by measured distances (`hybrid_opt.polishing.active`)."""


@dataclass(frozen=True, order=True)
class RowKind:
    """One kind of row, satisfied where its value is at least the required one.

    clearance: smooth lower bound of the distance of the active pair `index` [m].
    separation: its gap along the single `direction` of `Scene.separations` [m].
    passing: height of the kink from that direction to the direction `after` [m].
    lower, upper: distance of joint `index` of robot `arm` to its limit [rad].
    singularity: |det J| of robot `arm` over its least value, squared, minus 1: at the edge of the
    reach the determinant falls like a root of the distance, its square evenly.
    """

    kind: Literal["clearance", "separation", "passing", "lower", "upper", "singularity"]
    index: int = -1
    arm: int = -1
    direction: int = -1
    after: int = -1


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

    Each takes pose, rate, q_1, q_2 (6,) [m, rad], where the joints hold the box at the pose and
    the rate is the pose's change from place to place. Derivatives are with respect to the pose,
    and of rows that are `moving` with respect to pose and rate (12,).
    """

    def __init__(self, model: CellModel, compiled: Mapping[str, ca.Function] | None = None) -> None:
        """compiled: functions of `frequent` that were compiled, by name."""
        self._model = model
        self._compiled = compiled or {}
        self._pose, self._rate = ca.SX.sym("pose", 6), ca.SX.sym("rate", 6)
        self._q = (ca.SX.sym("q_1", 6), ca.SX.sym("q_2", 6))
        self.value = lru_cache(maxsize=None)(self._value)
        self.gradient = lru_cache(maxsize=None)(self._gradient)
        self.hessian = lru_cache(maxsize=None)(self._hessian)
        self.separations = lru_cache(maxsize=None)(self._separations)

    def frequent(self) -> dict[str, ca.Function]:
        """The functions of the rows that most solves need and that are large, by name, to be
        compiled: the singularity of both arms."""
        kinds = [RowKind("singularity", -1, arm) for arm in (0, 1)]
        makers = (self.value, self.gradient, self.hessian)
        functions = [make(kind) for kind in kinds for make in makers]
        return {function.name(): function for function in functions}

    def separable(self) -> tuple[int, ...]:
        """The active pairs that have rows of kind separation and passing."""
        active = self._model.geometry.active
        return tuple(k for k, p in enumerate(active) if self._scene.separable(p.first, p.second))

    def _separations(self, index: int) -> ca.Function:
        """pose (6,) -> gaps (n,) of a separable pair along every single direction [m]."""
        gaps = ca.vertcat(*self._gaps(index))
        return ca.Function("separations", [self._pose], [gaps], {"cse": True})

    def arms(self, kind: RowKind) -> tuple[int, ...]:
        """The arms whose joints a row depends on."""
        if kind.kind in ("separation", "passing"):
            return ()
        if kind.kind != "clearance":
            return (kind.arm,)
        geometry = self._model.geometry
        pair = geometry.active[kind.index]
        frames = [geometry.bodies[body].frame for body in (pair.first, pair.second)]
        return tuple(sorted({frame.robot for frame in frames if frame.kind == "link"}))

    def moving(self, kind: RowKind) -> bool:
        """Whether a row depends on the rate."""
        return kind.kind == "passing"

    def _value(self, kind: RowKind) -> ca.Function:
        """pose, rate, q_1, q_2 -> value."""
        return self._function("value", kind, lambda: ([], self._expression(kind)))

    def _gradient(self, kind: RowKind) -> ca.Function:
        """pose, rate, q_1, q_2 -> gradient (6,), or (12,) of a moving row."""
        return self._function("gradient", kind, lambda: ([], self._pose_gradient(kind)))

    def _hessian(self, kind: RowKind) -> ca.Function:
        """pose, rate, q_1, q_2, weight -> weight times the Hessian (6, 6), or (12, 12)."""
        return self._function("hessian", kind, lambda: self._pose_hessian(kind))

    def _pose_gradient(self, kind: RowKind) -> ca.SX:
        row = self._expression(kind)
        gradient = ca.gradient(row, self._place(kind))
        for arm in self.arms(kind):
            gradient += ca.mtimes(self._follow(arm).T, ca.gradient(row, self._q[arm]))
        return gradient

    def _pose_hessian(self, kind: RowKind) -> tuple[list[ca.SX], ca.SX]:
        row, weight = self._expression(kind), ca.SX.sym("weight")
        arms = self.arms(kind)
        if not arms:
            return [weight], weight * ca.hessian(row, self._place(kind))[0]
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
        full = ca.substitute([ca.hessian(lagrangian, unknowns)[0]], symbols, multipliers)[0]
        T = ca.vertcat(*follow)
        return [weight], weight * ca.mtimes([T.T, full, T])

    def _function(
        self, what: str, kind: RowKind, make: Callable[[], tuple[list[ca.SX], ca.SX]]
    ) -> ca.Function:
        """The compiled function, or one of pose, joints and further inputs that `make` gives."""
        label = f"{what}_{kind.kind}_{kind.index + 1}_{kind.arm + 1}"
        if kind.direction >= 0:
            label += f"_{kind.direction}_{kind.after + 1}"
        if label in self._compiled:
            return self._compiled[label]
        further, result = make()
        inputs = [self._pose, self._rate, *self._q, *further]
        return ca.Function(label, inputs, ca.cse([ca.densify(result)]))

    def _place(self, kind: RowKind) -> ca.SX:
        return ca.vertcat(self._pose, self._rate) if self.moving(kind) else self._pose

    def _gaps(self, index: int) -> list[ca.SX]:
        pair = self._model.geometry.active[index]
        return self._scene.separations(pair.first, pair.second)

    def _expression(self, kind: RowKind) -> ca.SX:
        if kind.kind == "clearance":
            pair = self._model.geometry.active[kind.index]
            return self._scene.bound(pair.first, pair.second)
        if kind.kind == "separation":
            return self._gaps(kind.index)[kind.direction]
        if kind.kind == "passing":
            gaps = self._gaps(kind.index)
            before, after = gaps[kind.direction], gaps[kind.after]
            falls, rises = (ca.jtimes(gap, self._pose, self._rate) for gap in (before, after))
            return (rises * before - falls * after) / (rises - falls)
        robot, q = self._model.workcell.robots[kind.arm], self._q[kind.arm]
        if kind.kind == "lower":
            return q[kind.index] - float(robot.position_lower[kind.index])
        if kind.kind == "upper":
            return float(robot.position_upper[kind.index]) - q[kind.index]
        measure = manipulability(self._model.robots[kind.arm].jacobian(q))
        return (measure / robot.min_manipulability) ** 2 - 1.0

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
    def _scene(self) -> Scene:
        first, second = (self._model.robots[i].joint_placements(self._q[i]) for i in (0, 1))
        return Scene(
            self._model.geometry,
            rotation_matrix(self._pose[3:]),
            self._pose[:3],
            (first, second),
            Softness(WIDTH),
        )
