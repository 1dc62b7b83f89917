"""The payload's part of the smooth problem: what samples ask, with exact derivatives.

All normal forces are the largest of functions that are linear in the normal component F_n and
the tangential magnitude F_t of the required force (`contact_forces.normal_force_branches`), so
that these two, and not the kinked forces, are differentiated. How much of each patch the shift of
the centre of pressure leaves is differentiated as it is: its kinks are those of the forces.

With the constant-speed law the motion at a sample depends on a window of five neighbouring
samples alone (two finite differences). One small function serves all inner samples, its window's
basis rows being an argument; the first two and the last two samples, with their one-sided
differences, have one function per end. Any other time law is differentiated as a whole.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.physics.contact_forces import split_force
from symbolic.physics.path import PathBasis, sample_basis, waypoint_matrix
from symbolic.physics.payload_load import LOAD_OUTPUTS, paper_load_function, resultant_force
from symbolic.physics.rotation import angular_acceleration, angular_velocity, rotation_matrix
from symbolic.physics.time_law import timed_path
from symbolic.workcell.records import Task, Workcell

WINDOW = 5
"""Samples that the motion at one of them depends on with the constant-speed law."""


@dataclass(frozen=True)
class SampleBlock:
    """Samples that share one function.

    Attributes:
        name: part of its functions' names, see `force_functions`.
        samples: (calls, k) the k samples that each call serves.
        basis: (calls, width, n_waypoints) basis rows of each call's window.
    """

    name: str
    samples: NDArray[np.int64]
    basis: Array


def sample_blocks(task: Task, wanted: Collection[int] | None = None) -> tuple[SampleBlock, ...]:
    """How the task's samples are divided among functions.

    Args:
        wanted: samples without which a call is left out; None for all.
    """
    n, position = task.samples, sample_basis(task).position
    if task.time_law != "constant":
        every = [SampleBlock("path", np.arange(n)[None, :], position[None])]
    else:
        inner = np.arange(2, n - 2)
        windows = np.array([position[k - 2 : k + 3] for k in inner])
        every = [
            SampleBlock("inner", inner[:, None], windows),
            SampleBlock("first", np.array([[0, 1]]), position[None, :WINDOW]),
            SampleBlock("last", np.array([[n - 2, n - 1]]), position[None, -WINDOW:]),
        ]
    if wanted is None:
        return tuple(every)
    chosen = [np.isin(block.samples, list(wanted)).any(axis=1) for block in every]
    return tuple(
        SampleBlock(block.name, block.samples[calls], block.basis[calls])
        for block, calls in zip(every, chosen, strict=True)
        if calls.any()
    )


def force_functions(workcell: Workcell) -> dict[str, ca.Function]:
    """Values and derivatives of F_n and F_t [N] of every block of `sample_blocks`, by name.

    For a block that serves k samples, with x (n_var,) and basis (width, n_waypoints) of the
    window, the last without effect where the block is the whole path:

    force_NAME_value: x, basis -> (2 k,) = F_n, F_t of the first sample, of the second, ...
    force_NAME_gradient: x, basis -> (n_var, 2 k), one column for each entry of the value.
    force_NAME_hessian: x, basis, weight (2 k,) -> (n_var, n_var) of weight . value.
    """
    return _sample_functions(workcell, "force", _split_function(workcell))


def pressure_functions(workcell: Workcell) -> dict[str, ca.Function]:
    """Values and derivatives of what the shifts of the centres of pressure leave of the patches.

    As `force_functions`, with names that begin with `pressure` and 1 - (shift / patch radius)^2 of
    contacts 1 and 2 in place of F_n and F_t.
    """
    return _sample_functions(workcell, "pressure", _margin_function(workcell))


def _sample_functions(
    workcell: Workcell, quantity: str, sample: ca.Function
) -> dict[str, ca.Function]:
    """The functions of all blocks for a function of pose, rate and second_rate of one sample."""
    if workcell.task.time_law != "constant":
        return _whole_path(workcell, quantity, sample)
    columns = {"inner": (2,), "first": (0, 1), "last": (3, 4)}
    functions: dict[str, ca.Function] = {}
    for name, chosen in columns.items():
        functions |= _window_functions(workcell, sample, chosen, f"{quantity}_{name}")
    return functions


def _window_functions(
    workcell: Workcell, sample: ca.Function, columns: tuple[int, ...], name: str
) -> dict[str, ca.Function]:
    task = workcell.task
    n_waypoints = len(task.waypoints)
    x, basis = ca.MX.sym("x", task.n_var), ca.MX.sym("basis", n_waypoints, WINDOW)
    # The window's poses are handed to the time law as waypoints of an identity basis.
    identity = np.eye(WINDOW)
    window = ca.mtimes(waypoint_matrix(task, x), basis)
    own = PathBasis(np.linspace(0.0, 1.0, WINDOW), identity, identity, identity)
    values = _values(workcell, sample, own, window, columns)
    flat = ca.Function("values", [x, basis], [values]).expand()
    inputs = [ca.SX.sym("x", task.n_var), ca.SX.sym("basis", n_waypoints, WINDOW)]
    return _derivatives(flat(*inputs), inputs, name)


def _whole_path(workcell: Workcell, quantity: str, sample: ca.Function) -> dict[str, ca.Function]:
    task = workcell.task
    x, unused = ca.MX.sym("x", task.n_var), ca.MX.sym("basis", len(task.waypoints), task.samples)
    every = tuple(range(task.samples))
    values = _values(workcell, sample, sample_basis(task), waypoint_matrix(task, x), every)
    return _derivatives(values, [x, unused], f"{quantity}_path")


def _values(
    workcell: Workcell,
    sample: ca.Function,
    basis: PathBasis,
    waypoints: ca.MX,
    columns: tuple[int, ...],
) -> ca.MX:
    """A sample's two values (2 k,) at the chosen columns of the timed path."""
    path = timed_path(workcell.task, basis, waypoints)
    at = list(columns)
    each = sample.map(len(at))
    return ca.vec(each(path.pose[:, at], path.rate[:, at], path.second_rate[:, at]))


