"""The paper's model: least contact forces of two facing pads, then their centres of pressure.

Paper Eqs. 34-42 and 50. With antiparallel contact normals n and -n and the resultant force
F = m (a - g) split into F_n = F.n and F_t = |F - F_n n|, the problem

    minimise |f_1|^2 + |f_2|^2   subject to   f_1 + f_2 = F,  both forces in their friction cones

has its tangential parts along F_t, so that it is a convex program in N_2 and the tangential
share of contact 1. Its solution is the largest of five smooth functions (see
`normal_force_branches`); with equal friction coefficients mu it is

    N_1 + N_2 = max( F_t / mu,  |F_n|,  (mu F_t + mu^2 |F_n|) / (1 + mu^2) ).

Centres of pressure: paper Eqs. 51-59. Each force of the program may act anywhere in the tangent
plane of its contact. Of the shifts that minimise the unbalanced moment, those of least norm are
taken.
"""

from __future__ import annotations

import casadi as ca

from symbolic.expression import Expression
from symbolic.records.quantities import GRAVITY

Both = tuple[Expression, Expression]
"""One value per contact."""

TANGENT_FLOOR = 1e-9
"""Added in squares below the root of the tangential force [N], to keep derivatives finite."""


def required_force(
    mass: float,
    acceleration: Expression,
) -> Expression:
    """Compute the resultant force m (a - g) (3,) on the box, world frame [N] (Eq. 34).

    Args:
        mass: mass of the payload [kg].
        acceleration: (3,) acceleration of the centre of mass, world frame [m/s^2].
    """
    return mass * (acceleration - ca.DM(GRAVITY))


def split_force(force: Expression, normal: Expression) -> tuple[Expression, Expression, Expression]:
    """Split a force into its normal component [N], the magnitude of its tangential part [N], and
    the unit direction (3,) of the tangential part.

    Args:
        force: (3,) force [N].
        normal: (3,) unit normal of contact 1, along the same axes.
    """
    f_n = ca.dot(force, normal)
    tangent = force - f_n * normal
    f_t = ca.sqrt(ca.dot(tangent, tangent) + TANGENT_FLOOR**2)
    return f_n, f_t, tangent / f_t


def normal_force_branches(
    f_n: Expression, f_t: Expression, friction: tuple[float, float]
) -> Expression:
    """Compute five smooth functions (5,) whose maximum is the least-effort normal force N_2 of
    contact 2 [N]. The normal force of contact 1 is N_1 = N_2 + F_n.

    The functions belong to these cases, in order: both friction cones tight; contact 2 unloaded;
    contact 1 unloaded; least effort with only the cone of contact 2 tight; least effort with only
    the cone of contact 1 tight. The maximum is exact, because the effort is convex in N_2 and rises
    wherever a cone is slack.

    Args:
        f_n: normal component of the resultant force along the normal of contact 1 [N].
        f_t: magnitude of the tangential part of the resultant force [N].
        friction: Coulomb coefficients of contacts 1 and 2.
    """
    mu_1, mu_2 = friction
    return ca.vertcat(
        (f_t - mu_1 * f_n) / (mu_1 + mu_2),
        0.0 * f_n,
        -f_n,
        (mu_2 * f_t - f_n) / (2.0 * (1.0 + mu_2**2)),
        (mu_1 * f_t + f_n) / (2.0 * (1.0 + mu_1**2)) - f_n,
    )


def allocate(
    force: Expression, normal: Expression, friction: tuple[float, float]
) -> tuple[Expression, Expression, Both]:
    """Compute the contact forces f_1 and f_2 of least effort, the least sum of their squared
    magnitudes, for a resultant force.

    Args:
        force: (3,) resultant force on the box, world frame [N].
        normal: (3,) unit normal of contact 1, world frame; contact 2 has the opposite normal.
        friction: Coulomb coefficients of the two contacts.

    Returns:
        Normal forces (2,), magnitudes (2,) of the tangential forces, and the force (3,) of each
        contact on the box, world frame [N].
    """
    f_n, f_t, direction = split_force(force, normal)
    n_2 = ca.mmax(normal_force_branches(f_n, f_t, friction))
    n_1 = n_2 + f_n
    # Equal shares cost least; the friction cones push the share away from one half.
    t_1 = ca.fmin(ca.fmax(f_t / 2.0, f_t - friction[1] * n_2), friction[0] * n_1)
    t_2 = f_t - t_1
    forces = n_1 * normal + t_1 * direction, -n_2 * normal + t_2 * direction
    return ca.vertcat(n_1, n_2), ca.vertcat(t_1, t_2), forces


