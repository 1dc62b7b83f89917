"""Forces and pressure at samples, with exact derivatives.

In the paper's model each normal force is the largest of several linear functions of the normal
component F_n and the tangential magnitude F_t of the required force
(`symbolic.contact.paper.normal_force_branches`). So F_n and F_t are differentiated, and not the
kinked forces. Forces of soft fingers are smooth and are differentiated themselves. The remaining
share of each patch is differentiated directly: its kinks are those of the forces. If a program
computes the forces, the load is differentiated here, and the forces by the load in
`grasp_force_functions`.

With the constant-speed law the motion at a sample depends only on a window of five neighbouring
samples (two finite differences). One small function serves all inner samples and takes the basis
rows of its window as an argument. The first two and the last two samples have one-sided differences
and one function per end. Other time laws are differentiated as a whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.contact.grasp import Grasp
from symbolic.contact.load import frictions, required
from symbolic.contact.model import ContactLoad
from symbolic.contact.registry import contact_model
from symbolic.contact.soft_grasp import SoftGrasp
from symbolic.expression import (
    mx_parameters,
    named_function,
    number,
    select_parameters,
    sx_parameters,
    tile,
)
from symbolic.path.spline import PathBasis, sample_basis, waypoint_matrix
from symbolic.path.time_law import timed_path
from symbolic.records.cell import Workcell
from symbolic.records.task import Task
from symbolic.smooth.path_points import ORDERS, Order

Quantity = Literal["force", "pressure", "load"]
"""'force': quantities from which the normal forces follow (`ContactModel.force_quantities`) [N].
'pressure': 1 - (shift / patch radius)^2 of contacts 1 and 2. 'load': force and moment about the box
frame's origin, along the box's axes [N, N m]."""

QUANTITY_WIDTHS: Mapping[Quantity, int] = {"force": 2, "pressure": 2, "load": 6}
"""Number of values per sample, by quantity."""

Block = Literal["inner", "first", "last", "path"]
"""'inner': inner samples, one per call. 'first', 'last': the first two and the last two samples.
'path': all samples together, for other time laws."""

SAMPLE_BARRIER_WEIGHT = 1e-4
"""Weight of the program's barriers in `symbolic.contact.soft_grasp`. Forces exceed the least forces
by a share of about this times the number of active constraints; the polish corrects this at every
iterate."""

INPUTS = ("x", "basis", "rounding")
"""Names of the inputs of every function of samples."""

MOTION_INPUTS = ("pose", "rate", "second_rate")
"""Names of the inputs that describe the motion of the box at a sample, (6,) each."""

DIFFERENCE_WINDOW = 5
"""Number of samples on which the motion at one sample depends with the constant-speed law."""


def sample_name(quantity: Quantity, block: Block, order: Order) -> str:
    """Return the name of the function that `sample_functions` builds for a quantity and a block of
    samples.

    Args:
        quantity: 'force', 'pressure' or 'load'.
        block: name of the block, as in `SampleBlock`.
        order: 'first' or 'second', the order of the derivatives.
    """
    return f"{quantity}_{block}_{order}"


def grasp_force_name(order: Order) -> str:
    """Return the name of the function that `grasp_force_functions` builds for the order 'first' or
    'second'."""
    return f"held_{order}"


@dataclass(frozen=True)
class SampleBlock:
    """Samples that are evaluated by calls of one function.

    Attributes:
        block: name of the block.
        samples: (calls, k) indices of the k samples that each call evaluates.
        basis: (calls, width, n_waypoints) for each call the matrix from waypoints to the poses of
            the call's window of samples.
    """

    block: Block
    samples: NDArray[np.int64]
    basis: Array


def sample_blocks(task: Task) -> tuple[SampleBlock, ...]:
    """Divide the samples of a task into blocks whose samples depend in the same way on their
    neighbours. One function serves all samples of a block.

    With a time law by finite differences, these are the samples inside, the first two and the last
    two. With any other law, one block contains all samples.
    """
    n, position = task.samples, sample_basis(task).position
    if not task.law.has_differences:
        return (SampleBlock("path", np.arange(n)[None, :], position[None]),)
    inner = np.arange(2, n - 2)
    windows = np.array([position[k - 2 : k + 3] for k in inner]).reshape(
        -1, DIFFERENCE_WINDOW, position.shape[1]
    )
    return (
        SampleBlock("inner", inner[:, None], windows),
        SampleBlock("first", np.array([[0, 1]]), position[None, :DIFFERENCE_WINDOW]),
        SampleBlock("last", np.array([[n - 2, n - 1]]), position[None, -DIFFERENCE_WINDOW:]),
    )


def sample_functions(workcell: Workcell, quantity: Quantity) -> dict[str, ca.Function]:
    """Build the functions of a quantity at samples and of its derivatives by the decision vector,
    for every block of `sample_blocks`, by name. A sample has w = QUANTITY_WIDTHS[quantity] values.

    Inputs for a block of k samples: x (n_var,), the decision vector; basis (n_waypoints, width),
    the transposed matrix of `SampleBlock.basis`; rounding, the scalar of `timed_path`; then the
    cell's symbolic parameters. In the block 'path' basis and rounding have no effect.

    - first returns values (w k,), sample by sample, and gradient (n_var, w k), one column per
      value.
    - second takes two more inputs: weight (w k,), a factor on each value, and along (n_var,), a
      direction. It returns curvature (n_var,): the Hessian of the weighted sum of the values, times
      the direction. One direction per call makes the code ten times shorter than a whole Hessian,
      so that it stays in the processor's cache.

    Args:
        workcell: the cell.
        quantity: 'force', 'pressure' or 'load'.
    """
    makers = {"force": _force_function, "pressure": _margin_function, "load": _load_function}
    sample = makers[quantity](workcell)
    if not workcell.task.law.has_differences:
        return _whole_path(workcell, quantity, sample)
    columns: dict[Block, tuple[int, ...]] = {"inner": (2,), "first": (0, 1), "last": (3, 4)}
    functions: dict[str, ca.Function] = {}
    for block, chosen in columns.items():
        functions |= _window_functions(workcell, sample, chosen, quantity, block)
    return functions


def grasp_force_functions(
    workcell: Workcell, weight: float = SAMPLE_BARRIER_WEIGHT
) -> dict[str, ca.Function]:
    """Build the functions of normal forces that a convex program computes, by name. With a positive
    weight of the barriers the forces are smooth functions of the load.

    first: takes load (6,), force [N] and moment [N m] about the box frame's origin. It returns
    normal (2,), normal forces of the robots [N]; slope (6, 2), their derivatives by the load; and
    state (n,), an input of second.

    second: takes state and weight (2,), one number per normal force. It returns curvature (6, 6),
    the Hessian by the load of the weighted sum of the normal forces.

    Args:
        workcell: cell with the pads.
        weight: weight of the barriers over the effort (`symbolic.contact.soft_grasp`).

    Raises:
        SettingsError: the pads do not close their grasp.
    """
    soft = SoftGrasp(Grasp(workcell), weight)
    return {grasp_force_name("first"): soft.first(), grasp_force_name("second"): soft.second()}


def motion_function(task: Task) -> ca.Function:
    """Build the function of the box motion at all n samples and its derivatives by the decision
    vector, with the time law `constant` or `ramped`.

    Input: x (n_var,), the decision vector. Outputs (NumPy shapes): motion (n, 18), at each sample
    the box pose (6,) [m, rad] and its first [m/s, rad/s] and second [m/s^2, rad/s^2] derivative by
    time; slope (18 n, n_var), the derivatives of the entries of motion by x, sample by sample.

    Args:
        task: task of the cell.
    """
    x = ca.MX.sym("x", task.n_var)
    path = timed_path(task, sample_basis(task), waypoint_matrix(task, x))
    motion = ca.vertcat(path.pose, path.rate, path.second_rate)
    flat = ca.Function("motion_values", [x], [motion]).expand()
    y = ca.SX.sym("x", task.n_var)
    value = flat(y)
    slope = ca.densify(ca.jacobian(ca.vec(value), y).T)
    return ca.Function("motion", [y], [value, slope], ["x"], ["motion", "slope"])


def _window_functions(
    workcell: Workcell,
    sample: ca.Function,
    columns: tuple[int, ...],
    quantity: Quantity,
    block: Block,
) -> dict[str, ca.Function]:
    task = workcell.task
    n_waypoints = len(task.waypoints)
    x, basis = ca.MX.sym("x", task.n_var), ca.MX.sym("basis", n_waypoints, DIFFERENCE_WINDOW)
    rounding, groups = ca.MX.sym("rounding"), mx_parameters(task, workcell.payload)
    # The window's poses are handed to the time law as waypoints of an identity basis.
    identity = np.eye(DIFFERENCE_WINDOW)
    window = ca.mtimes(waypoint_matrix(task, x, select_parameters(groups, task)), basis)
    own = PathBasis(np.linspace(0.0, 1.0, DIFFERENCE_WINDOW), identity, identity, identity)
    wrench = _wrench_function(workcell)
    wrenches = _at_samples(workcell, wrench, (own, window, rounding), columns, groups)
    flat = ca.Function("wrenches", [x, basis, rounding, *groups.values()], [wrenches]).expand()
    inputs = [ca.SX.sym(name, *flat.size_in(k)) for k, name in enumerate(INPUTS)]
    given = sx_parameters(task, workcell.payload)
    wrenches, held = flat(*inputs, *given.values()), sx_parameters(workcell.payload).values()
    each = [sample(wrenches[k : k + 6], *held) for k in range(0, wrenches.numel(), 6)]
    return _functions(ca.vertcat(*each), inputs, given, quantity, block)


def _whole_path(
    workcell: Workcell, quantity: Quantity, sample: ca.Function
) -> dict[str, ca.Function]:
    task = workcell.task
    x, unused = ca.MX.sym("x", task.n_var), ca.MX.sym("basis", len(task.waypoints), task.samples)
    rounding, groups = ca.MX.sym("rounding"), mx_parameters(task, workcell.payload)
    every, wrench = tuple(range(task.samples)), _wrench_function(workcell)
    motion = [ca.SX.sym(name, 6) for name in MOTION_INPUTS]
    held = sx_parameters(workcell.payload).values()
    whole = ca.Function("sample", [*motion, *held], [sample(wrench(*motion, *held), *held)])
    waypoints = waypoint_matrix(task, x, select_parameters(groups, task))
    values = _at_samples(workcell, whole, (sample_basis(task), waypoints, None), every, groups)
    return _functions(values, [x, unused, rounding], groups, quantity, "path")


def _at_samples(
    workcell: Workcell,
    of_motion: ca.Function,
    along: tuple[PathBasis, ca.MX, ca.MX | None],
    columns: tuple[int, ...],
    groups: dict[str, ca.MX],
) -> ca.MX:
    """Build the expression of a quantity at chosen samples of a path, as one column.

    Args:
        workcell: the cell.
        of_motion: function of one sample that computes the quantity. Its inputs are pose, rate and
            second_rate (6,), the box pose and its time derivatives, and the payload's parameters.
        along: arguments of `timed_path`: spline basis, waypoints (6, n_waypoints), and relative
            width of the rounding, None for none.
        columns: indices of the chosen samples among those of the basis.
        groups: MX vectors of the parameters of task and payload, by name of the parameter group.
    """
    path, at = (
        timed_path(workcell.task, *along, select_parameters(groups, workcell.task)),
        list(columns),
    )
    held = tile(select_parameters(groups, workcell.payload), len(at))
    each = of_motion.map(len(at))
    return ca.vec(each(path.pose[:, at], path.rate[:, at], path.second_rate[:, at], *held))


def _wrench_function(workcell: Workcell) -> ca.Function:
    """Build the function of the force and moment that the box motion requires at one sample, along
    the box's axes.

    Inputs: pose, rate, second_rate (6,), the box pose [m, rad] and its first and second time
    derivative; then the payload's symbolic parameters. Output (6,): required force [N], then
    required moment about the centre of mass [N m].
    """
    payload = workcell.payload
    pose, rate, second = motion = [ca.SX.sym(name, 6) for name in MOTION_INPUTS]
    centre = number(payload.centre_of_mass)
    rotation, *_, force, moment = required(workcell, pose, rate, second, centre)
    wrench = ca.vertcat(ca.mtimes(rotation.T, force), ca.mtimes(rotation.T, moment))
    return ca.Function("sample_wrench", [*motion, *sx_parameters(payload).values()], [wrench])


def _margin_function(workcell: Workcell) -> ca.Function:
    """Build the function of the margins of both centres of pressure.

    Inputs: required force [N] and moment [N m] about the centre of mass, (6,), along the box's
    axes; then the payload's symbolic parameters. Output (2,): 1 - (shift / patch radius)^2 for each
    contact.
    """
    wrench, contacts = ca.SX.sym("wrench", 6), workcell.contacts
    shift = contact_model(workcell).hold(_contact_load(workcell, wrench))
    squares = ca.vertcat(*map(ca.sumsqr, shift.shifts))
    radius = ca.vertcat(*[ca.SX(number(contact.patch_radius)) for contact in contacts])
    given = sx_parameters(workcell.payload).values()
    return ca.Function("sample_margin", [wrench, *given], [1.0 - squares / radius**2])


def _load_function(workcell: Workcell) -> ca.Function:
    """Build the function that moves the reference point of a load to the box frame's origin.

    Inputs: required force [N] and moment [N m] about the centre of mass, (6,), along the box's
    axes; then the payload's symbolic parameters. Output (6,): the force, then the moment about the
    box frame's origin, along the same axes.
    """
    wrench, centre = ca.SX.sym("wrench", 6), number(workcell.payload.centre_of_mass)
    about = wrench[3:] + ca.cross(ca.SX(centre), wrench[:3])
    given = sx_parameters(workcell.payload).values()
    return ca.Function("sample_load", [wrench, *given], [ca.vertcat(wrench[:3], about)])


def _force_function(workcell: Workcell) -> ca.Function:
    """Build the function of the two quantities `ContactModel.force_quantities`, from which the
    normal forces follow.

    Inputs: required force [N] and moment [N m] about the centre of mass, (6,), along the box's
    axes; then the payload's symbolic parameters. Output: the quantities (2,) [N].
    """
    wrench, model = ca.SX.sym("wrench", 6), contact_model(workcell)
    load = _contact_load(workcell, wrench)
    quantities = model.force_quantities(load, model.hold(load))
    given = sx_parameters(workcell.payload).values()
    return ca.Function("sample_split", [wrench, *given], [quantities])


def _contact_load(workcell: Workcell, wrench: ca.SX) -> ContactLoad:
    """Return the load on the contacts, with all vectors along the box's axes.

    Args:
        workcell: the cell.
        wrench: (6,) required force [N], then required moment about the centre of mass [N m], box
            axes.
    """
    contacts, centre = workcell.contacts, workcell.payload.centre_of_mass
    first, second = (ca.SX(number(c.T_box_pad[:3, 3] - centre)) for c in contacts)
    axes = ca.SX(number(contacts[0].T_box_pad[:3, :3]))
    return ContactLoad(wrench[:3], wrench[3:], (first, second), axes, frictions(workcell))


def _functions(
    values: ca.SX | ca.MX,
    inputs: list[ca.SX | ca.MX],
    given: Mapping[str, ca.SX | ca.MX],
    quantity: Quantity,
    block: Block,
) -> dict[str, ca.Function]:
    first, second = (sample_name(quantity, block, order) for order in ORDERS)
    x, symbols = inputs[0], type(inputs[0])
    weight, along = symbols.sym("weight", values.numel()), symbols.sym("along", x.numel())
    gradient = ca.jacobian(values, x).T
    curvature = ca.jtimes(ca.gradient(ca.dot(weight, values), x), x, along)
    outputs = {"values": ca.densify(values), "gradient": ca.densify(gradient)}
    bent, own = {"curvature": ca.densify(curvature)}, dict(zip(INPUTS, inputs, strict=True))
    bending = {**own, "weight": weight, "along": along, **given}
    return {
        first: named_function(first, {**own, **given}, outputs),
        second: named_function(second, bending, bent),
    }
