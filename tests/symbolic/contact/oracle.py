"""Allocations as conic programs for clarabel, and grasps to try them on.

A pressure on a disc that carries a wrench (N, T, q, M), scaled as `symbolic.contact.round_patch`
does, exists where some z makes the Hermitian matrix [[N, q*, T*], [q, N, .], [T, z + i M, N]]
positive semidefinite (q and T as complex numbers): it is the second moment of (1, x, f) over the
pressure, x on the unit circle and f the direction of friction, of unit length, at x. On a rectangle
it exists where forces at the corners, within their friction cones, carry the wrench.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import clarabel
import numpy as np
from scipy import sparse

from symbolic.array import Array
from symbolic.contact.force_closure import has_force_closure
from symbolic.contact.grasp import Grasp, grasp_wrenches
from symbolic.records import Contact, Workcell

TOLERANCES = (1e-11, 1e-10, 1e-9)
"""Of clarabel; the next one where it makes no progress."""

SOLVED = ("Solved", "AlmostSolved")


def solved(
    squares: Any, cost: Array, blocks: Sequence[tuple[Any, Array, list[Any]]]
) -> tuple[Array, float] | None:
    """The least x . squares x / 2 + cost . x, and by how much what is minimised may be off: the
    duality gap, and what the constraints miss times their multipliers (weak duality). None where
    the solver gives up.

    Args:
        blocks: matrices, right sides and cones, in order: right - matrix x lies within.
    """
    matrix = sparse.csc_matrix(sparse.vstack([sparse.csc_matrix(rows) for rows, _, _ in blocks]))
    right = np.concatenate([bound for _, bound, _ in blocks])
    cones = [cone for *_, own in blocks for cone in own]
    options = clarabel.DefaultSettings()
    options.verbose = False
    for tolerance in TOLERANCES:
        options.tol_gap_abs = options.tol_gap_rel = options.tol_feas = tolerance
        upper = sparse.csc_matrix(sparse.triu(sparse.csc_matrix(squares)))
        found = clarabel.DefaultSolver(upper, cost, matrix, right, cones, options).solve()
        if str(found.status) in SOLVED:
            x = np.array(found.x)
            missed = np.abs(matrix @ x + np.array(found.s) - right)
            gap = abs(found.obj_val - found.obj_val_dual)
            return x, gap + float(np.abs(found.z) @ missed)
    return None


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
    return least_within(pads, load, normal_weights)[0]


def least_within(
    pads: tuple[Contact, ...], load: Array, normal_weights: Array | None = None
) -> tuple[Array, float]:
    """The same, and by how much the least sum of normal forces may be off [N]."""
    size = float(np.linalg.norm(load[:3]) + 10.0 * np.linalg.norm(load[3:]))
    # Forces may be a thousand times the load, where pads hardly close their grasp.
    weights = normal_weights
    tries = (_solve(pads, load, size * f, weights) for f in (1.0, 10.0, 100.0, 1000.0))
    rough = next(found for found in tries if found is not None)[0]
    found = _solve(pads, load, float(np.abs(rough[:, :3]).max()), weights)
    assert found is not None
    return found


def _solve(
    pads: tuple[Contact, ...], load: Array, size: float, normal_weights: Array | None
) -> tuple[Array, float] | None:
    """From a program whose unknowns are about one if forces are about `size`."""
    ends = np.cumsum([0, *(12 if pad.half_sides else 7 for pad in pads)])
    count, at = int(ends[-1]), 0
    wrenches, blocks = np.zeros((len(pads), 6, count)), []
    for i, pad in enumerate(pads):
        at = int(ends[i])
        if pad.half_sides:
            x, y = pad.half_sides
            for k, place in enumerate([(x, y), (-x, y), (-x, -y), (x, -y)]):
                force = slice(at + 3 * k, at + 3 * k + 3)
                wrenches[i, :, force] = np.vstack([np.eye(3), cross_matrix([*place, 0.0])])
                rows = np.zeros((3, count))
                rows[:, force] = np.roll(np.diag([1.0, 1.0, pad.friction]), 1, axis=0)
                blocks.append((-rows, np.zeros(3), [clarabel.SecondOrderConeT(3)]))
        else:
            # A disc's moments in units of its radius, so that all unknowns are about as large.
            wrenches[i, :, at : at + 6] = np.diag([1.0, 1.0, 1.0, *[pad.patch_radius] * 3])
            rows = np.zeros((21, count))
            rows[:, at : at + 7] = np.column_stack([disc(pad.friction, x) for x in np.eye(7)])
            blocks.append((-rows, np.zeros(21), [clarabel.PSDTriangleConeT(6)]))
    units = np.repeat([1.0, max(pad.patch_radius for pad in pads)], 3)
    total = np.hstack([in_box(pad) for pad in pads]) @ wrenches.reshape(-1, count) / units[:, None]
    asked = load / size / units
    forces, cost = wrenches[:, :3].reshape(-1, count), np.zeros(count)
    if normal_weights is not None:
        forces, cost = 0.0 * forces, normal_weights @ wrenches[:, 2]
    found = solved(forces.T @ forces, cost, [(total, asked, [clarabel.ZeroConeT(6)]), *blocks])
    if found is None:
        return None
    unknowns, unsure = found
    missed, most = np.abs(total @ unknowns - asked).max(), float(np.abs(unknowns).max())
    assert missed < 5e-7 * max(1.0, most) or normal_weights is not None
    return size * wrenches @ unknowns, size * unsure


def disc(mu: float, x: Array) -> Array:
    """Scaled upper triangle (21,) of a disc's matrix, linear in force, moments over the radius, and
    z (7,)."""
    # A normal force N n at d turns about d x n = (d_y, -d_x).
    q, t = complex(-x[4], x[3]), complex(x[0], x[1]) / mu
    return scaled_triangle(x[2], q, t, x[6] + 1j * x[5] / mu)


def scaled_triangle(n: float, q: complex, t: complex, beside: complex) -> Array:
    """(21,) of the real (6, 6) form of the matrix above, as clarabel's cone has it."""
    hermitian = np.array(
        [[n, q.conjugate(), t.conjugate()], [q, n, beside.conjugate()], [t, beside, n]]
    )
    real = np.block([[hermitian.real, -hermitian.imag], [hermitian.imag, hermitian.real]])
    return np.array(
        [real[j, k] * (1.0 if j == k else np.sqrt(2.0)) for k in range(6) for j in range(k + 1)]
    )


