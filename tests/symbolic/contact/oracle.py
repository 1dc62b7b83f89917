"""Contact forces as conic programs for clarabel, and grasps to try them on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
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
) -> Array | None:
    """The least x . squares x / 2 + cost . x; None where the solver gives up.

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
            return np.array(found.x)
    return None


def points_of(pad: Contact, radii: int = 8, around: int = 12) -> tuple[Array, Array]:
    """(m, 2) points of a patch and the shares (m,) of the area that they stand for: as many rings
    of a disc and points on each, or as many points along both sides of a rectangle."""
    if pad.half_sides is not None:
        along = (np.arange(around) + 0.5) / around * 2.0 - 1.0
        points = np.array(np.meshgrid(*[half * along for half in pad.half_sides]))
        return points.reshape(2, -1).T, np.full(around**2, around**-2.0)
    angles = np.arange(around) + 0.5
    r, angle = np.meshgrid((np.arange(radii) + 0.5) / radii, angles * 2.0 * np.pi / around)
    at = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1)
    return pad.patch_radius * at.reshape(-1, 2), r.ravel() / r.sum()


def area_of(pad: Contact) -> float:
    if pad.half_sides is None:
        return np.pi * pad.patch_radius**2
    return 4.0 * pad.half_sides[0] * pad.half_sides[1]


def least_on_grids(
    pads: tuple[Contact, ...],
    load: Array,
    fork: bool = False,
    normal_weights: Array | None = None,
) -> Array:
    """(k, 6) as `wrenches`, of the least effort with friction at every point of a grid and pressure
    that is the same all over each patch; on a fork also all over the first two.

    Args:
        normal_weights: (k,) for the least sum of so weighted normal forces in place of the effort.
    """
    size = float(np.linalg.norm(load[:3]) + 10.0 * np.linalg.norm(load[3:]))
    maps, cones = [], []
    for pad in pads:
        points, share = points_of(pad)
        # Normal force, then the tangential force at every point over the normal force's share.
        own = np.zeros((6, 1 + 2 * len(points)))
        own[2, 0] = 1.0
        own[0, 1::2] = own[1, 2::2] = share
        own[5, 1::2], own[5, 2::2] = -share * points[:, 1], share * points[:, 0]
        maps.append(own)
        cone = np.zeros((len(points), 3, own.shape[1]))
        cone[:, 0, 0] = pad.friction
        cone[:, 1:, 1:] = np.kron(np.eye(len(points)), np.eye(2)).reshape(len(points), 2, -1)
        cones.append(cone.reshape(-1, own.shape[1]))
    # The pads' wrenches are unknowns of their own: the effort is theirs.
    k, whole, cone = 6 * len(pads), sparse.block_diag(maps), sparse.block_diag(cones)
    balance, asked = np.hstack([in_box(pad) for pad in pads]), load / size
    if fork:
        row = np.zeros(k)
        row[[2, 8]] = 1.0 / area_of(pads[0]), -1.0 / area_of(pads[1])
        balance, asked = np.vstack([balance, row]), np.append(asked, 0.0)
    count, points = whole.shape[1], cone.shape[0] // 3
    balanced = sparse.hstack([balance, sparse.csc_matrix((len(asked), count))])
    blocks = [
        (balanced, asked, [clarabel.ZeroConeT(len(asked))]),
        (sparse.hstack([sparse.eye(k), -whole]), np.zeros(k), [clarabel.ZeroConeT(k)]),
        (
            sparse.hstack([sparse.csc_matrix((3 * points, k)), -cone]),
            np.zeros(3 * points),
            [clarabel.SecondOrderConeT(3)] * points,
        ),
    ]
    squares, cost = np.tile([1.0, 1, 1, 0, 0, 0], len(pads)), np.zeros(k + count)
    if normal_weights is not None:
        squares, cost[2:k:6] = 0.0 * squares, normal_weights
    found = solved(sparse.diags([*squares, *np.zeros(count)]), cost, blocks)
    assert found is not None
    return size * found[:k].reshape(-1, 6)


def cross_matrix(v: Array | list[float]) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def in_box(pad: Contact) -> Array:
    """(6, 6) from a wrench about a pad's centre, in its axes, to one about the box frame."""
    R, p = pad.T_box_pad[:3, :3], pad.T_box_pad[:3, 3]
    return np.block([[R, np.zeros((3, 3))], [cross_matrix(p) @ R, R]])


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
