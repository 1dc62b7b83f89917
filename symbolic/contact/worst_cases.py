"""Least force that holds a moving payload in one case of an uncertainty.

A case states the true friction, mass, centre of mass, pad positions and disturbance. The payload's
inertia is taken about the nominal centre of mass and grows with the mass. So the required force and
moment are affine in the centre of mass and in the disturbance separately.

For opposite pads this is the least squeeze. For pads with any normals it is the least force of one
robot, a linear objective in the program of `symbolic.contact.grasp`. This force is commanded before
the case is known. An internal squeeze can be added to any wrenches that balance the load, so a
larger force holds the load too.

`ContactModel.command_model` is the contact model of commanded forces: arms that command a normal
force alone have pads that press evenly about their displaced places, whichever pads the plan
assumes.

The commanded force is larger than the least force: a share of it may be missing, and the arms may
push against each other. With N a pad's least normal force, e the missing share and T the tangential
force between the arms, it is (N + T / mu) / (1 - e). Friction cones are convex and contain (T / mu,
T), so N + T / mu holds for every direction of T. It is the least such force if the pad bears no
torsion and T acts along its load.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import Any

import casadi as ca

from symbolic.contact.force_closure import LOAD_SIZE
from symbolic.contact.grasp_squeeze import (
    GraspSqueeze,
    commanded_forces,
    commanded_slack,
    internal_force_gain,
)
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
"""Parts of a case and their sizes, in order: friction coefficients; radii of the patches [m]; mass
[kg]; centre of mass in the box frame [m]; acceleration beside the motion's, world frame [m/s^2];
displacements of both pads [m], along the tangents of contact 1, or along their own tangents for
pads with any normals; missing share of each robot's commanded normal force, zero for the leading
robot; tangential force between the arms [N]."""

SQUARED_SPEED_FLOOR = 1e-12
"""Floor of u'^2 [1/s^2]; its effect on a force is far below rounding."""

CASE_SIZE = sum(CASE_SIZES.values())

MOTION = ("pose", "rate", "second_rate")
"""Names of the inputs of a function of cases before the case itself."""


def case_squeeze_function(
    workcell: Workcell, commanded: int = 1, displaced: bool = True
) -> ca.Function:
    """Build the function of the least commanded normal forces in one case of an uncertainty.

    A case (18,) holds the true values of friction, patch radii, mass, centre of mass, disturbance,
    displacements of the pads, missing force and force between the arms, laid out by `CASE_SIZES`.

    Inputs: pose, rate, second_rate (6,), the box pose and its time derivatives; case (18,); then
    symbolic parameters. Output: normal_force (2,) [N]. With two opposite pads or holding hands,
    both forces are least. With other pads, the force of the robot `commanded` is least, and the
    other robot's force results from it.

    Args:
        workcell: the workcell.
        commanded: index of the robot whose force is commanded.
        displaced: True if cases may displace the pads, which takes longer for soft fingers.

    Raises:
        SettingsError: no internal squeeze exists.
    """
    squeeze, inputs = _program_and_inputs(workcell, commanded)
    force = _least_force(workcell, squeeze, inputs, displaced=displaced)
    return named_function("case_squeeze", inputs, {"normal_force": force}, cse=False)


