"""Limited quantities at a point of a driven path, with exact derivatives, for the polish of
drivable carries.

Path and timing are variables together. At a point of the path every limited quantity follows from
the box pose, its first and second derivative along the path, the joints that hold the box at this
pose, u'' and u'^2. Joints are differentiated as in `symbolic.smooth.path_points`.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.cell_model import CellModel
from symbolic.contact.force_closure import LOAD_SIZE
from symbolic.contact.model import ImplicitVariables
from symbolic.contact.registry import contact_model
from symbolic.expression import named_function, number
from symbolic.limit_coefficients import (
    PATH_OUTPUTS,
    contact_limits,
    limit_numbers,
    sample_limits_function,
)
from symbolic.limits import LIMITS, BlockLayout, limit_layout
from symbolic.records import Workcell

DRIVEN_FIRST, DRIVEN_SECOND = "driven_first", "driven_second"
"""Names of the two functions of `driven_functions`."""


@dataclass(frozen=True)
class DrivenLayout(BlockLayout):
    """Layout of the vector of limited quantities at one point of a path that robots drive.

    Attributes:
        pose: number of entries of the extended pose, 6 + m with m redundant joints.
        by_program: True if a convex program computes the forces. The vector then has the load in
            place of force, torque and pressure.
    """

    pose: int
    by_program: bool

    @property
    def variables(self) -> int:
        """Number of variables of the quantities: the extended pose, its first and second derivative
        by u, the joints of both arms, u'' and u'^2."""
        return 3 * self.pose + self.joints + 2


def driven_layout(workcell: Workcell) -> DrivenLayout:
    """Return the layout of the limited quantities of a workcell at one point of a path that
    robots drive. All quantities except force and load are divided by their limits.

    Blocks, in order:

    speed (joints + 2): squared speeds of the joints, of the payload and of its rotation.

    acceleration (joints): signed accelerations of the joints.

    cone (2): squared lengths of the payload's acceleration and of its angular acceleration.

    force (2): in the paper's model the normal component and the tangential magnitude of the
    required force, from which the normal forces follow (`planned_branches`); for soft fingers the
    two normal forces [N].

    torque (joints): signed joint torques.

    pressure (2): shifts of the centres of pressure over the patch radii.

    load (6): force [N] and moment [N m] that the pads have to balance, about the box frame's
    origin, along the box's axes. If a convex program computes the forces, load takes the place of
    force, torque and pressure; otherwise load has no entries.
    """
    joints, by_program = limit_layout(workcell).joints, not contact_model(workcell).has_closed_form
    entries = {"joint": joints, "payload": 1, "robot": 2}
    sizes = dict.fromkeys([limit.block for limit in LIMITS], 0)
    for limit in LIMITS:
        is_force = limit.group != "motion"
        if limit.option != "reference_speed" and not (is_force and by_program):
            sizes[limit.block] += entries[limit.scope]
    sizes["load"] = LOAD_SIZE * by_program
    return DrivenLayout(joints, sizes, workcell.task.extended_size, by_program)


def planned_branches(workcell: Workcell) -> Array:
    """Return linear functions of the limited quantities at a point of a path. For each contact, the
    largest of its functions is the planned normal force [N].

    Returns:
        Coefficients (2, b, size) of b functions for each contact, by the quantities (size,) of
        `driven_layout`. b is 0 if a convex program computes the forces.
    """
    layout, own = driven_layout(workcell), contact_model(workcell).force_branches
    if layout.by_program:
        return np.zeros((2, 0, layout.size))
    forces = np.zeros((2, own.shape[1], layout.size))
    forces[:, :, layout.block("force")] = own
    return forces