# --- centres of pressure ---


RELATIVE_DAMPING = 1e-8
"""Damping of the normal equations relative to their trace.

With an unloaded contact or without tangential forces, moments in some direction cannot be balanced;
the remaining error is rounding over the damping.
"""

REFINEMENTS = 7
"""Repeated solves for the residual (iterated Tikhonov regularisation): they raise the relative
error of the damping to its eighth power, below rounding wherever the moment can be balanced."""


def required_moment(
    inertia: Expression, rotation: Expression, velocity: Expression, acceleration: Expression
) -> Expression:
    """Compute the moment (3,) about the centre of mass that the rotation requires, world frame [N
    m] (Eqs. 52-53).

    Args:
        inertia: (3, 3) inertia about the centre of mass, box axes [kg m^2].
        rotation: (3, 3) R_world_box.
        velocity, acceleration: (3,) angular velocity [rad/s] and angular acceleration [rad/s^2],
            world frame.
    """
    inertia_world = ca.mtimes([rotation, inertia, rotation.T])
    return ca.mtimes(inertia_world, acceleration) + ca.cross(
        velocity, ca.mtimes(inertia_world, velocity)
    )


def pressure_shift(
    moment: Expression,
    arms: tuple[Expression, Expression],
    forces: tuple[Expression, Expression],
    tangents: tuple[Expression, Expression],
) -> tuple[Both, Expression, Expression]:
    """Compute the shifts of both centres of pressure that minimise the unbalanced moment; of these,
    the shifts of least norm (Eqs. 54-59). All vectors are in the world frame.

    Args:
        moment: (3,) required moment about the centre of mass [N m].
        arms: for each contact the vector (3,) from the centre of mass to the nominal contact point
            [m].
        forces: for each contact the force (3,) on the box [N].
        tangents: two orthonormal vectors (3,) that span both contact planes, which are parallel.

    Returns:
        The shift (3,) of each contact in its tangent plane [m]; the unbalanced moment (3,) with the
        forces at the nominal points [N m]; and the unbalanced moment (3,) with the forces at the
        shifted points [N m].
    """
    point_residual = moment - ca.cross(arms[0], forces[0]) - ca.cross(arms[1], forces[1])
    plane = ca.horzcat(*tangents)
    lever = ca.horzcat(
        *[ca.cross(tangent, force) for force in forces for tangent in tangents]
    )  # A (3, 4): moment per unit of each tangential shift
    gram = ca.mtimes(lever, lever.T)
    damping = RELATIVE_DAMPING * ca.trace(gram) + 1e-300
    damped = gram + damping * ca.DM.eye(3)
    dual = _solve_symmetric_3(damped, point_residual)
    for _ in range(REFINEMENTS):
        dual += _solve_symmetric_3(damped, point_residual - ca.mtimes(gram, dual))
    shifts = ca.mtimes(lever.T, dual)
    moved = ca.mtimes(plane, shifts[:2]), ca.mtimes(plane, shifts[2:])
    return moved, point_residual, point_residual - ca.mtimes(lever, shifts)


def _solve_symmetric_3(matrix: Expression, right: Expression) -> Expression:
    """Solve a linear system with a symmetric positive definite matrix (3, 3) and a right side (3,),
    by LDL^T factors."""
    d_1 = matrix[0, 0]
    l_21, l_31 = matrix[1, 0] / d_1, matrix[2, 0] / d_1
    d_2 = matrix[1, 1] - l_21 * matrix[1, 0]
    l_32 = (matrix[2, 1] - l_31 * matrix[1, 0]) / d_2
    d_3 = matrix[2, 2] - l_31 * matrix[2, 0] - l_32**2 * d_2
    y_1 = right[0]
    y_2 = right[1] - l_21 * y_1
    y_3 = right[2] - l_31 * y_1 - l_32 * y_2
    z_3 = y_3 / d_3
    z_2 = y_2 / d_2 - l_32 * z_3
    return ca.vertcat(y_1 / d_1 - l_21 * z_2 - l_31 * z_3, z_2, z_3)