def case_gradient_function(
    workcell: Workcell, commanded: int = 1, numbers: bool = False
) -> ca.Function:
    """Build the function of the least commanded normal forces in one case of an uncertainty, with
    their derivatives by the motion.

    Inputs and the output normal_force (2,) are those of `case_squeeze_function`. The output slope
    (NumPy shape (2, 18)) has the derivatives of each force by pose, rate and second_rate. For two
    opposite pads and for holding hands, the case must not displace the pads unless `numbers` is
    True.

    Args:
        workcell: the workcell.
        commanded: index of the robot whose force is commanded.
        numbers: True to append further columns to slope: the derivatives by the case (18,), then by
            the cell's symbolic parameters. For pads with any normals, the derivatives by the load
            (6,) of `case_origin_load_function` take the place of those by the parameters.
    """
    squeeze, inputs = _program_and_inputs(workcell, commanded)
    by = [*inputs.values()] if numbers else [inputs[name] for name in MOTION]
    if squeeze is None:
        implicit = ImplicitVariables()
        # Derivatives by the pads' places offset them laterally.
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
    """Build the function of the least commanded normal forces in one case of an uncertainty along a
    path, with derivatives by path and timing. The case must not displace the pads.

    Inputs: pose, first, second (6,), the box pose and its first and second derivative by u; a =
    u''; w = u'^2; case (18,), laid out by `CASE_SIZES`; then symbolic parameters. Outputs:
    normal_force (2,) [N], as in `case_squeeze_function`; slope (NumPy shape (2, 20)), the
    derivatives of each force by pose, first, second, a and w.
    """
    inputs = _inputs(ca.SX, sx_parameters(workcell.payload))
    path = {name: ca.SX.sym(name, 6) for name in ("pose", "first", "second")}
    path |= {"a": ca.SX.sym("a"), "w": ca.SX.sym("w")}
    pose, first, second, a, w = path.values()
    # u' has no derivative by u'^2 at rest; the floor bounds it.
    motion = (pose, first * ca.sqrt(w + SQUARED_SPEED_FLOOR), first * a + second * w)
    implicit, driven = ImplicitVariables(), inputs | dict(zip(MOTION, motion, strict=True))
    force = _least_force(workcell, None, driven, implicit)
    slope = ca.densify(ca.jacobian(force, ca.vertcat(*path.values())).T)
    found = implicit.replaced([force, slope])
    outputs = dict(zip(("normal_force", "slope"), found, strict=True))
    inputs = path | {name: inputs[name] for name in inputs if name not in MOTION}
    return named_function("case_slopes", inputs, outputs, cse=False)


def case_excess_function(workcell: Workcell) -> ca.Function:
    """Build the function of the constant part of robot 1's normal force in one case of the
    uncertainty.

    With a commanded force F of robot 2, the normal force of robot 1 is excess + share F. The share
    is `ContactModel.leading_share`, and excess the scalar output [N].

    Inputs: pose, rate, second_rate (6,), the box pose and its time derivatives; case (18,), laid
    out by `CASE_SIZES`; then the payload's symbolic parameters.
    """
    inputs = _inputs(ca.SX, sx_parameters(workcell.payload))
    load, opposed = case_contact_load(workcell, inputs), case_parts(inputs["case"])[-1]
    excess = command_model(workcell).leading_excess(load, opposed)
    return named_function("case_excess", inputs, {"excess": ca.cse([excess])[0]}, cse=False)


