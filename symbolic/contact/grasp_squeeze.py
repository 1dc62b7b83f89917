"""Least squeeze of pads with any normals: the least commanded force of one robot that holds a load.

The program has the constraints of `symbolic.contact.grasp` and a linear objective, so the commanded
force is a convex function of the load.
"""

from __future__ import annotations

import casadi as ca

from symbolic.contact.central_path import minimum
from symbolic.contact.force_closure import derive_grasp_numbers, has_force_closure, smaller_patches
from symbolic.contact.grasp import BEYOND, SCALE_FLOOR, Grasp
from symbolic.expression import as_mx, number
from symbolic.records import Workcell
from symbolic.records.numbered import NumberedWorkcell

DISPLACED = 6
"""Number of fixed-point iterations for the moments of displaced forces. Each multiplies the error
by the displacement over the pads' distance."""

REACHES = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Relative sizes of the patches within which an initial squeeze is sought, in the order of
trial."""

ROUNDING = 1e-6
"""Share of the commanded force by which displaced forces may exceed their limits."""

OTHER_WEIGHT = 1e-3
"""Weight of the other robot's normal force, which makes the solution unique. It raises the
commanded force slightly above the least."""


class GraspSqueeze(Grasp):
    """Convex program of the least commanded force: it minimises the normal force of the commanded
    robot plus `OTHER_WEIGHT` times the normal force of the other robot.

    Inputs: load (6,) about the box frame's origin, along the box's axes; friction (2,) of each
    robot's pads; size (2,) of each robot's patches over the cell's own; displacement (4,) along the
    pads' tangents [m], two entries for all pads of one robot.

    Attributes:
        workcell: the cell.
        commanded: index of the robot whose force is commanded.
    """

    def __init__(self, workcell: Workcell, commanded: int) -> None:
        """Take the constants of the grasp from a workcell with symbolic parameters, or derive them.

        The internal squeeze is derived for reduced patches, so that their torsion stays in reserve.
        The factor on their sizes is the first of `REACHES` with which friction closes the grasp, or
        1.

        Args:
            workcell: cell with the pads.
            commanded: index of the robot whose force is commanded.

        Raises:
            SettingsError: no internal squeeze exists.
        """
        if isinstance(workcell, NumberedWorkcell):
            numbers = workcell.squeezes[commanded]
        else:
            shares = (s for s in REACHES if has_force_closure(smaller_patches(workcell, s)))
            numbers = derive_grasp_numbers(workcell, next(shares, 1.0))
        super().__init__(workcell, numbers)
        self.workcell, self.commanded = workcell, commanded
        self.cell_sizes = (*self.cell_sizes, ("reach", 2), ("displacement", 4))

    def _nominal(self) -> tuple[list[float], ...]:
        """Return the workcell's own values of all inputs of the convex program except the load.

        Returns:
            Friction coefficients (2,); relative patch sizes (2,), which are 1; and displacements
            (4,), which are 0.
        """
        return (*super()._nominal(), [1.0, 1.0], [0.0] * 4)

    def balanced(self, free: ca.SX, cell: list[ca.SX]) -> list[ca.SX]:
        """Compute the scaled wrench (4,) of each pad such that all pads together balance the load,
        with every pad displaced along its tangents.

        A scaled wrench holds normal force, tangential force (2,) over the friction coefficient, and
        torsion over friction coefficient times patch radius. A displacement changes the moment of a
        pad's force. `DISPLACED` fixed-point iterations find forces that also balance these changes.

        Args:
            free: (free_size,) components of the scaled wrenches that the load does not determine.
            cell: inputs of the convex program in this order: load (6,) about the box frame's
                origin, along the box's axes; friction (2,) of each robot's pads; size (2,) of each
                robot's patches over the cell's own size; displacement (4,) of the pads [m], two
                tangential components per robot.
        """
        load, friction, reach, displacement = cell
        wrenches = self._balanced_wrenches(load, free, [friction, reach])
        for _ in range(DISPLACED):
            turned = self._turned(wrenches, displacement, [friction, reach])
            wrenches = self._balanced_wrenches(
                load - ca.vertcat(ca.SX.zeros(3), turned), free, [friction, reach]
            )
        return wrenches

    def _turned(self, wrenches: list[ca.SX], displacement: ca.SX, sizes: list[ca.SX]) -> ca.SX:
        """Compute the moment (3,) that the pads' forces gain because the pads are displaced, along
        the box's axes.

        Args:
            wrenches: scaled wrench (4,) of each pad.
            displacement: (4,) displacement of the pads [m], two tangential components per robot.
            sizes: inputs that scale the wrenches: friction (2,), relative patch sizes (2,).
        """
        total = ca.SX.zeros(3)
        for i, (pad, robot, own) in enumerate(zip(self._pads, self.robots, wrenches, strict=True)):
            normal, *tangent = ca.vertsplit((self.units(i, *sizes) * own)[:3])
            moved = ca.vertcat(displacement[2 * robot : 2 * robot + 2], 0.0)
            force = ca.vertcat(*tangent, normal)
            total += ca.mtimes(number(pad.T_box_pad[:3, :3]), ca.cross(moved, force))
        return total

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """Compute the cost that the convex program minimises: the normal force of the commanded
        robot plus `OTHER_WEIGHT` times the normal force of the other robot.

        Args:
            wrenches: scaled wrench (4,) of each pad.
            cell: inputs of the convex program, which the cost does not need.
        """
        total = 0.0
        for wrench, robot in zip(wrenches, self.robots, strict=True):
            total += wrench[0] * (1.0 if robot == self.commanded else OTHER_WEIGHT)
        return total

    def result(self, wrenches: list[ca.SX], sizes: list[ca.SX]) -> tuple[ca.SX, ca.SX | float]:
        """Convert the scaled wrenches of a solution to the normal forces of the robots. `solve` has
        divided the load by its size, so these are forces over the size of the load.

        Args:
            wrenches: scaled wrench (4,) of each pad.
            sizes: friction coefficients (2,) and relative patch sizes (2,); not used.

        Returns:
            Sum (2,) of the normal forces of each robot's pads; and the number, beyond every limit,
            that replaces both sums if friction does not close the grasp.
        """
        force = [ca.SX(0.0), ca.SX(0.0)]
        for own, robot in zip(wrenches, self.robots, strict=True):
            force[robot] += own[0]
        force[self.commanded] += OTHER_WEIGHT * force[1 - self.commanded]
        return ca.vertcat(*force), BEYOND


def commanded_forces(
    squeeze: GraspSqueeze,
    load: ca.MX,
    friction: ca.MX,
    share: ca.MX,
    displacement: ca.MX,
    groups: dict[str, ca.MX] | None = None,
    differentiable: bool = False,
) -> ca.MX:
    """Build the expression of the normal forces (2,) [N] of both robots, by index of the robot,
    with the least commanded force that holds the load.

    The commanded force is convex in the load; the force of the other robot results. Both exceed any
    limit if friction does not close the grasp.

    Args:
        squeeze: convex program, which knows the commanded robot.
        load: (6,) force and moment about the box frame's origin, along the box's axes [N, N m].
        friction: (2,) Coulomb coefficients of the robots' pads.
        share: (2,) sizes of the robots' patches over the cell's own sizes.
        displacement: (4,) displacements of the first, then of the second robot's pads along their
            tangents [m].
        groups: MX vectors in place of the convex program's symbolic parameters, by group; None if
            it has none.
        differentiable: True for exact first derivatives; False if only values are needed, because
            derivatives of the expression are then not exact.
    """
    groups = groups or {}
    reach = share / as_mx(ca.SX(number(squeeze.numbers.reach)), squeeze.given, groups)
    cell = [load, friction, reach, displacement]
    return squeeze.solve(cell, list(groups.values()), differentiable)


def commanded_slack(
    squeeze: GraspSqueeze,
    load: ca.SX,
    friction: ca.SX,
    share: ca.SX,
    displacement: ca.SX,
    force: ca.SX,
) -> ca.SX:
    """Build the slack of a commanded force, a scalar: a positive slack proves that the force holds
    the load. A negative slack proves nothing.

    The tested contact wrenches are those of least norm that balance the load, plus the internal
    squeeze that raises the normal force to the commanded one. The slack is positive if every
    wrench lies within its friction cone.

    Args:
        squeeze: convex program, which knows the commanded robot.
        load: (6,) force and moment about the box frame's origin, along the box's axes [N, N m].
        friction: (2,) Coulomb coefficients of the robots' pads.
        share: (2,) sizes of the robots' patches over the cell's own sizes.
        displacement: (4,) displacements of the first, then of the second robot's pads along their
            tangents [m].
        force: commanded normal force [N].
    """
    reach = share / squeeze.numbers.reach
    asked, given = (
        squeeze.least_states(load, friction, reach),
        squeeze.squeeze_states(friction, reach),
    )
    own = [k for k, robot in enumerate(squeeze.robots) if robot == squeeze.commanded]
    pressed = (force - sum(asked[k][0] for k in own)) / sum(given[k][0] for k in own)
    held = [a + pressed * g for a, g in zip(asked, given, strict=True)]
    held = squeeze.balanced(squeeze.free(held), [load, friction, reach, displacement])
    enough = ca.fmin(pressed, (1.0 + ROUNDING) * force - sum(held[k][0] for k in own))
    slack = [patch.slack(state) for patch, state in zip(squeeze.patches, held, strict=True)]
    return ca.fmin(minimum(slack), enough)


def internal_force_gain(squeeze: GraspSqueeze) -> ca.Function:
    """Build the function of the additional commanded normal force that is needed per newton of a
    tangential force with which the arms push against each other.

    The tangential force may act at any single pad. Friction has to bear it there, so the internal
    squeeze, pad forces that balance one another, has to be larger. The result is for the pad at
    which the squeeze has to grow most.

    Inputs: friction (2,), Coulomb coefficients of the robots' pads; share (2,), sizes of the
    robots' patches over the cell's own sizes; then the symbolic parameters. Output: additional
    normal force of the commanded robot over the tangential force [N/N], a scalar.

    Args:
        squeeze: convex program, which knows the commanded robot.
    """
    friction, share = ca.SX.sym("friction", 2), ca.SX.sym("share", 2)
    given = squeeze.squeeze_states(friction, share / squeeze.numbers.reach)
    left = [
        friction[r] * (given[k][0] - ca.norm_2(given[k][1:3]) - ca.fabs(given[k][3]))
        for k, r in enumerate(squeeze.robots)
    ]
    pressed = squeeze.normals[squeeze.commanded]
    held = ca.fmax(minimum(left), SCALE_FLOOR)
    inputs = [friction, share, *squeeze.given.values()]
    return ca.Function("internal_force_gain", inputs, [pressed / held])
