"""Least contact forces of two frictional pads that hold a moving box.

Paper Eqs. 34-42 and 50. With antiparallel contact normals n and -n and the resultant force
F = m (a - g) split into F_n = F.n and F_t = |F - F_n n|, the problem

    minimise |f_1|^2 + |f_2|^2   subject to   f_1 + f_2 = F,  both forces in their friction cones

has its tangential parts along F_t, so that it is a convex program in N_2 and the tangential
share of contact 1. Its solution is the largest of five smooth functions (see
`normal_force_branches`); with equal friction coefficients mu it is

    N_1 + N_2 = max( F_t / mu,  |F_n|,  (mu F_t + mu^2 |F_n|) / (1 + mu^2) ).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from symbolic.expression import Expression

GRAVITY = (0.0, 0.0, -9.81)
"""Gravity in the world frame [m/s^2] (paper, below Eq. 34)."""

TANGENT_FLOOR = 1e-9
"""Added in squares below the root of the tangential force [N]: keeps derivatives finite."""


@dataclass(frozen=True)
class ContactForces:
    """Forces that the robots exert on the box, world frame.

    Attributes:
        normal: (2,) normal forces N_1, N_2 [N].
        tangential: (2,) magnitudes of the tangential forces [N].
        force_1, force_2: (3,) contact forces [N].
    """

    normal: Expression
    tangential: Expression
    force_1: Expression
    force_2: Expression


def required_force(
    mass: float,
    acceleration: Expression,
) -> Expression:
    """Resultant force (3,) on the box [N], from its centre of mass's acceleration (Eq. 34)."""
    return mass * (acceleration - ca.DM(GRAVITY))


def split_force(force: Expression, normal: Expression) -> tuple[Expression, Expression, Expression]:
    """Normal component, tangential magnitude and unit tangential direction of a force.

    Args:
        force: (3,) [N].
        normal: (3,) unit normal of contact 1.
    """
    f_n = ca.dot(force, normal)
    tangent = force - f_n * normal
    f_t = ca.sqrt(ca.dot(tangent, tangent) + TANGENT_FLOOR**2)
    return f_n, f_t, tangent / f_t


def normal_force_branches(
    f_n: Expression, f_t: Expression, friction: tuple[float, float]
) -> Expression:
    """The five smooth functions (5,) whose largest is the normal force N_2 of contact 2 [N].

    N_1 = N_2 + F_n. In order: both friction cones tight; contact 2 unloaded; contact 1
    unloaded; least effort with only the cone of contact 2 tight; with only that of contact 1.
    A branch that is not the largest never cuts off the solution, because the effort is convex
    in N_2 and rises wherever a cone is slack.
    """
    mu_1, mu_2 = friction
    return ca.vertcat(
        (f_t - mu_1 * f_n) / (mu_1 + mu_2),
        0.0 * f_n,
        -f_n,
        (mu_2 * f_t - f_n) / (2.0 * (1.0 + mu_2**2)),
        (mu_1 * f_t + f_n) / (2.0 * (1.0 + mu_1**2)) - f_n,
    )


def allocate(force: Expression, normal: Expression, friction: tuple[float, float]) -> ContactForces:
    """Minimum-effort contact forces for a resultant force.

    Args:
        force: (3,) resultant force on the box, world frame [N].
        normal: (3,) unit normal of contact 1 in the world frame; contact 2 has its opposite.
        friction: Coulomb coefficients of the two contacts.
    """
    f_n, f_t, direction = split_force(force, normal)
    n_2 = ca.mmax(normal_force_branches(f_n, f_t, friction))
    n_1 = n_2 + f_n
    # Equal shares cost least; the friction cones push the share away from one half.
    t_1 = ca.fmin(ca.fmax(f_t / 2.0, f_t - friction[1] * n_2), friction[0] * n_1)
    t_2 = f_t - t_1
    return ContactForces(
        normal=ca.vertcat(n_1, n_2),
        tangential=ca.vertcat(t_1, t_2),
        force_1=n_1 * normal + t_1 * direction,
        force_2=-n_2 * normal + t_2 * direction,
    )
