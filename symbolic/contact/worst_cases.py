"""The least force that holds a moving payload in one case of what is not exactly known.

A case says what friction, mass, centre of mass, pad positions and disturbance really are. What is
known of the payload's inertia is taken to hold about the nominal centre of mass, whatever the true
one, and to grow with the mass: with it the required force and moment are affine in the centre of
mass and in the disturbance, each for itself.

Of opposite pads it is the least squeeze, of pads anywhere the least force of one robot: a linear
objective in the program of `symbolic.contact.grasp`. That force is commanded before the case is
known. Whatever wrenches of all pads then carry the load, an internal squeeze can be added to them
that presses this robot's pads harder, so that with more than its least force the load is held as
well.

The contact model of what is commanded decides (`ContactModel.command_model`): arms that command a
normal force alone have pads that press evenly, about their displaced places, whatever the plan
takes them for.

What is commanded is more: a share of it may be missing, and the arms may work against one another.
With N a pad's least normal force, e the missing share and T the opposed tangential force, it is
(N + T / mu) / (1 - e). Friction's cones are convex and contain (T / mu, T), so that N + T / mu
holds whichever way T acts; where the pad carries no torsion and T acts along its load, nothing less
does.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import Any

import casadi as ca

from symbolic.contact.central_path import least
from symbolic.contact.force_closure import (
    LOAD_SIZE,
    derived,
    has_force_closure,
    smaller_patches,
)
from symbolic.contact.grasp import BEYOND, SCALE_FLOOR, Grasp
from symbolic.contact.load import required
from symbolic.contact.model import ContactLoad, ImplicitVariables
from symbolic.contact.registry import command_model
from symbolic.expression import (
    Expression,
    as_mx,
    mx_symbols,
    named_function,
    number,
    sx_parameters,
)
from symbolic.records import Workcell
from symbolic.records.numbered import NumberedWorkcell

CASE_SIZES = {
    "friction": 2,
    "radius": 2,
    "mass": 1,
    "centre_of_mass": 3,
    "disturbance": 3,
    "displacement": 4,
    "tracking": 2,
    "internal": 1,
}
"""Parts of a case, in order: coefficients; radii of the patches [m]; mass [kg]; centre of mass in
the box frame [m]; acceleration beside the motion's, world frame [m/s^2]; displacements of both
pads along the tangents of contact 1 [m], of pads anywhere along their own; share of its commanded
normal force that either robot lacks, none of the one that leads; opposed tangential force [N]."""

SQUARED_SPEED_FLOOR = 1e-12
"""Floor of u'^2 [1/s^2]; what it adds to a force is far below rounding."""

CASE_SIZE = sum(CASE_SIZES.values())

MOTION = ("pose", "rate", "second_rate")
"""Inputs of functions of cases, before the case."""


def case_squeeze_function(
    workcell: Workcell, commanded: int = 1, displaced: bool = True
) -> ca.Function:
    """pose, rate, second_rate (6,) and a case (18,), see `CASE_SIZES`, to normal_force (2,) [N].

    Of pads that have one squeeze the least: with more of it they can carry the case, with less not.
    Of others the least of the commanded robot, and what the other one then presses with.

    Args:
        commanded: index of the robot whose force is commanded.
        displaced: whether cases may displace the pads, which costs soft fingers more.

    Raises:
        SettingsError: pads anywhere do not close their grasp.
    """
    squeeze, inputs = _asked(workcell, commanded)
    force = _least_force(workcell, squeeze, inputs, displaced=displaced)
    return named_function("case_squeeze", inputs, {"normal_force": force}, cse=False)


