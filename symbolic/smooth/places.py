"""Rows at places of the path: their constraints, and joints that follow the box.

A row is a value that has to exceed a required value. The value depends on the box pose at the place
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
    """Symbols of one place of the path, and expressions of them that are built once.

    Attributes:
        model: arms and bodies of the cell.
        pose: (6,) pose of the box [m, rad].
        rate: (6,) derivative of the pose by the path parameter.
        q: (n,) joint positions of each arm [rad].
    """

    def __init__(self, model: CellBodies) -> None:
        self.model = model
        self.pose, self.rate = ca.SX.sym("pose", 6), ca.SX.sym("rate", 6)
        first, second = (arm.joints for arm in model.geometry.arms)
        self.q = ca.SX.sym("q_1", first), ca.SX.sym("q_2", second)

    @cached_property
    def rotation(self) -> ca.SX:
        """The rotation (3, 3) of the box in the world."""
        return rotation_matrix(self.model.workcell.task.orientation, self.pose[3:])

    @cached_property
    def scene(self) -> DistanceBounds:
        """Distance bounds of all bodies, with rounded kinks."""
        return self._scene(Softness(KINK_WIDTH, PARALLEL_WIDTH))

    @cached_property
    def sharp_scene(self) -> DistanceBounds:
        """Distance bounds of all bodies, exact."""
        return self._scene(EXACT)

    def _scene(self, softness: Softness) -> DistanceBounds:
        placed = [self.model.robots[arm].joint_placements(self.q[arm]) for arm in (0, 1)]
        at = self.rotation, self.pose[:3], (placed[0], placed[1])
        return DistanceBounds(self.model.screen, *at, softness)

    def obstacle(self, pair: int) -> Array:
        """Return the parameters (BOX_NUMBERS,) of the box of a separable pair."""
        geometry = self.model.geometry
        return box_numbers(geometry.bodies[geometry.active[pair].second])

    def separable(self) -> tuple[int, ...]:
        """Return the active pairs of the payload and an obstacle that is a single box."""
        columns = enumerate(self.model.geometry.columns.tolist())
        return tuple(pair for pair, column in columns if self.scene.separable(column))


@dataclass(frozen=True)
class PathConstraint(ABC):
    """One constraint at a place of the path.

    Constraints of one family share their compiled functions and differ only by the parameters of
    these functions.

    Attributes:
        scale: divisor of the value, chosen so that 1 is significant [m, rad, 1]. In metres a solver
            would neglect a centimetre.
        moving: whether the value depends on the rate of the pose.
    """

    scale: ClassVar[float]
    moving: ClassVar[bool] = False

    @property
    @abstractmethod
    def family(self) -> str:
        """Name shared by the constraints that use the same functions."""

    @abstractmethod
    def expression(self, place: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Build the expression of the constrained value [m, rad or 1], a scalar.

        Args:
            place: symbols of the box pose and the joints at one place of the path.
            numbers: (count,) symbolic parameters, which distinguish the members of the family.
        """

    def count(self, place: PathPointSymbols) -> int:
        """Return the number of parameters of a member of the family."""
        return 0

    def numbers(self, place: PathPointSymbols) -> Array:
        """Return the parameters (count,) of this member."""
        return np.zeros(0)

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """Return the arms on whose joints the value depends."""
        return ()

    def given(self, model: CellBodies) -> dict[str, ca.SX]:
        """Return the cell's parameters on which the value depends, by group; by default those of
        its bodies."""
        return sx_parameters(model.screen)


