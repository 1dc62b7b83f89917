"""The payload's part of the smooth problem: forces at every sample with exact derivatives.

All normal forces are the largest of functions that are linear in the normal component F_n and
the tangential magnitude F_t of the required force (`contact_forces.normal_force_branches`), so
that these two, and not the kinked forces, are differentiated.

With the constant-speed law the motion at a sample depends on a window of five neighbouring
samples alone (two finite differences). One small function serves all inner samples, its window's
basis rows being an argument; the first two and the last two samples, with their one-sided
differences, have one function per end. Any other time law is differentiated as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from symbolic.contact_forces import split_force
from symbolic.path import PathBasis, sample_basis, waypoint_matrix
from symbolic.payload_load import resultant_force
from symbolic.rotation import angular_acceleration, angular_velocity, rotation_matrix
from symbolic.time_law import timed_path
from symbolic.workcell import Array, Task, Workcell

WINDOW = 5
"""Samples that the motion at one of them depends on with the constant-speed law."""


@dataclass(frozen=True)
class ForceBlock:
    """Samples that share one function.

    Attributes:
        name: prefix of its functions' names, see `force_functions`.
        samples: (calls, k) the k samples that each call serves.
        basis: (calls, width, n_waypoints) basis rows of each call's window.
    """

    name: str
    samples: NDArray[np.int64]
    basis: Array


def force_blocks(task: Task) -> tuple[ForceBlock, ...]:
    """How the task's samples are divided among functions."""
    n, position = task.samples, sample_basis(task).position
    if task.time_law != "constant":
        return (ForceBlock("force_path", np.arange(n)[None, :], position[None]),)
    inner = np.arange(2, n - 2)
    windows = np.array([position[k - 2 : k + 3] for k in inner])
    return (
        ForceBlock("force_inner", inner[:, None], windows),
        ForceBlock("force_first", np.array([[0, 1]]), position[None, :WINDOW]),
        ForceBlock("force_last", np.array([[n - 2, n - 1]]), position[None, -WINDOW:]),
    )


def force_functions(workcell: Workcell) -> dict[str, ca.Function]:
    """Values and derivatives of F_n and F_t [N] of every block of `force_blocks`, by name.

    For a block that serves k samples, with x (n_var,) and basis (width, n_waypoints) of the
    window, the last without effect where the block is the whole path:

    NAME_value: x, basis -> split (2 k,) = F_n, F_t of the first sample, of the second, ...
    NAME_gradient: x, basis -> gradient (n_var, 2 k), one column for each entry of split.
    NAME_hessian: x, basis, weight (2 k,) -> hessian (n_var, n_var) of weight . split.
    """
    task = workcell.task
    if task.time_law != "constant":
        return _whole_path(workcell)
    columns = {"force_inner": (2,), "force_first": (0, 1), "force_last": (3, 4)}
    functions: dict[str, ca.Function] = {}
    for name, chosen in columns.items():
        functions |= _window_functions(workcell, chosen, name)
    return functions


def _window_functions(
    workcell: Workcell, columns: tuple[int, ...], name: str
) -> dict[str, ca.Function]:
    task = workcell.task
    n_waypoints = len(task.waypoints)
    x, basis = ca.MX.sym("x", task.n_var), ca.MX.sym("basis", n_waypoints, WINDOW)
    # The window's poses are handed to the time law as waypoints of an identity basis.
    identity = np.eye(WINDOW)
    window = ca.mtimes(waypoint_matrix(task, x), basis)
    own = PathBasis(np.linspace(0.0, 1.0, WINDOW), identity, identity, identity)
    split = _split(workcell, own, window, columns)
    flat = ca.Function("split", [x, basis], [split]).expand()
    inputs = [ca.SX.sym("x", task.n_var), ca.SX.sym("basis", n_waypoints, WINDOW)]
    return _derivatives(flat(*inputs), inputs, name)


def _whole_path(workcell: Workcell) -> dict[str, ca.Function]:
    task = workcell.task
    x, unused = ca.MX.sym("x", task.n_var), ca.MX.sym("basis", len(task.waypoints), task.samples)
    split = _split(
        workcell, sample_basis(task), waypoint_matrix(task, x), tuple(range(task.samples))
    )
    return _derivatives(split, [x, unused], "force_path")


def _split(
    workcell: Workcell, basis: PathBasis, waypoints: ca.MX, columns: tuple[int, ...]
) -> ca.MX:
    """F_n and F_t (2 k,) at the chosen columns of the timed path."""
    path = timed_path(workcell.task, basis, waypoints)
    sample = _sample_function(workcell).map(len(columns))
    chosen = list(columns)
    return ca.vec(sample(path.pose[:, chosen], path.rate[:, chosen], path.second_rate[:, chosen]))


def _sample_function(workcell: Workcell) -> ca.Function:
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
    split: ca.SX | ca.MX, inputs: list[ca.SX | ca.MX], name: str
) -> dict[str, ca.Function]:
    x, basis = inputs
    weight = type(x).sym("weight", split.shape[0])
    hessian, _ = ca.hessian(ca.dot(weight, split), x)
    outputs = {
        "value": ([x, basis], ["x", "basis"], [split], ["split"]),
        "gradient": ([x, basis], ["x", "basis"], [ca.jacobian(split, x).T], ["gradient"]),
        "hessian": ([x, basis, weight], ["x", "basis", "weight"], [hessian], ["hessian"]),
    }
    return {
        f"{name}_{kind}": ca.Function(
            f"{name}_{kind}", given, ca.cse([ca.densify(r) for r in results]), names_in, names_out
        )
        for kind, (given, names_in, results, names_out) in outputs.items()
    }