def case_gradient_function(
    workcell: Workcell, commanded: int = 1, numbers: bool = False
) -> ca.Function:
    """As `case_squeeze_function`, and slope (NumPy shape (2, 18)), of each force by pose, rate and
    second_rate; of pads that have one squeeze in cases without displaced ones.

    Args:
        numbers: whether slope goes on, by the case (18,) and by the cell's numbers; of pads
            anywhere in place of these by the load (6,) of `case_origin_load_function`.
    """
    squeeze, inputs = _asked(workcell, commanded)
    by = [*inputs.values()] if numbers else [inputs[name] for name in MOTION]
    if squeeze is None:
        implicit = ImplicitVariables()
        # Pads that are moved alone lie beside one another then.
        force = _least_force(workcell, None, inputs, implicit, True, displaced=numbers)
        slope = ca.densify(ca.horzcat(*[ca.jacobian(force, part) for part in by]).T)
        found = implicit.replaced([force, slope])
    else:
        beside, own = ca.MX.sym("beside", LOAD_SIZE), len(inputs) - len(squeeze.given)
        force = _least_force(workcell, squeeze, inputs, differentiable=True, beside=beside)
        slope = ca.horzcat(*[ca.jacobian(force, part) for part in (*by[:own], beside)])
        asked = [*inputs.values()]
        function = ca.Function("beside", [*asked, beside], [force, ca.densify(slope.T)])
        found = function(*asked, ca.DM.zeros(LOAD_SIZE))
    outputs = dict(zip(("normal_force", "slope"), found, strict=True))
    return named_function("case_gradient", inputs, outputs, cse=False)


def case_slopes_function(workcell: Workcell) -> ca.Function:
    """Box pose and its derivatives by u (6,), u'', u'^2 and a case (18,), see `CASE_SIZES`, to
    normal_force (2,) [N] as of `case_squeeze_function`, and slope (NumPy shape (2, 20)), of each
    force by pose, both derivatives, u'' and u'^2; of cases without displaced pads."""
    inputs = _inputs(ca.SX, sx_parameters(workcell.payload))
    path = {name: ca.SX.sym(name, 6) for name in ("pose", "first", "second")}
    path |= {"a": ca.SX.sym("a"), "w": ca.SX.sym("w")}
    pose, first, second, a, w = path.values()
    # A root has no slope at rest, what follows from its square has.
    motion = (pose, first * ca.sqrt(w + SQUARED_SPEED_FLOOR), first * a + second * w)
    implicit, driven = ImplicitVariables(), inputs | dict(zip(MOTION, motion, strict=True))
    force = _least_force(workcell, None, driven, implicit)
    slope = ca.densify(ca.jacobian(force, ca.vertcat(*path.values())).T)
    found = implicit.replaced([force, slope])
    outputs = dict(zip(("normal_force", "slope"), found, strict=True))
    inputs = path | {name: inputs[name] for name in inputs if name not in MOTION}
    return named_function("case_slopes", inputs, outputs, cse=False)


def case_difference_function(workcell: Workcell) -> ca.Function:
    """pose, rate, second_rate (6,) and a case (18,), see `CASE_SIZES`, to difference N_1 - N_2 [N],
    which no squeeze changes."""
    inputs = _inputs(ca.SX, sx_parameters(workcell.payload))
    motion = [inputs[name] for name in MOTION]
    (difference,) = ca.cse([case_in_pad_axes(workcell, motion, inputs["case"])[0][2]])
    return named_function("case_difference", inputs, {"difference": difference}, cse=False)


def case_slack_function(workcell: Workcell, commanded: int = 1) -> ca.Function:
    """pose, rate, second_rate (6,), a case (18,) and the commanded force [N] to slack.

    Where it is positive, one pressure that is known holds the case; elsewhere
    `case_squeeze_function` knows. It takes a thirtieth of that one's time.
    """
    squeeze = (
        None if command_model(workcell).has_scalar_squeeze else GraspSqueeze(workcell, commanded)
    )
    given = sx_parameters(workcell.payload) if squeeze is None else squeeze.given
    inputs, force = _inputs(ca.SX, given), ca.SX.sym("force")
    case = inputs["case"]
    if squeeze is not None:
        friction, *_, displacement, tracking, internal = case_parts(case)
        numbers = list(given.values())
        sizes = _sizes_function(squeeze)(case, *numbers)
        load = _origin_load(workcell, inputs)
        left = (1.0 - tracking[commanded]) * force
        left -= internal * _against_internal(squeeze)(friction, sizes, *numbers)
        slack = [commanded_slack(squeeze, load, friction, sizes, displacement, left)]
    else:
        difference = case_in_pad_axes(workcell, [inputs[name] for name in MOTION], case)[0][2]
        n_1 = force + difference if commanded == 1 else force
        slack = [n_1 - _least_force(workcell, None, inputs)[0]]
    own = {name: inputs[name] for name in (*MOTION, "case")} | {"force": force} | given
    found = slack if squeeze is None else ca.cse(slack)
    return named_function("case_slack", own, {"slack": found[0]}, cse=False)