@dataclass(frozen=True, order=True)
class Clearance(PathConstraint):
    """Smooth lower bound of the distance of an active pair [m].

    Attributes:
        pair: index among the active pairs.
        column: index among the possible pairs, which does not change with the cell's parameters.
    """

    pair: int
    column: int

    scale: ClassVar[float] = 0.01

    @property
    def family(self) -> str:
        """Name of the family, which has this pair as its only member."""
        return f"clearance_{self.column}"

    def expression(self, place: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Return the lower bound of the distance [m], with rounded kinks."""
        return place.scene.bound(self.column)

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """Return the arms with links in the pair."""
        geometry = model.geometry
        bodies = geometry.possible[self.column]
        frames = [geometry.bodies[body].frame for body in (bodies.first, bodies.second)]
        return tuple(sorted({frame.robot for frame in frames if frame.kind == "link"}))


@dataclass(frozen=True, order=True)
class JointLimit(PathConstraint):
    """Distance of a joint to its lower or upper limit [rad]."""

    arm: int
    joint: int
    side: Side

    scale: ClassVar[float] = 0.1

    @property
    def family(self) -> str:
        """Name of the family of all joint limits of one arm."""
        return f"joint_limit_{self.arm + 1}"

    def expression(self, place: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Return the margin [rad], negative beyond the limit."""
        return numbers[0] + ca.dot(numbers[1:], place.q[self.arm])

    def count(self, place: PathPointSymbols) -> int:
        """Return the number of parameters: a margin, and one slope per joint."""
        return 1 + int(place.q[self.arm].numel())

    def numbers(self, place: PathPointSymbols) -> Array:
        """Return the margin at zero joints, then its gradient by the joints."""
        robot = place.model.workcell.robots[self.arm]
        slope = np.zeros(robot.position_lower.shape[0])
        slope[self.joint] = 1.0 if self.side == "lower" else -1.0
        limit = robot.position_lower if self.side == "lower" else robot.position_upper
        return np.concatenate([[-slope[self.joint] * limit[self.joint]], slope])

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """Return the index of the joint's arm, as a tuple of one entry."""
        return (self.arm,)

    def given(self, model: CellBodies) -> dict[str, ca.SX]:
        """Return an empty dictionary: the limit is a parameter of the row itself."""
        return {}


@dataclass(frozen=True, order=True)
class ManipulabilityLimit(PathConstraint):
    """Value (|det J| / least)^2 - 1 of an arm, with the least allowed |det J|.

    At the edge of the reach the determinant falls like a root of the distance; its square falls
    linearly.
    """

    arm: int

    scale: ClassVar[float] = 1.0

    @property
    def family(self) -> str:
        """Name of the family, which has this arm as its only member."""
        return f"reach_{self.arm + 1}"

    def expression(self, place: PathPointSymbols, numbers: ca.SX) -> ca.SX:
        """Return the value, which is zero at the least manipulability of the workcell."""
        least = place.model.workcell.robots[self.arm].min_manipulability
        model = place.model.robots[self.arm]
        jacobian = following_columns(model, model.jacobian(place.q[self.arm]))
        return (manipulability(jacobian) / least) ** 2 - 1.0

    def arms(self, model: CellBodies) -> tuple[int, ...]:
        """Return the index of the arm, as a tuple of one entry."""
        return (self.arm,)

    def given(self, model: CellBodies) -> dict[str, ca.SX]:
        """Return the symbols of the arm."""
        return sx_parameters(model.workcell.robots[self.arm])


def row_name(family: str, order: Order) -> str:
    """Return the name of the function that `row_function` builds for a family."""
    return f"row_{family}_{order}"


def closure_name(arm: int, order: Order) -> str:
    """Return the name of the function that `closure_functions` builds for an arm."""
    return f"closure_{arm + 1}_{order}"


def row_function(place: PathPointSymbols, constraint: PathConstraint, order: Order) -> ca.Function:
    """Build the function of the value and gradient, or of the Hessian, of a family of constraints.

    The variables y are the pose, then the rate if the constraint is `moving`, then the joints of
    its `arms`.

    first: pose, rate, q_1, q_2, numbers -> value, gradient (n_y,).

    second: pose, rate, q_1, q_2, numbers, weight -> weight times the Hessian (n_y, n_y).

    A family with one member has no numbers. The cell's own parameters follow.
    """
    numbers = ca.SX.sym("numbers", constraint.count(place))
    value = constraint.expression(place, numbers)
    arms = constraint.arms(place.model)
    rate = [place.rate] if constraint.moving else []
    y = ca.vertcat(place.pose, *rate, *[place.q[arm] for arm in arms])
    inputs = {"pose": place.pose, "rate": place.rate, "q_1": place.q[0], "q_2": place.q[1]}
    if numbers.numel():
        inputs["numbers"] = numbers
    name, given = row_name(constraint.family, order), constraint.given(place.model)
    if order == "first":
        outputs = {"value": value, "gradient": ca.densify(ca.gradient(value, y))}
        return named_function(name, inputs | given, outputs)
    weight = ca.SX.sym("weight")
    outputs = {"hessian": ca.densify(weight * ca.hessian(value, y)[0])}
    return named_function(name, inputs | {"weight": weight} | given, outputs)


def closure_functions(model: CellModel, arm: int) -> dict[str, ca.Function]:
    """Build the functions with which an arm's joints follow the box pose, by name. The symbols are
    those of the module's formulas.

    first: pose (6 + m,) and q_reference (n,) -> q (n,), the joints that hold the box; follow (n, 6
    + m), the derivative dq/dpose; pull (n, n), the matrix -F_q^-1, so that nu = pull^T c_q.

    second: pose, q and nu (n,) -> hessian (6 + m + n, 6 + m + n) of nu . F by (pose, q).
    """
    own = model.robots[arm]
    n = own.n_joints
    pose, nu = ca.SX.sym("pose", own.pose_size), ca.SX.sym("nu", n)
    reference = ca.SX.sym("q_reference", n)
    cell, rotation = model.workcell, rotation_matrix(own.orientation, pose[3:6])
    target = flange_target(cell.robots[arm], cell.contacts[arm], pose[:3], rotation)

    joints = ca.SX.sym("q", n)
    held = pose_error(*target, *own.placement(joints))[0]
    tied = [pose[place] - joints[joint] for joint, place in own.redundant]
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
