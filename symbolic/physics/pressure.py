"""Centre of pressure: how far each contact force must move to carry the required moment.

Paper Eqs. 51-59. The forces are those of the allocation; each may act anywhere in the tangent
plane of its contact, and the shifts are the least-norm ones that minimise the moment left over.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from symbolic.expression import Expression

RELATIVE_DAMPING = 1e-8
"""Damping of the normal equations relative to their trace.

Where one contact is unloaded or nothing is tangential, a direction of moment cannot be had, and
rounding over the damping is the error that remains.
"""

REFINEMENTS = 7
"""Repeated solves for what is left (iterated Tikhonov regularisation): they take the damping's
own error to its eighth power, below rounding wherever a moment can be had at all."""


@dataclass(frozen=True)
class PressureShift:
    """Shifts of the centres of pressure and the moments around them, world frame.

    Attributes:
        shift_1, shift_2: (3,) in the tangent planes of the contacts [m].
        required_moment: (3,) about the centre of mass, needed by the motion [N m].
        point_residual: (3,) moment missing with the forces at the nominal points [N m].
        residual: (3,) moment missing with the shifts applied [N m].
    """

    shift_1: Expression
    shift_2: Expression
    required_moment: Expression
    point_residual: Expression
    residual: Expression


def required_moment(
    inertia: Expression, rotation: Expression, velocity: Expression, acceleration: Expression
) -> Expression:
    """Moment (3,) about the centre of mass that the rotation needs (Eqs. 52-53) [N m].

    Args:
        inertia: (3, 3) about the centre of mass, box axes [kg m^2].
        rotation: R_world_box (3, 3).
        velocity, acceleration: (3,) angular, world frame [rad/s, rad/s^2].
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
) -> PressureShift:
    """Least-norm shifts of both centres of pressure (Eqs. 54-59).

    Args:
        moment: (3,) required moment about the centre of mass [N m].
        arms: (3,) each, from the centre of mass to the nominal contact points [m].
        forces: (3,) each, contact forces on the box [N].
        tangents: two orthonormal tangent vectors (3, 2) spanning both contact planes, which
            are parallel; the two entries are the columns.
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
    return PressureShift(
        shift_1=ca.mtimes(plane, shifts[:2]),
        shift_2=ca.mtimes(plane, shifts[2:]),
        required_moment=moment,
        point_residual=point_residual,
        residual=point_residual - ca.mtimes(lever, shifts),
    )


def _solve_symmetric_3(matrix: Expression, right: Expression) -> Expression:
    """Solution of a symmetric positive definite 3 by 3 system by its LDL^T factors."""
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