def driven_functions(model: CellModel) -> dict[str, ca.Function]:
    """Build, by name, the functions of limited quantities at one point of a path that robots drive.

    Inputs of both: pose, first and second (6 + m,), the extended pose (box pose, then the cell's m
    redundant joints) and its first and second derivative by u; q_1 and q_2, the joints of both
    arms; a = u''; w = u'^2. Together these are the variables y. The cell's symbolic parameters come
    last.

    - driven_first returns value (size,), laid out by `driven_layout`, and slope (size, variables),
      the derivatives by y (NumPy shape).
    - driven_second takes two more inputs after y: weight (size,), a factor on each quantity, and
      direction (variables,). It returns change (variables,): the Hessian by y of the weighted sum
      of the quantities, times direction.
    """
    layout = driven_layout(model.workcell)
    names = [*PATH_OUTPUTS, "a", "w"]
    sizes = [layout.pose] * 3 + [*[arm.n_joints for arm in model.robots], 1, 1]
    inputs = {name: ca.SX.sym(name, size) for name, size in zip(names, sizes, strict=True)}
    implicit = ImplicitVariables()
    value, y = _value(model, [*inputs.values()], implicit), ca.vertcat(*inputs.values())
    assert value.shape == (layout.size, 1)
    first = [value, ca.densify(ca.jacobian(value, y).T)]
    weight, direction = ca.SX.sym("weight", layout.size), ca.SX.sym("direction", layout.variables)
    gradient = ca.gradient(ca.dot(weight, value), y)
    second = [ca.densify(ca.jtimes(gradient, y, direction))]
    first, second = map(implicit.replaced, (first, second))
    given = limit_numbers(model.workcell)
    values, bent = dict(zip(("value", "slope"), first, strict=True)), {"change": second[0]}
    along = inputs | {"weight": weight, "direction": direction}
    return {
        DRIVEN_FIRST: named_function(DRIVEN_FIRST, inputs | given, values),
        DRIVEN_SECOND: named_function(DRIVEN_SECOND, along | given, bent),
    }


def _value(model: CellModel, inputs: list[ca.SX], implicit: ImplicitVariables) -> ca.SX:
    """Compute the quantities (size,) of `driven_layout` at one point of a path.

    Args:
        model: model of the cell.
        inputs: extended pose (6 + m,), its first and second derivative by u, joint positions of
            both arms, u'' and u'^2, each one expression.
        implicit: stores the results of Newton's method for the contact forces, so that derivatives
            become exact.
    """
    workcell = model.workcell
    limits, joints = limit_layout(workcell), limit_layout(workcell).joints
    *path, a, w = inputs
    row = sample_limits_function(model)(*path, *limit_numbers(workcell).values())
    block = {name: row[limits.block(name)] for name in limits.sizes}
    cones = [block["cone"][6 * k : 6 * k + 6] for k in (0, 1)]
    payload = workcell.payload
    reach = (
        payload.acceleration_max / payload.velocity_max,
        payload.angular_acceleration_max / payload.angular_velocity_max,
    )
    # Not the lengths' squares: a length has no slope where the box does not move.
    speeds = [ca.sumsqr(cones[k][:3] * reach[k]) for k in (0, 1)]
    force = block["force"][:3] * a + block["force"][3:6] * w + block["force"][6:]
    if not contact_model(workcell).has_closed_form:
        axes = ca.SX(number(workcell.contacts[0].T_box_pad[:3, :3]))
        moment = block["moment"][:3] * a + block["moment"][3:] * w
        in_box, centre = ca.mtimes(axes, force), ca.SX(number(payload.centre_of_mass))
        forces, ratios = ca.vertcat(in_box, ca.mtimes(axes, moment) + ca.cross(centre, in_box)), []
    else:
        found, forces = contact_limits(workcell, block, (a, w), implicit)
        ratios = [found]
    return ca.vertcat(
        block["speed"][:joints] ** 2 * w,
        *[speed * w for speed in speeds],
        block["acceleration"][:joints] * a + block["acceleration"][joints:] * w,
        *[ca.sumsqr(cone[:3] * a + cone[3:] * w) for cone in cones],
        forces,
        *ratios,
    )
