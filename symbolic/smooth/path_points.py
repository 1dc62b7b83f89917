"""Rows at points of the path: their constraints, and joints that follow the box.

A row is a value that has to exceed a required value. The value depends on the box pose at the point
and on the joints that hold the box; where the separating direction changes
(`symbolic.smooth.passage`) also on the rate of the pose along the path. With the closure F(pose, q)
= 0, the joints follow the pose by the implicit function theorem, and a row c(pose, q) has the
derivatives

    dq/dpose = -F_q^-1 F_pose,     nu = -F_q^-T c_q,     T = [I; dq/dpose],
    grad = T^T c_y,                Hessian = T^T (c_yy + sum_k nu_k F_k,yy) T,     y = (pose, q),

where pose is the extended pose and F has as many equations as there are joints: six hold the box,
and one more sets each redundant joint. The derivatives are valid at a solution of F only. None
passes through Newton's steps, so the joints have to be accurate, not differentiable.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.cell_model import CellBodies, CellModel
from symbolic.expression import named_function, sx_parameters
from symbolic.geometry.clearance import DistanceBounds, box_numbers
from symbolic.geometry.expressions import EXACT, Softness
from symbolic.path.rotation import rotation_matrix
from symbolic.robot.arm import (
    flange_target,
    following_columns,
    manipulability,
    newton_step,
    pose_error,
)

Order = Literal["first", "second"]
"""'first': values with their first derivatives. 'second': weighted second derivatives."""

ORDERS: tuple[Order, ...] = ("first", "second")

Side = Literal["lower", "upper"]

SOLVE_STEPS = 5
"""Number of Newton steps from the reference joints, which the solver renews in every iteration."""

KINK_WIDTH = 2e-4
"""Width of the smoothed kinks of clearances [m]; measured distances correct the smooth bounds
(`hybrid_opt.polishing.constraints`)."""

PARALLEL_WIDTH = 3e-3
"""Width of the smoothed kinks where a face of a box becomes parallel to another face [1]. The best
carries lie in these kinks, and a solver makes little progress along sharp ones."""


class PathPointSymbols:
    """Symbols of pose and joints at one point of the path, and expressions that are built from them
    once.

    Attributes:
        model: arms and bodies of the cell.
        pose: (6,) pose of the box [m, rad].
        rate: (6,) derivative of the pose by the path parameter u.
        q: for each arm the joint positions (n,) [rad, or m for a sliding joint].
    """

    def __init__(self, model: CellBodies) -> None:
        self.model = model
        self.pose, self.rate = ca.SX.sym("pose", 6), ca.SX.sym("rate", 6)
        first, second = (arm.joints for arm in model.geometry.arms)
        self.q = ca.SX.sym("q_1", first), ca.SX.sym("q_2", second)

    @cached_property
    def rotation(self) -> ca.SX:
        """Rotation R_world_box (3, 3) of the box."""
        return rotation_matrix(self.model.workcell.task.orientation, self.pose[3:])

    @cached_property
    def scene(self) -> DistanceBounds:
        """Lower bounds of the distances of all pairs of bodies, smoothed at their kinks."""
        return self._scene(Softness(KINK_WIDTH, PARALLEL_WIDTH))

    @cached_property
    def sharp_scene(self) -> DistanceBounds:
        """Lower bounds of the distances of all pairs of bodies, without smoothing."""
        return self._scene(EXACT)

    def _scene(self, softness: Softness) -> DistanceBounds:
        placed = [self.model.robots[arm].joint_placements(self.q[arm]) for arm in (0, 1)]
        at = self.rotation, self.pose[:3], (placed[0], placed[1])
        return DistanceBounds(self.model.screen, *at, softness)

    def obstacle(self, pair: int) -> Array:
        """Return the numbers (BOX_NUMBERS,) that describe the box-shaped obstacle of a pair, as
        from `box_numbers`.

        Args:
            pair: index of the pair among the active pairs, one of `separable`.
        """
        geometry = self.model.geometry
        return box_numbers(geometry.bodies[geometry.active[pair].second])

    def separable(self) -> tuple[int, ...]:
        """Return the indices of the active pairs of the payload and a box-shaped obstacle. For
        these pairs clearance can be constrained along separating directions."""
        columns = enumerate(self.model.geometry.columns.tolist())
        return tuple(pair for pair, column in columns if self.scene.separable(column))


@dataclass(frozen=True)
class PathConstraint(ABC):
    """Constraint at one point of the path: a value that must exceed a required value.

    Constraints of one family share their compiled functions and differ only by the parameters of
    these functions.

    Attributes:
        scale: divisor of the value [m, rad or 1], so that a change by 1 is significant. In metres a
            solver would neglect a centimetre.
        moving: True if the value depends on the rate of the pose.
    """

    scale: ClassVar[float]
    moving: ClassVar[bool] = False

    @property
    @abstractmethod
    def family(self) -> str:
        """Name shared by all constraints that use the same compiled functions, such as all joint
        limits of one arm.
        """

    @abstractmethod
    def expression(self, point: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Build the expression of the constrained value [m, rad or 1], a scalar.

        Args:
            point: symbols of the box pose and the joints at one point of the path.
            numbers: (count,) symbols of the parameters that distinguish the constraints of the
                family.
        """

    def count(self, point: PathPointSymbols) -> int:
        """Return the number of parameters of each constraint of the family."""
        return 0

    def numbers(self, point: PathPointSymbols) -> Array:
        """Return the values (count,) of the parameters that distinguish this constraint in its
        family."""
        return np.zeros(0)

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """Return the indices of the arms on whose joints the constrained value depends."""
        return ()

    def given(self, model: CellBodies) -> dict[str, ca.SX]:
        """Return the cell's symbolic parameters on which the constrained value depends, by name of
        their group. By default these are the parameters of the bodies."""
        return sx_parameters(model.screen)


