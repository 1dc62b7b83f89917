"""The general allocation as a semidefinite program for clarabel, and grasps to try it on."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import clarabel
import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.contact.force_closure import has_force_closure
from symbolic.contact.grasp import Grasp, grasp_wrenches
from symbolic.records import Contact, Workcell
from tests.symbolic.contact.joint_oracle import cross_matrix, scaled_triangle

TOLERANCES = (1e-11, 1e-10, 1e-9)
"""Of clarabel; the next one where it makes no progress."""

SOLVED = ("Solved", "AlmostSolved")


def least_wrenches(
    pads: tuple[Contact, ...], load: Array, normal_weights: Array | None = None
) -> Array:
    """(k, 6) forces and moments about the pads' centres, in their own axes, of least effort.

    Args:
        load: (6,) force and moment about the box frame's origin, box axes.
        normal_weights: (k,) for the least sum of so weighted normal forces in place of the effort.

    Raises:
        AssertionError: what the solver says does not hold.
    """
    size = float(np.linalg.norm(load[:3]) + 10.0 * np.linalg.norm(load[3:]))
    # Forces may be a thousand times the load, where pads hardly close their grasp.
    weights = normal_weights
    tries = (_solve(pads, load, size * f, weights) for f in (1.0, 10.0, 100.0, 1000.0))
    rough = next(found for found in tries if found is not None)
    found = _solve(pads, load, float(np.abs(rough[:, :3]).max()), weights)
    assert found is not None
    return found


def _solve(
    pads: tuple[Contact, ...], load: Array, size: float, normal_weights: Array | None
) -> Array | None:
    """The same from a program whose unknowns are about one if forces are about `size`; None where
    the solver gives up."""
    blocks: list[Array] = []
    rows: list[Array] = []
    cones = []
    count = sum(12 if pad.half_sides else 7 for pad in pads)
    total, at = np.zeros((6, count)), 0
    squares = np.zeros((count, count))
    for pad in pads:
        n = 12 if pad.half_sides else 7
        # A disc's moments in units of its radius, so that all unknowns are about as large.
        unit = np.diag([1.0, 1.0, 1.0, *[pad.patch_radius] * 3])
        wrench = _corner_wrench(pad) if pad.half_sides else unit @ np.eye(6, 7)
        own = np.zeros((6, count))
        own[:, at : at + n] = wrench
        blocks.append(own)
        total += in_box(pad) @ own
        squares += own[:3].T @ own[:3]
        if pad.half_sides:
            for corner in range(4):
                local = np.zeros((3, count))
                local[0, at + 3 * corner + 2] = pad.friction
                local[1, at + 3 * corner] = local[2, at + 3 * corner + 1] = 1.0
                rows.append(-local)
                cones.append(clarabel.SecondOrderConeT(3))
        else:
            local = np.zeros((21, count))
            local[:, at : at + n] = np.column_stack([_matrix(pad.friction, x) for x in np.eye(7)])
            rows.append(-local)
            cones.append(clarabel.PSDTriangleConeT(6))
        at += n
    arm = max(pad.patch_radius for pad in pads)
    total[3:] /= arm
    cost = np.zeros(count)
    if normal_weights is not None:
        squares[:] = 0.0
        cost = normal_weights @ np.array([block[2] for block in blocks])
    right = [load / size / np.repeat([1.0, arm], 3), *(np.zeros(len(row)) for row in rows)]
    options = clarabel.DefaultSettings()
    options.verbose = False
    for tolerance in TOLERANCES:
        options.tol_gap_abs = options.tol_gap_rel = options.tol_feas = tolerance
        solution = clarabel.DefaultSolver(
            sparse.csc_matrix(np.triu(squares)),
            cost,
            sparse.csc_matrix(np.vstack([total, *rows])),
            np.concatenate(right),
            [clarabel.ZeroConeT(6), *cones],
            options,
        ).solve()
        if str(solution.status) in SOLVED:
            break
    else:
        return None
    x = np.array(solution.x)
    assert np.abs(total @ x - right[0]).max() < 5e-7 * max(1.0, float(np.abs(x).max()))
    return size * np.array([block @ x for block in blocks])


def _corner_wrench(pad: Contact) -> Array:
    """(6, 12) from forces (x, y, z) at the corners to the wrench about the patch's centre."""
    assert pad.half_sides is not None
    x, y = pad.half_sides
    places = [(x, y), (-x, y), (-x, -y), (x, -y)]
    return np.hstack([np.vstack([np.eye(3), cross_matrix([*place, 0.0])]) for place in places])