def cross_matrix(v: Array | list[float]) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def in_box(pad: Contact) -> Array:
    """(6, 6) from a wrench about a pad's centre, in its axes, to one about the box frame."""
    R, p = pad.T_box_pad[:3, :3], pad.T_box_pad[:3, 3]
    return np.block([[R, np.zeros((3, 3))], [cross_matrix(p) @ R, R]])


@dataclass(frozen=True)
class Case:
    """What two round pads that face one another have to carry; coordinates a, b, n of contact 1,
    lengths in m.

    Attributes:
        force, moment: (3,) resultant and moment about the centre of mass.
        arms: (2, 3) from the centre of mass to the nominal contact points.
        friction, radius: (2,).
    """

    force: Array
    moment: Array
    arms: Array
    friction: Array
    radius: Array

    def least(self, squeeze: bool = False) -> tuple[Array, float]:
        """(2, 3) forces of least effort or N_1 + N_2, and by how much the latter may be off [N]."""
        pads = []
        for i, turn in enumerate((np.eye(3), np.diag([1.0, -1.0, -1.0]))):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = turn, self.arms[i]
            pads.append(Contact(T, float(self.friction[i]), float(self.radius[i])))
        load = np.concatenate([self.force, self.moment])
        found, unsure = least_within((pads[0], pads[1]), load, np.ones(2) if squeeze else None)
        return found[:, :3] * [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0]], unsure


# --- grasps ---


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


def function_of(cell: Workcell) -> ca.Function:
    load, friction = ca.MX.sym("load", 6), ca.MX.sym("friction", 2)
    return ca.Function("grasp", [load, friction], [grasp_wrenches(Grasp(cell), load, friction)])


def friction_of(cell: Workcell) -> list[float]:
    return [contact.friction for contact in cell.contacts]


def wrenches(cell: Workcell, load: Array, function: ca.Function | None = None) -> Array:
    """(k, 6) force and moment about the pads' centres, in their axes; they balance the load."""
    found = np.array((function or function_of(cell))(load, friction_of(cell))).reshape(-1, 6)
    n, t_x, t_y, q_x, q_y, m = found.T
    whole = np.column_stack([t_x, t_y, n, q_y, -q_x, m])
    balance = sum(in_box(p) @ w for p, w in zip(cell.pads, whole, strict=True))
    np.testing.assert_allclose(balance, load, atol=1e-9 * np.sqrt(effort(whole)))
    return whole


def effort(found: Array) -> float:
    """Sum of all squared forces."""
    return float(np.sum(found[..., :3] ** 2))
