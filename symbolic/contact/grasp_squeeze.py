"""The least squeeze of pads anywhere: the commanded force of one robot that holds a load.

The objective is linear in the program of `symbolic.contact.grasp`, so that the commanded force is a
convex function of the load.
"""

from __future__ import annotations

import casadi as ca

from symbolic.contact.central_path import least
from symbolic.contact.force_closure import derived, has_force_closure, smaller_patches
from symbolic.contact.grasp import BEYOND, SCALE_FLOOR, Grasp
from symbolic.expression import as_mx, number
from symbolic.records import Workcell
from symbolic.records.numbered import NumberedWorkcell

DISPLACED = 6
"""Repetitions by which what displaced forces turn about is found: each takes the error to its
displacement over the pads' distances."""

REACHES = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Sizes of the patches, as shares, at which a squeeze to start from is looked for."""

ROUNDING = 1e-6
"""Share of the commanded force by which balancing displaced forces may exceed it."""

OTHER_WEIGHT = 1e-3
"""Weight of the other robot's normal force, which alone may be anything: what it adds to the
commanded force makes that a little more than the least."""


class GraspSqueeze(Grasp):
    """Least normal force of one robot, plus a little of the other's; see `OTHER_WEIGHT`. Inputs are
    load, coefficients and sizes of the patches over the cell's own, (2,) by robot, and the pads'
    displacements (4,), the same for all pads of a robot, along their tangents.

    Attributes:
        workcell: the cell.
        commanded: index of the robot whose force is commanded.
    """

    def __init__(self, workcell: Workcell, commanded: int) -> None:
        """Find the squeeze to start from, within smaller patches where these close the grasp.

        Raises:
            SettingsError: no squeeze holds the payload whatever is asked.
        """
        if isinstance(workcell, NumberedWorkcell):
            numbers = workcell.squeezes[commanded]
        else:
            shares = (s for s in REACHES if has_force_closure(smaller_patches(workcell, s)))
            numbers = derived(workcell, next(shares, 1.0))
        super().__init__(workcell, numbers)
        self.workcell, self.commanded = workcell, commanded
        self.cell_sizes = (*self.cell_sizes, ("reach", 2), ("displacement", 4))

    def _nominal(self) -> tuple[list[float], ...]:
        """See `Grasp`."""
        return (*super()._nominal(), [1.0, 1.0], [0.0] * 4)

    def balanced(self, free: ca.SX, cell: list[ca.SX]) -> list[ca.SX]:
        """See `symbolic.contact.central_path.ConvexProgram`."""
        load, friction, reach, displacement = cell
        wrenches = self._left_by(load, free, [friction, reach])
        for _ in range(DISPLACED):
            turned = self._turned(wrenches, displacement, [friction, reach])
            wrenches = self._left_by(
                load - ca.vertcat(ca.SX.zeros(3), turned), free, [friction, reach]
            )
        return wrenches

    def _turned(self, wrenches: list[ca.SX], displacement: ca.SX, sizes: list[ca.SX]) -> ca.SX:
        """Moment (3,) of scaled wrenches' forces about where they would act."""
        total = ca.SX.zeros(3)
        for i, (pad, robot, own) in enumerate(zip(self._pads, self.robots, wrenches, strict=True)):
            normal, *tangent = ca.vertsplit((self.units(i, *sizes) * own)[:3])
            moved = ca.vertcat(displacement[2 * robot : 2 * robot + 2], 0.0)
            force = ca.vertcat(*tangent, normal)
            total += ca.mtimes(number(pad.T_box_pad[:3, :3]), ca.cross(moved, force))
        return total

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """See `symbolic.contact.central_path.ConvexProgram`."""
        total = 0.0
        for wrench, robot in zip(wrenches, self.robots, strict=True):
            total += wrench[0] * (1.0 if robot == self.commanded else OTHER_WEIGHT)
        return total

    def told(self, wrenches: list[ca.SX], sizes: list[ca.SX]) -> tuple[ca.SX, ca.SX | float]:
        """See `Grasp`."""
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
    handed: dict[str, ca.MX] | None = None,
    differentiable: bool = False,
) -> ca.MX:
    """(2,) normal forces of the robots [N]: what is commanded, a convex function of the load, and
    what the other one then presses with. Beyond any limit where the grasp does not close.

    Args:
        load: (6,) force and moment about the box frame's origin, along the box's axes.
        friction: (2,) Coulomb coefficients of the robots' pads.
        share: (2,) sizes of their patches over the cell's own.
        displacement: (4,) of the pads [m].
        handed: the squeeze's given numbers, where they are symbols.
        differentiable: whether first derivatives are wanted.
    """
    handed = handed or {}
    reach = share / as_mx(ca.SX(number(squeeze.numbers.reach)), squeeze.given, handed)
    cell = [load, friction, reach, displacement]
    return squeeze.solved(cell, list(handed.values()), differentiable)


def commanded_slack(
    squeeze: GraspSqueeze,
    load: ca.SX,
    friction: ca.SX,
    share: ca.SX,
    displacement: ca.SX,
    force: ca.SX,
) -> ca.SX:
    """Positive where the least wrenches that balance a load, and as much of the squeeze as makes
    the commanded force (arguments as in `commanded_forces`), lie within all cones."""
    reach = share / squeeze.numbers.reach
    asked, given = squeeze.asked(load, friction, reach), squeeze.squeezed(friction, reach)
    own = [k for k, robot in enumerate(squeeze.robots) if robot == squeeze.commanded]
    pressed = (force - sum(asked[k][0] for k in own)) / sum(given[k][0] for k in own)
    held = [a + pressed * g for a, g in zip(asked, given, strict=True)]
    held = squeeze.balanced(squeeze.free(held), [load, friction, reach, displacement])
    enough = ca.fmin(pressed, (1.0 + ROUNDING) * force - sum(held[k][0] for k in own))
    slack = [patch.slack(state) for patch, state in zip(squeeze.patches, held, strict=True)]
    return ca.fmin(least(slack), enough)


def against_internal(squeeze: GraspSqueeze) -> ca.Function:
    """friction and sizes of the patches, (2,) by robot, to the commanded force beyond the least [N]
    per newton of tangential force of any pad: what the squeeze leaves of that pad's friction holds
    it."""
    friction, share = ca.SX.sym("friction", 2), ca.SX.sym("share", 2)
    given = squeeze.squeezed(friction, share / squeeze.numbers.reach)
    left = [
        friction[r] * (given[k][0] - ca.norm_2(given[k][1:3]) - ca.fabs(given[k][3]))
        for k, r in enumerate(squeeze.robots)
    ]
    pressed = squeeze.normals[squeeze.commanded]
    held = ca.fmax(least(left), SCALE_FLOOR)
    inputs = [friction, share, *squeeze.given.values()]
    return ca.Function("against_internal", inputs, [pressed / held])