def _matrix(mu: float, x: Array) -> Array:
    """Scaled upper triangle (21,) of a disc's real (6, 6) matrix, see `joint_oracle`; linear in
    the wrench, moments over the radius, and z (7,)."""
    n = x[2]
    q = complex(-x[4], x[3])
    t = complex(x[0], x[1]) / mu
    return scaled_triangle(n, q, t, x[6] + 1j * x[5] / mu)


def in_box(pad: Contact) -> Array:
    """(6, 6) from a wrench about a pad's centre, in its axes, to one about the box frame."""
    R, p = pad.T_box_pad[:3, :3], pad.T_box_pad[:3, 3]
    return np.block([[R, np.zeros((3, 3))], [cross_matrix(p) @ R, R]])


def random_pad(rng: np.random.Generator, friction: float, kind: str) -> Contact:
    """A pad on a ball-like payload, its normal some tenths of a radian off the centre."""
    outward = rng.normal(size=3)
    outward /= np.linalg.norm(outward)
    z = -outward + 0.3 * rng.normal(size=3)
    z /= np.linalg.norm(z)
    x = np.cross(z, rng.normal(size=3))
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = rng.uniform(0.1, 0.25) * outward
    if kind == "round":
        return Contact(T, friction, float(rng.uniform(0.005, 0.05)))
    sides = (float(rng.uniform(0.004, 0.05)), float(rng.uniform(0.004, 0.05)))
    return Contact(T, friction, float(np.hypot(*sides)), sides)


def random_grasp(rng: np.random.Generator, cell: Workcell, kinds: tuple[str, ...]) -> Workcell:
    """The cell held by random pads that close their grasp; the first robot has every pad but
    one."""
    while True:
        friction = rng.uniform(0.3, 1.5, 2)
        pads = [
            random_pad(rng, float(friction[int(i == len(kinds) - 1)]), kind)
            for i, kind in enumerate(kinds)
        ]
        first = replace(pads[0], further=tuple(pads[1:-1]))
        found = replace(cell, contacts=(first, pads[-1]))
        if has_force_closure(found):
            return found


def random_load(rng: np.random.Generator) -> Array:
    """Force and moment of a payload of some kilograms, level or tumbling."""
    force = rng.normal(size=3)
    force *= rng.uniform(10.0, 150.0) / np.linalg.norm(force)
    return np.concatenate([force, rng.normal(size=3) * rng.choice([0.1, 1.0, 5.0])])


def turned(pad: Contact, rotation: Rotation) -> Contact:
    """A pad that turns with the payload about the box frame's origin."""
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    return replace(pad, T_box_pad=T @ pad.T_box_pad)


def function_of(cell: Workcell, differentiable: bool = False) -> ca.Function:
    load, friction = ca.MX.sym("load", 6), ca.MX.sym("friction", 2)
    found = grasp_wrenches(Grasp(cell), load, friction, differentiable=differentiable)
    return ca.Function("grasp", [load, friction], [found])


def friction_of(cell: Workcell) -> list[float]:
    return [contact.friction for contact in cell.contacts]


def wrenches(cell: Workcell, load: Array, function: ca.Function | None = None) -> Array:
    """(k, 6) force and moment about the pads' centres, in their axes."""
    found = np.array((function or function_of(cell))(load, friction_of(cell))).reshape(-1, 6)
    n, t_x, t_y, q_x, q_y, m = found.T
    return np.column_stack([t_x, t_y, n, q_y, -q_x, m])


def effort(found: Array) -> float:
    return float(np.sum(found[:, :3] ** 2))