@dataclass(frozen=True, order=True)
class Clearance(PathConstraint):
    """Constraint on the clearance of two bodies: a smooth lower bound of their distance [m].

    Attributes:
        pair: index of the two bodies among the active pairs.
        column: index of the two bodies among the possible pairs; it does not change with the cell's
            parameters.
    """

    pair: int
    column: int

    scale: ClassVar[float] = 0.01

    @property
    def family(self) -> str:
        """Name of the constraint's family, which contains only this pair of bodies."""
        return f"clearance_{self.column}"

    def expression(self, point: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Build the expression of the lower bound of the distance of the two bodies [m].

        Args:
            point: symbols of the box pose and the joints at one point of the path.
            numbers: empty.
        """
        return point.scene.bound(self.column)

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """Return the indices of the arms that have a link in the pair."""
        geometry = model.geometry
        bodies = geometry.possible[self.column]
        frames = [geometry.bodies[body].frame for body in (bodies.first, bodies.second)]
        return tuple(sorted({frame.robot for frame in frames if frame.kind == "link"}))


@dataclass(frozen=True, order=True)
class JointLimit(PathConstraint):
    """Constraint on the distance of a joint to its lower or upper limit [rad, or m for a sliding
    joint].

    Attributes:
        arm: index of the arm.
        joint: index of the joint among the arm's joints.
        side: 'lower' or 'upper' limit.
    """

    arm: int
    joint: int
    side: Side

    scale: ClassVar[float] = 0.1

    @property
    def family(self) -> str:
        """Name of the constraint's family: all joint limits of one arm."""
        return f"joint_limit_{self.arm + 1}"

    def expression(self, point: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Build the expression of the distance to the limit [rad or m], negative beyond the limit.

        Args:
            point: symbols of the box pose and the joints at one point of the path.
            numbers: (count,) distance at zero joint positions, then its derivatives by the joints.
        """
        return numbers[0] + ca.dot(numbers[1:], point.q[self.arm])

    def count(self, point: PathPointSymbols) -> int:
        """Return the number of parameters: the distance at zero joint positions, and one slope per
        joint."""
        return 1 + int(point.q[self.arm].numel())

    def numbers(self, point: PathPointSymbols) -> Array:
        """Return the constraint's parameters (1 + joints,): the distance to the limit at zero joint
        positions, then its derivatives by the arm's joints."""
        robot = point.model.workcell.robots[self.arm]
        slope = np.zeros(robot.position_lower.shape[0])
        slope[self.joint] = 1.0 if self.side == "lower" else -1.0
        limit = robot.position_lower if self.side == "lower" else robot.position_upper
        return np.concatenate([[-slope[self.joint] * limit[self.joint]], slope])

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """Return the index of the joint's arm, as a tuple of one entry."""
        return (self.arm,)

    def given(self, model: CellBodies) -> dict[str, ca.SX]:
        """Return an empty dictionary, because the constraint depends on no symbolic parameter of
        the cell: the limit is one of its own `numbers`.
        """
        return {}


@dataclass(frozen=True, order=True)
class ManipulabilityLimit(PathConstraint):
    """Constraint on the manipulability of an arm: the value (D / D_min)^2 - 1 with D, the absolute
    determinant of the Jacobian, and its least allowed value D_min.

    At the edge of the reach D falls like a root of the distance; its square falls linearly.

    Attributes:
        arm: index of the arm.
    """

    arm: int

    scale: ClassVar[float] = 1.0

    @property
    def family(self) -> str:
        """Name of the constraint's family, whose only member is the limit of this arm."""
        return f"reach_{self.arm + 1}"

    def expression(self, point: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Build the expression (D / D_min)^2 - 1 of the arm's manipulability D and its least
        allowed value D_min, which the workcell states.

        Args:
            point: symbols of the box pose and the joints at one point of the path.
            numbers: empty.
        """
        least = point.model.workcell.robots[self.arm].min_manipulability
        model = point.model.robots[self.arm]
        jacobian = following_columns(model, model.jacobian(point.q[self.arm]))
        return (manipulability(jacobian) / least) ** 2 - 1.0

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """Return the index of the arm, as a tuple of one entry."""
        return (self.arm,)

    def given(self, model: CellBodies) -> dict[str, ca.SX]:
        """Return the arm's symbolic parameters by name of their group."""
        return sx_parameters(model.workcell.robots[self.arm])


def row_name(family: str, order: Order) -> str:
    """Return the name of the function that `row_function` builds for a family of constraints.

    Args:
        family: name of the family.
        order: 'first' or 'second', the order of the derivatives.
    """
    return f"row_{family}_{order}"


def closure_name(arm: int, order: Order) -> str:
    """Return the name of the function that `closure_functions` builds for an arm.

    Args:
        arm: index of the arm.
        order: 'first' or 'second', the order of the derivatives.
    """
    return f"closure_{arm + 1}_{order}"


def row_function(point: PathPointSymbols, constraint: PathConstraint, order: Order) -> ca.Function:
    """Build the function of a family of constraints and its derivatives at one point of the path.

    The variables y (n_y,) of the derivatives are the pose (6,), then its rate (6,) if the
    constraint is `moving`, then the joints of its `arms`. Inputs: pose, rate, q_1, q_2; numbers,
    the constraint's parameters, if the family has any; weight, a scalar, for the second order; then
    the cell's symbolic parameters.

    Args:
        point: symbols of the box pose and the joints at one point of the path.
        constraint: any constraint of the family.
        order: 'first' for the outputs value (scalar) and gradient (n_y,); 'second' for the output
            hessian (n_y, n_y), multiplied by weight.
    """
    numbers = ca.SX.sym("numbers", constraint.count(point))
    value = constraint.expression(point, numbers)
    arms = constraint.arms(point.model)
    rate = [point.rate] if constraint.moving else []
    y = ca.vertcat(point.pose, *rate, *[point.q[arm] for arm in arms])
    inputs = {"pose": point.pose, "rate": point.rate, "q_1": point.q[0], "q_2": point.q[1]}
    if numbers.numel():
        inputs["numbers"] = numbers
    name, given = row_name(constraint.family, order), constraint.given(point.model)
    if order == "first":
        outputs = {"value": value, "gradient": ca.densify(ca.gradient(value, y))}
        return named_function(name, inputs | given, outputs)
    weight = ca.SX.sym("weight")
    outputs = {"hessian": ca.densify(weight * ca.hessian(value, y)[0])}
    return named_function(name, inputs | {"weight": weight} | given, outputs)


def closure_functions(model: CellModel, arm: int) -> dict[str, ca.Function]:
    """Build the functions with which an arm's joints follow the box pose, by name.

    F(pose, q) = 0 are the n equations that fix the joints q (n,) at an extended pose (6 + m,): the
    box pose, then the cell's m redundant joints. The robot's symbolic parameters are the last
    inputs of both functions.

    - first takes pose, and q_reference (n,), joint positions near the solution. It returns q, the
      joint positions that hold the box; follow (n, 6 + m), the derivative dq/dpose; and pull (n,
      n), the negative inverse of the derivative of F by q. For a function c of the joints, the
      multipliers are nu = transposed pull times the gradient of c by q.
    - second takes pose, q and multipliers nu (n,). It returns hessian (6 + m + n, 6 + m + n), the
      second derivatives of nu . F by pose and q.

    Args:
        model: the cell.
        arm: index of the arm.
    """
    own = model.robots[arm]
    n = own.n_joints
    pose, nu = ca.SX.sym("pose", own.pose_size), ca.SX.sym("nu", n)
    reference = ca.SX.sym("q_reference", n)
    cell, rotation = model.workcell, rotation_matrix(own.orientation, pose[3:6])
    target = flange_target(cell.robots[arm], cell.contacts[arm], pose[:3], rotation)

    joints = ca.SX.sym("q", n)
    held = pose_error(*target, *own.placement(joints))[0]
    tied = [pose[point] - joints[joint] for joint, point in own.redundant]
    closure = ca.vertcat(held, *tied)
    pull = -ca.solve(ca.jacobian(closure, joints), ca.SX.eye(n))
    follow = ca.mtimes(pull, ca.jacobian(closure, pose))
    given = sx_parameters(cell.robots[arm])
    slopes = ca.Function("slopes", [pose, joints, *given.values()], [follow, pull])

    q = own.with_redundant(reference, pose)
    for _ in range(SOLVE_STEPS):
        q = newton_step(own, q, *target)
    first, second = closure_name(arm, "first"), closure_name(arm, "second")
    found = zip(("q", "follow", "pull"), (q, *slopes(pose, q, *given.values())), strict=True)
    outputs = {name: ca.densify(result) for name, result in found}
    curvature, _ = ca.hessian(ca.dot(nu, closure), ca.vertcat(pose, joints))
    bent = {"hessian": ca.densify(curvature)}
    inputs = {"pose": pose, "q_reference": reference} | given
    return {
        first: named_function(first, inputs, outputs),
        second: named_function(second, {"pose": pose, "q": joints, "nu": nu} | given, bent),
    }