def _margin_function(workcell: Workcell) -> ca.Function:
    """pose, rate, second_rate (6,) of a sample to 1 - (shift / patch radius)^2 (2,)."""
    motion = [ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate")]
    friction = ca.DM([contact.friction for contact in workcell.contacts])
    # Where the patches suffice the joint allocation is the paper's, so that these rows keep to it.
    load = paper_load_function(workcell)(*motion, friction, workcell.payload.centre_of_mass)
    shift = load[LOAD_OUTPUTS.index("pressure_shift")]
    radius = ca.DM([contact.patch_radius for contact in workcell.contacts])
    return ca.Function("sample_margin", motion, [1.0 - (shift / radius) ** 2])


def _split_function(workcell: Workcell) -> ca.Function:
    """pose, rate, second_rate (6,) of a sample to F_n, F_t (2,)."""
    pose, rate, second = (ca.SX.sym(name, 6) for name in ("pose", "rate", "second_rate"))
    rotation = rotation_matrix(pose[3:])
    force = resultant_force(
        workcell.payload.mass,
        ca.mtimes(rotation, ca.DM(workcell.payload.centre_of_mass)),
        angular_velocity(pose[3:], rate[3:]),
        angular_acceleration(pose[3:], rate[3:], second[3:]),
        second[:3],
    )
    normal = ca.mtimes(rotation, ca.DM(workcell.contacts[0].T_box_pad[:3, 2]))
    f_n, f_t, _ = split_force(force, normal)
    return ca.Function("sample_split", [pose, rate, second], [ca.vertcat(f_n, f_t)])


def _derivatives(
    values: ca.SX | ca.MX, inputs: list[ca.SX | ca.MX], name: str
) -> dict[str, ca.Function]:
    x, basis = inputs
    weight = type(x).sym("weight", values.shape[0])
    hessian, _ = ca.hessian(ca.dot(weight, values), x)
    outputs = {
        "value": ([x, basis], ["x", "basis"], [values], ["values"]),
        "gradient": ([x, basis], ["x", "basis"], [ca.jacobian(values, x).T], ["gradient"]),
        "hessian": ([x, basis, weight], ["x", "basis", "weight"], [hessian], ["hessian"]),
    }
    return {
        f"{name}_{kind}": ca.Function(
            f"{name}_{kind}", given, ca.cse([ca.densify(r) for r in results]), names_in, names_out
        )
        for kind, (given, names_in, results, names_out) in outputs.items()
    }
