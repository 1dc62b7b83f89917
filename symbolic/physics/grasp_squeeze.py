"""The least force of one robot with which pads anywhere hold a load: a linear objective in the
allocation's program.

One robot's normal force is commanded before the case is known. Whatever wrenches of all pads then
carry the load, an internal squeeze can be added to them that presses this robot's pads harder, so
that with more than its least force the load is held as well.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from symbolic.physics.central_path import least_effort
from symbolic.physics.closure import WRENCH_SIZE, is_closed
from symbolic.physics.grasp import BEYOND, LOAD_SIZE, MOMENT_ARM, SCALE_FLOOR, Grasp
from symbolic.physics.patches import least
from symbolic.workcell.records import Contact, Workcell

REACHES = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Sizes of the patches, as shares, at which a squeeze to start from is looked for."""

OTHER_WEIGHT = 1e-3
"""Weight of the other robot's normal force, which alone may be anything: what it adds to the
commanded force makes that a little more than the least."""


class GraspSqueeze(Grasp):
    """Least normal force of one robot, plus a little of the other's; see `OTHER_WEIGHT`. Inputs are
    load, coefficients and sizes of the patches over the cell's own, (2,) by robot.

    Attributes:
        commanded: index of the robot whose force is commanded.
        reach: the size of the patches that the squeeze lies within, as a share.
    """

    def __init__(self, workcell: Workcell, commanded: int) -> None:
        """Find the squeeze to start from, within smaller patches where these close the grasp.

        Raises:
            SettingsError: no squeeze holds the payload whatever is asked.
        """
        smaller = ((share, smaller_patches(workcell, share)) for share in REACHES)
        closed = ((share, cell) for share, cell in smaller if is_closed(cell))
        self.reach, cell = next(closed, (1.0, workcell))
        super().__init__(cell)
        self.commanded = commanded
        self.cell_sizes = (("load", LOAD_SIZE), ("friction", 2), ("reach", 2))
        self.nominal = (*self.nominal, [1.0, 1.0])

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """See `symbolic.physics.central_path.Program`."""
        total = 0.0
        for wrench, robot in zip(wrenches, self.robots, strict=True):
            total += wrench[0] * (1.0 if robot == self.commanded else OTHER_WEIGHT)
        return total


def commanded_forces(squeeze: GraspSqueeze, load: ca.MX, friction: ca.MX, share: ca.MX) -> ca.MX:
    """(2,) normal forces of the robots [N]: what is commanded, a convex function of the load, and
    what the other one then presses with. Beyond any limit where the grasp does not close.

    Args:
        load: (6,) force and moment about the box frame's origin, along the box's axes.
        friction: (2,) Coulomb coefficients of the robots' pads.
        share: (2,) sizes of their patches over the cell's own.
    """
    size = ca.sqrt(ca.sumsqr(load[:3]) + ca.sumsqr(load[3:] / MOMENT_ARM) + SCALE_FLOOR**2)
    reach = share / squeeze.reach
    found = least_effort(squeeze, load / size, friction, reach)
    return _in_newtons(squeeze)(found, size, friction, reach)


def held_slack(
    squeeze: GraspSqueeze, load: ca.SX, friction: ca.SX, share: ca.SX, force: ca.SX
) -> ca.SX:
    """Positive where the least wrenches that balance a load, and as much of the squeeze as makes
    the commanded force (arguments as in `commanded_forces`), lie within all cones."""
    reach = share / squeeze.reach
    asked, given = squeeze.asked(load, friction, reach), squeeze.squeezed(friction, reach)
    own = [k for k, robot in enumerate(squeeze.robots) if robot == squeeze.commanded]
    pressed = (force - sum(asked[k][0] for k in own)) / sum(given[k][0] for k in own)
    held = [a + pressed * g for a, g in zip(asked, given, strict=True)]
    slack = [patch.slack(state) for patch, state in zip(squeeze.patches, held, strict=True)]
    return ca.fmin(least(slack), pressed)


def smaller_patches(workcell: Workcell, share: float) -> Workcell:
    """The cell with smaller patches about the same places."""

    def smaller(contact: Contact) -> Contact:
        sides = contact.half_sides
        return replace(
            contact,
            patch_radius=share * contact.patch_radius,
            half_sides=None if sides is None else (share * sides[0], share * sides[1]),
            further=tuple(smaller(pad) for pad in contact.further),
        )

    first, second = (smaller(contact) for contact in workcell.contacts)
    return replace(workcell, contacts=(first, second))


def _in_newtons(squeeze: GraspSqueeze) -> ca.Function:
    n = len(squeeze.patches)
    found, size = ca.SX.sym("w", WRENCH_SIZE * n), ca.SX.sym("s")
    friction, reach = ca.SX.sym("mu", 2), ca.SX.sym("reach", 2)
    force = [ca.SX(0.0), ca.SX(0.0)]
    for own, robot in zip(ca.vertsplit(found, WRENCH_SIZE), squeeze.robots, strict=True):
        force[robot] += own[0]
    force[squeeze.commanded] += OTHER_WEIGHT * force[1 - squeeze.commanded]
    squeezed = zip(squeeze.patches, squeeze.squeezed(friction, reach), strict=True)
    closes = least([patch.slack(state) for patch, state in squeezed]) > 0.0
    outputs = size * ca.if_else(closes, ca.vertcat(*force), BEYOND)
    return ca.Function("in_newtons", [found, size, friction, reach], [outputs])