def case_slack_function(workcell: Workcell, commanded: int = 1) -> ca.Function:
    """Build a fast, sufficient test that a commanded force holds the payload in one case of an
    uncertainty.

    A positive result proves that the force holds the payload; otherwise only
    `case_squeeze_function` decides. The test takes a thirtieth of the time of that function.

    Inputs: pose, rate, second_rate (6,), the box pose and its time derivatives; case (18,), laid
    out by `CASE_SIZES`; force, the commanded normal force [N]; then symbolic parameters. Output:
    slack, a scalar.

    Args:
        workcell: the workcell.
        commanded: index of the robot whose force is commanded.
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
        left -= internal * internal_force_gain(squeeze)(friction, sizes, *numbers)
        slack = [commanded_slack(squeeze, load, friction, sizes, displacement, left)]
    else:
        slack = [force - _least_force(workcell, None, inputs)[commanded]]
    own = {name: inputs[name] for name in (*MOTION, "case")} | {"force": force} | given
    found = slack if squeeze is None else ca.cse(slack)
    return named_function("case_slack", own, {"slack": found[0]}, cse=False)


def _program_and_inputs(
    workcell: Workcell, commanded: int = 1
) -> tuple[GraspSqueeze | None, dict[str, Expression]]:
    """Return what functions of the least normal forces in one case of the uncertainty are built
    from: the convex program that computes the forces, and the symbols of the functions' inputs.

    Args:
        workcell: the cell.
        commanded: index of the robot whose force is commanded.

    Returns:
        The convex program for pads with any normals; None for two opposite pads and for hands,
        whose forces have formulas. Then the symbols by name: motion, case of the uncertainty,
        parameters.
    """
    if command_model(workcell).has_scalar_squeeze:
        return None, _inputs(ca.SX, sx_parameters(workcell.payload))
    squeeze = GraspSqueeze(workcell, commanded)
    return squeeze, _inputs(ca.MX, mx_symbols(squeeze.given))


def _inputs(kind: Any, given: Mapping[str, Expression]) -> dict[str, Expression]:
    """Return the input symbols of a function of one case of the uncertainty.

    They are, by name: pose (6,), the box pose [m, rad]; rate and second_rate (6,), its first and
    second derivative by time; case (18,), laid out by `CASE_SIZES`; then the parameters.

    Args:
        kind: CasADi type of the symbols, SX or MX.
        given: symbolic parameters of the cell by group.
    """
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
    """Build the expression of the least commanded normal forces (2,) of both robots [N] in one case
    of the uncertainty.

    Commanded with these forces, pads or hands hold the load of the case, although a share of each
    force is missing and the arms push against each other, both as the case states.
    With two opposite pads or hands, both forces are least. With `squeeze`, the force of the robot
    `squeeze.commanded` is least, and the other robot's force results from it.

    Args:
        workcell: the workcell.
        squeeze: convex program for pads with any normals; None for two pads with opposite normals
            and for hands.
        inputs: symbols by name: pose, rate, second_rate (6,), case (18,), and parameters by group.
        implicit: stores the results of Newton's method, so that derivatives of the forces become
            exact; None if no derivatives are needed.
        differentiable: True for exact first derivatives of the convex program's solution; False if
            only values are needed. It has no effect without `squeeze`.
        displaced: True if cases include displacements of the pads; only for opposite normals.
        beside: further force and moment (6,) that is added to the load of the case, about the box
            frame's origin [N, N m], for derivatives by the load; only with `squeeze`.
    """
    case = inputs["case"]
    friction, *_ = case_parts(case)
    if squeeze is not None:
        groups = {name: inputs[name] for name in squeeze.given}
        load = _origin_load(workcell, inputs)
        load = load if isinstance(beside, float) else load + beside
        return _commanded_by_program(squeeze, load, case, groups, differentiable)
    model, load = command_model(workcell), case_contact_load(workcell, inputs)
    *_, tracking, opposed = case_parts(case)
    held = model.hold(load, implicit, displaced)
    return ca.densify(model.commanded_forces(held.normal, friction, tracking, opposed))


def _origin_load(workcell: Workcell, inputs: dict[str, Expression]) -> Expression:
    names = (*MOTION, "case", *sx_parameters(workcell.payload))
    return case_origin_load_function(workcell)(*[inputs[name] for name in names])


def case_parts(case: ca.SX | ca.MX) -> list[ca.SX | ca.MX]:
    """Split a case of the uncertainty (18,) into its parts, such as friction (2,) and mass (1,), in
    the order of `CASE_SIZES`."""
    return list(ca.vertsplit(case, [0, *accumulate(CASE_SIZES.values())]))


def case_contact_load(workcell: Workcell, inputs: Mapping[str, Expression]) -> ContactLoad:
    """Compute the load on the contacts in one case of an uncertainty: force and moment about the
    nominal centre of mass, along the axes of contact 1.

    Args:
        workcell: the workcell.
        inputs: symbols by name: pose, rate, second_rate (6,), and case (18,) laid out by
            `CASE_SIZES`.
    """
    case = inputs["case"]
    friction, *_, displacement, _, _ = case_parts(case)
    nominal = number(workcell.payload.centre_of_mass)
    axes = number(workcell.contacts[0].T_box_pad[:3, :3])
    arms = [
        ca.mtimes(axes.T, number(contact.T_box_pad[:3, 3]) - nominal)
        + ca.vertcat(displacement[2 * i : 2 * i + 2], 0.0)
        for i, contact in enumerate(workcell.contacts)
    ]
    motion = [inputs[name] for name in MOTION]
    numbers = sx_parameters(workcell.payload).values()
    in_box = case_load_function(workcell)(*motion, case, *numbers)
    force, moment = (ca.mtimes(axes.T, part) for part in in_box)
    return ContactLoad(force, moment, (arms[0], arms[1]), ca.SX(ca.DM.eye(3)), friction)


def case_load_function(workcell: Workcell) -> ca.Function:
    """Build the function of the force and moment that the box motion requires in one case of an
    uncertainty.

    Inputs: pose, rate, second_rate (6,), the box pose and its time derivatives; case (18,), laid
    out by `CASE_SIZES`; then the payload's symbolic parameters. Outputs: force (3,) [N] and moment
    (3,) about the nominal centre of mass [N m], box axes.
    """
    payload = workcell.payload
    inputs = [*_inputs(ca.SX, sx_parameters(payload)).values()]
    pose, rate, second, case, *_ = inputs
    _, _, mass, centre, disturbance, *_ = case_parts(case)
    nominal = number(payload.centre_of_mass)
    pushed = ca.vertcat(second[:3] + disturbance, second[3:])
    at_nominal = required(workcell, pose, rate, pushed, nominal)[3]
    rotation, *_, force, turning = required(workcell, pose, rate, pushed, centre)
    # About the nominal centre of mass: the force on a mass there acts at the true one.
    moment = turning + ca.cross(ca.mtimes(rotation, centre - nominal), at_nominal)
    share = mass / payload.mass
    parts = ca.cse([share * ca.mtimes(rotation.T, part) for part in (force, moment)])
    return ca.Function("case_load", inputs, parts)


# --- pads with any normals ---


def _commanded_by_program(
    squeeze: GraspSqueeze,
    load: ca.MX,
    case: ca.MX,
    groups: dict[str, ca.MX],
    differentiable: bool = False,
) -> ca.MX:
    """Build the expression of the normal forces (2,) of both robots [N] for pads with any normals:
    the least force to command to one robot in one case of the uncertainty, and the other robot's
    force that results from it. They hold the load although a share of the commanded force is
    missing and the arms push against each other, both as the case states.

    Args:
        squeeze: convex program of the least commanded force, which knows the commanded robot.
        load: (6,) force and moment about the box frame's origin, along the box's axes [N, N m].
        case: (18,) case of the uncertainty, laid out by `CASE_SIZES`.
        groups: MX vectors of the cell's parameters, by name of the parameter group.
        differentiable: True for exact first derivatives; False if only values are needed, because
            derivatives of the expression are then not exact.
    """
    friction, *_, displacement, tracking, internal = case_parts(case)
    commanded, given = squeeze.commanded, list(groups.values())
    sizes = _sizes_function(squeeze)(case, *given)
    force = commanded_forces(squeeze, load, friction, sizes, displacement, groups, differentiable)
    needed = force[commanded] + internal * internal_force_gain(squeeze)(friction, sizes, *given)
    more = needed / (1.0 - tracking[commanded]) - force[commanded]
    normals = squeeze.normals
    shares = as_mx(normals / normals[commanded], squeeze.given, groups)
    # Entry by entry: CasADi repeats a scalar times a vector by an operation without lanes.
    force += ca.vertcat(*[more * shares[i] for i in (0, 1)])
    return force


def _sizes_function(squeeze: GraspSqueeze) -> ca.Function:
    """Build the function from a case (18,) of the uncertainty to the patch sizes (2,) of both
    robots: the patch radius in this case over the radius that the cell states."""
    case = ca.SX.sym("case", CASE_SIZE)
    radius = case_parts(case)[1]
    own = [ca.SX(number(contact.patch_radius)) for contact in squeeze.workcell.contacts]
    share = radius / ca.vertcat(*own)
    return ca.Function("sizes", [case, *squeeze.given.values()], [share])


def case_origin_load_function(workcell: Workcell) -> ca.Function:
    """Build the function of the load that the pads have to balance in one case of an uncertainty.

    Inputs: pose, rate, second_rate (6,), the box pose and its time derivatives; case (18,), laid
    out by `CASE_SIZES`; then the payload's symbolic parameters. Output: force and moment (6,) about
    the box frame's origin, along the box's axes [N, N m].
    """
    inputs = [*_inputs(ca.SX, sx_parameters(workcell.payload)).values()]
    force, moment = case_load_function(workcell)(*inputs)
    about = moment + ca.cross(ca.SX(number(workcell.payload.centre_of_mass)), force)
    return ca.Function("origin_load", inputs, ca.cse([ca.vertcat(force, about)]))
