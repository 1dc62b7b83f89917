"""What a round contact patch can carry: force, centre of pressure and torsion, coupled.

A rigid flat patch of radius r may carry its load with any pressure on it, and at each point
Coulomb friction holds. With normal force N, tangential force T, shift d of the centre of pressure
and torsion tau about the normal through it, the wrenches that such pressures give are exactly
those with

    N >= 0,  |d| <= r,  |T|^2 + tau^2 / (r^2 - |d|^2) <= (mu N)^2.

This is an ellipsoidal limit surface (Howe and Cutkosky, Practical force-motion models for sliding
manipulation, IJRR 1996) whose coefficient sqrt(r^2 - |d|^2) is that of a pressure at the rim: the
largest that a pressure with this centre has, and zero where the centre is at the rim. (A uniform
pressure has 2/3 r.) It is for a disc what Caron's cone is for a rectangle (Caron, Pham and
Nakamura, Stability of surface contacts for humanoid robots, ICRA 2015): the convex hull of point
contacts all over the patch.

Proof: M = d x T + tau is the moment about the patch's centre. The largest a.T + b M that a pressure
allows is the mean over it of mu |a + b J x| = mu sqrt(|a|^2 + b^2 |x|^2 + 2 b a.(J x)), J turning
by a right angle. It grows with |x| and is concave in a.(J x), so that two points on the rim with
the same a.(J x) as the centre of pressure are best. They give
mu N sqrt(|a + b J d|^2 + b^2 (r^2 - |d|^2)), which is the support of the ellipse above.

With forces over N, T over mu, the first moment q = N d over r and M over mu r, membership reads

    (N^2 - |q|^2) (N^2 - |T|^2) >= (N M - q x T)^2,  |q| <= N,  |T| <= N:

a positive semidefinite Hermitian matrix with N on its diagonal and q, T and z + i M beside it, z
being free. Its determinant, largest over z, gives the barrier.
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from symbolic.expression import Expression
from symbolic.physics.closure import WRENCH_SIZE

BARRIER_DEGREE = 3.0
"""A path-following minimiser of s f + barrier is within this over s of the least f, per patch."""


def cross_2(a: Expression, b: Expression) -> Expression:
    """Out-of-plane component of the cross product of two vectors (2,)."""
    return a[0] * b[1] - a[1] * b[0]


def patch_slack(wrench: Expression) -> Expression:
    """What a scaled wrench (6,) leaves of its cone, left side less right side of the above."""
    normal, tangent, moment = wrench[0], wrench[1:3], wrench[3:5]
    pressure = normal**2 - ca.sumsqr(moment)
    friction = normal**2 - ca.sumsqr(tangent)
    return pressure * friction - (normal * wrench[5] - cross_2(moment, tangent)) ** 2


def patch_potential(wrench: Expression) -> Expression:
    """The barrier log N - log slack at a scaled wrench (6,)."""
    return ca.log(wrench[0]) - ca.log(patch_slack(wrench))


@cache
def patch_barrier() -> ca.Function:
    """Gradient (6,) and Hessian (6, 6) of the barrier at a scaled wrench."""
    wrench = ca.SX.sym("wrench", WRENCH_SIZE)
    gradient = ca.gradient(patch_potential(wrench), wrench)
    hessian = ca.densify(ca.jacobian(gradient, wrench))
    return ca.Function("patch_barrier", [wrench], ca.cse([gradient, hessian]))