def _asked(
    workcell: Workcell, commanded: int = 1
) -> tuple[GraspSqueeze | None, dict[str, Expression]]:
    """The program of pads anywhere, and the inputs of functions of a cell's least force."""
    if command_model(workcell).has_scalar_squeeze:
        return None, _inputs(ca.SX, sx_parameters(workcell.payload))
    squeeze = GraspSqueeze(workcell, commanded)
    return squeeze, _inputs(ca.MX, mx_symbols(squeeze.given))


def _inputs(kind: Any, given: Mapping[str, Expression]) -> dict[str, Expression]:
    """Motion, case and numbers by name."""
    motion = {name: kind.sym(name, 6) for name in MOTION}
    return motion | {"case": kind.sym("case", CASE_SIZE)} | dict(given)


def _least_force(
    workcell: Workcell,
    squeeze: GraspSqueeze | None,
    inputs: dict[str, Expression],
    implicit: ImplicitVariables | None = None,
    differentiable: bool = False,
    displaced: bool = False,
    beside: Expression | float = 0.0,
) -> Expression:
    """(2,) normal forces to command [N].

    Args:
        beside: load (6,) about the box frame's origin beside that of the case, of pads anywhere.
    """
    case = inputs["case"]
    friction, *_ = case_parts(case)
    if squeeze is not None:
        handed = {name: inputs[name] for name in squeeze.given}
        load = _origin_load(workcell, inputs)
        load = load if isinstance(beside, float) else load + beside
        return _to_command_of(squeeze, load, case, handed, differentiable)
    force, moment, arms = case_in_pad_axes(workcell, [inputs[name] for name in MOTION], case)
    asked = ContactLoad(force, moment, arms, ca.SX(ca.DM.eye(3)), friction)
    held = command_model(workcell).hold(asked, implicit, displaced)
    return ca.densify(_to_command(held.normal, case))


def _origin_load(workcell: Workcell, inputs: dict[str, Expression]) -> Expression:
    names = (*MOTION, "case", *sx_parameters(workcell.payload))
    return case_origin_load_function(workcell)(*[inputs[name] for name in names])


def _to_command(normal: Expression, case: Expression) -> Expression:
    """(2,) normal forces to command where least ones (2,) hold: the motion fixes their difference,
    so that both press as much more."""
    *_, tracking, _ = case_parts(case)
    share, opposed = tracking / (1.0 - tracking), _against_arms(case)
    # Entry by entry: CasADi 3.8 loses the derivative of a product of vectors here.
    more = opposed + sum(share[i] * (normal[i] + opposed) for i in (0, 1))
    return ca.vertcat(normal[0] + more, normal[1] + more)


def _against_arms(case: Expression) -> Expression:
    """Normal force that holds the opposed tangential force of a case at either pad [N]."""
    friction, *_, internal = case_parts(case)
    return internal / ca.fmin(friction[0], friction[1])


def case_parts(case: ca.SX | ca.MX) -> list[ca.SX | ca.MX]:
    """The parts of a case (18,), see `CASE_SIZES`."""
    return list(ca.vertsplit(case, [0, *accumulate(CASE_SIZES.values())]))


