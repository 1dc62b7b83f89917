"""The joint allocation as a semidefinite program for clarabel, in all components of both wrenches.

A pressure on a disc that carries a wrench (N, T, q, M), scaled as `symbolic.contact.round_patch`
does, exists where some z makes the Hermitian matrix [[N, q*, T*], [q, N, .], [T, z + i M, N]]
positive semidefinite (q and T as complex numbers): it is the second moment of (1, x, f) over the
pressure, x on the unit circle and f the direction of friction, of unit length, at x.
"""

from __future__ import annotations

from dataclasses import dataclass

import clarabel
import numpy as np
from scipy import sparse

from symbolic.array import Array


@dataclass(frozen=True)
class Case:
    """What two contacts have to carry; coordinates a, b, n of contact 1, lengths in m.

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


def least_wrenches(case: Case, squeeze: bool = False) -> Array:
    """(2, 6) forces and moments about the nominal contact points, of least effort or N_1 + N_2.

    Raises:
        AssertionError: what the solver says does not hold.
    """
    return _refined(case, squeeze)[0]


def least_squeeze_within(case: Case) -> tuple[float, float]:
    """The least N_1 + N_2 [N], and by how much the solver may be off. How far that is
    depends on the machine's arithmetic, where its last steps fail.

    Raises:
        AssertionError: what the solver says does not hold.
    """
    wrenches, unsure = _refined(case, True)
    return float(wrenches[0, 2] - wrenches[1, 2]), unsure


def _refined(case: Case, squeeze: bool) -> tuple[Array, float]:
    rough, _ = _solve(case, float(np.abs(case.force).max()), squeeze)
    return _solve(case, float(np.abs(rough[:, :3]).max()), squeeze)


def _solve(case: Case, size: float, squeeze: bool) -> tuple[Array, float]:
    """The wrenches, from a program whose unknowns are about one if forces are about `size`, and by
    how much what is minimised may be off: the duality gap, and what balance and cones miss times
    their multipliers (weak duality)."""
    unit = case.radius.max()
    eye, none = np.eye(3), np.zeros((3, 3))
    turn = [cross_matrix(arm) / unit for arm in case.arms]
    balance = np.block([[eye, none, eye, none], [turn[0], eye, turn[1], eye]])
    rows = np.hstack([balance, np.zeros((6, 2))])
    right = np.concatenate([case.force, case.moment / unit]) / size
    cones = [np.column_stack([cone_matrix(case, i, one) for one in np.eye(14)]) for i in (0, 1)]
    forces = np.array([1.0, 1, 1, 0, 0, 0] * 2 + [0, 0])
    normals = np.array([0.0, 0, 1, 0, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0])
    matrix = np.vstack([rows, *(-cone for cone in cones)])
    bound = np.concatenate([right, np.zeros(42)])
    options = clarabel.DefaultSettings()
    options.verbose = False
    # What it can reach; "almost solved" then means to its reduced tolerances.
    options.tol_gap_abs = options.tol_gap_rel = options.tol_feas = 1e-9 if squeeze else 1e-11
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix(np.diag(0.0 * forces if squeeze else forces)),
        normals if squeeze else 0.0 * normals,
        sparse.csc_matrix(matrix),
        bound,
        [clarabel.ZeroConeT(6), clarabel.PSDTriangleConeT(6), clarabel.PSDTriangleConeT(6)],
        options,
    ).solve()
    x = np.array(solution.x)
    assert str(solution.status) in ("Solved", "AlmostSolved"), solution.status
    if not squeeze:  # there, what balance misses is part of how much the answer may be off
        assert np.abs(rows @ x - right).max() < 5e-7 * max(1.0, float(np.abs(x).max()))
    wrenches: Array = size * x[:12].reshape(2, 6) * np.repeat([1.0, unit], 3)
    multipliers, missed = np.array(solution.z), matrix @ x + np.array(solution.s) - bound
    gap = abs(solution.obj_val - solution.obj_val_dual)
    return wrenches, size * (gap + float(np.abs(multipliers) @ np.abs(missed)))


def cone_matrix(case: Case, i: int, x: Array) -> Array:
    """Scaled upper triangle (21,) of contact i's real (6, 6) matrix; linear in x (14,), whose
    moments are in units of the larger radius."""
    sign = 1.0 if i == 0 else -1.0
    force, moment, z = x[6 * i : 6 * i + 3], x[6 * i + 3 : 6 * i + 6], x[12 + i]
    mu, r = case.friction[i], case.radius[i] / case.radius.max()
    # A normal force N n at d turns about d x n = (d_b, -d_a).
    q = sign * complex(-moment[1], moment[0]) / r
    t = complex(force[0], force[1]) / mu
    beside = z + 1j * moment[2] / (mu * r)
    n = sign * force[2]
    return scaled_triangle(n, q, t, beside)


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