def case_in_pad_axes(
    workcell: Workcell, motion: list[ca.SX], case: ca.SX
) -> tuple[ca.SX, ca.SX, tuple[ca.SX, ca.SX]]:
    """What a case asks of two pads with opposite normals, along the axes of contact 1: force and
    moment about the nominal centre of mass, (3,) each, and the displaced contacts' arms from there.

    Args:
        motion: pose, rate, second_rate (6,).
        case: (18,), see `CASE_SIZES`.
    """
    displacement = case_parts(case)[5]
    nominal = number(workcell.payload.centre_of_mass)
    axes = number(workcell.contacts[0].T_box_pad[:3, :3])
    arms = [
        ca.mtimes(axes.T, number(contact.T_box_pad[:3, 3]) - nominal)
        + ca.vertcat(displacement[2 * i : 2 * i + 2], 0.0)
        for i, contact in enumerate(workcell.contacts)
    ]
    in_box = case_load_function(workcell)(*motion, case, *sx_parameters(workcell.payload).values())
    force, moment = (ca.mtimes(axes.T, part) for part in in_box)
    return force, moment, (arms[0], arms[1])


def case_load_function(workcell: Workcell) -> ca.Function:
    """pose, rate, second_rate and a case to the force and the moment about the nominal centre of
    mass that the case asks for, (3,) each, box axes."""
    payload = workcell.payload
    inputs = [*_inputs(ca.SX, sx_parameters(payload)).values()]
    pose, rate, second, case, *_ = inputs
    _, _, mass, centre, disturbance, *_ = case_parts(case)
    nominal = number(payload.centre_of_mass)
    pushed = ca.vertcat(second[:3] + disturbance, second[3:])
    at_nominal = required(workcell, pose, rate, pushed, nominal)[3]
    rotation, *_, force, turning = required(workcell, pose, rate, pushed, centre)
    # About the nominal centre of mass; the true one's distance turns the force on a mass there.
    moment = turning + ca.cross(ca.mtimes(rotation, centre - nominal), at_nominal)
    share = mass / payload.mass
    parts = ca.cse([share * ca.mtimes(rotation.T, part) for part in (force, moment)])
    return ca.Function("case_load", inputs, parts)


# --- pads anywhere ---


def _to_command_of(
    squeeze: GraspSqueeze,
    load: ca.MX,
    case: ca.MX,
    handed: dict[str, ca.MX],
    differentiable: bool = False,
) -> ca.MX:
    """(2,) normal forces of pads anywhere to command [N] in a case whose load (6,) is known."""
    friction, *_, displacement, tracking, internal = case_parts(case)
    commanded, given = squeeze.commanded, list(handed.values())
    sizes = _sizes_function(squeeze)(case, *given)
    force = commanded_forces(squeeze, load, friction, sizes, displacement, handed, differentiable)
    needed = force[commanded] + internal * _against_internal(squeeze)(friction, sizes, *given)
    more = needed / (1.0 - tracking[commanded]) - force[commanded]
    normals = squeeze.normals
    shares = as_mx(normals / normals[commanded], squeeze.given, handed)
    # One entry after the other: a scalar times a vector repeats it by a form without lanes.
    force += ca.vertcat(*[more * shares[i] for i in (0, 1)])
    return force


def _sizes_function(squeeze: GraspSqueeze) -> ca.Function:
    """A case to the sizes (2,) of the robots' patches over the cell's own."""
    case = ca.SX.sym("case", CASE_SIZE)
    radius = case_parts(case)[1]
    own = [ca.SX(number(contact.patch_radius)) for contact in squeeze.workcell.contacts]
    share = radius / ca.vertcat(*own)
    return ca.Function("sizes", [case, *squeeze.given.values()], [share])


def case_origin_load_function(workcell: Workcell) -> ca.Function:
    """The load about the box frame's origin (6,), box axes."""
    inputs = [*_inputs(ca.SX, sx_parameters(workcell.payload)).values()]
    force, moment = case_load_function(workcell)(*inputs)
    about = moment + ca.cross(ca.SX(number(workcell.payload.centre_of_mass)), force)
    return ca.Function("origin_load", inputs, ca.cse([ca.vertcat(force, about)]))


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
        """See `symbolic.contact.central_path.Program`."""
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
        """See `symbolic.contact.central_path.Program`."""
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


def _against_internal(squeeze: GraspSqueeze) -> ca.Function:
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
