"""Exact list of the GoFa 12's branches: all but joint 6 in closed form, joint 6 by a root search.

Axes 4 and 5 meet; given q6, that point and axis 5 are known from the flange. The point fixes
q1 (two choices) and q2, q3 (a planar two-link arm, two choices); axis 4 must then be at right
angles to axis 5, which is one equation in q6.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.optimize import brentq

from symbolic.array import Array
from symbolic.records import Robot

SHOULDER, UPPER_ARM, OFFSET, FOREARM = 0.338, 0.707, 0.110, 0.534
WRIST = np.array([0.101, 0.0, 0.080])
GRID = 1440


def gofa_branches(robot: Robot, T_root_flange: Array) -> Array:
    """(m, 6) joint positions within [-pi, pi] and the joint limits' turns [rad]."""
    flange_to_link = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    R_6, p_6 = T_root_flange[:3, :3] @ flange_to_link, T_root_flange[:3, 3]
    found = []
    grid = np.linspace(-np.pi, np.pi, GRID + 1)
    for back, elbow in product((False, True), (1.0, -1.0)):

        def angle(q6: float, back: bool = back, elbow: float = elbow) -> float:
            arm = _first_three(R_6, p_6, q6, back, elbow)
            return float("nan") if arm is None else float(arm[3] @ arm[4])

        values = np.array([angle(q6) for q6 in grid])
        for left, right, a, b in zip(grid, grid[1:], values, values[1:], strict=False):
            if np.isfinite(a) and np.isfinite(b) and a * b <= 0.0 and abs(a - b) < 0.5:
                root = float(brentq(angle, left, right, xtol=1e-13))
                found.append(_posture(R_6, p_6, root, back, elbow))
    rows = np.array([q for q in found if _possible(robot, q)]).reshape(-1, 6)
    return rows


def _rot_x(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _first_three(
    R_6: Array, p_6: Array, q6: float, back: bool, elbow: float
) -> tuple[float, float, float, Array, Array] | None:
    """q1, q2, q3, axis 4 and axis 5, or None where the point is out of the arm's reach."""
    R_5 = R_6 @ _rot_x(-q6)
    point = p_6 - R_5 @ WRIST
    q1 = np.arctan2(point[1], point[0]) + (np.pi if back else 0.0)
    radius = np.cos(q1) * point[0] + np.sin(q1) * point[1]
    height = point[2] - SHOULDER
    length = np.hypot(FOREARM, OFFSET)
    cosine = (radius**2 + height**2 - UPPER_ARM**2 - length**2) / (2.0 * UPPER_ARM * length)
    if abs(cosine) > 1.0:
        return None
    bend = elbow * np.arccos(cosine)
    # Angles from the vertical, positive towards the front.
    q2 = np.arctan2(radius, height) - np.arctan2(
        length * np.sin(bend), UPPER_ARM + length * np.cos(bend)
    )
    q3 = bend - np.arctan2(FOREARM, OFFSET)
    phi = q2 + q3
    axis_4 = np.array([np.cos(q1) * np.cos(phi), np.sin(q1) * np.cos(phi), -np.sin(phi)])
    return q1, q2, q3, axis_4, R_5[:, 1]


def _posture(R_6: Array, p_6: Array, q6: float, back: bool, elbow: float) -> Array:
    arm = _first_three(R_6, p_6, q6, back, elbow)
    assert arm is not None
    q1, q2, q3, axis_4, axis_5 = arm
    side = np.array([-np.sin(q1), np.cos(q1), 0.0])
    R_3 = np.column_stack([axis_4, side, np.cross(axis_4, side)])
    local = R_3.T @ axis_5
    q4 = np.arctan2(local[2], local[1])
    R_45 = (R_3 @ _rot_x(q4)).T @ R_6 @ _rot_x(-q6)
    q5 = np.arctan2(R_45[0, 2], R_45[0, 0])
    return np.array([q1, q2, q3, q4, q5, q6])


def _possible(robot: Robot, q: Array) -> bool:
    """Whether some full turn of every joint lies within its limits."""
    lowest = robot.position_lower + np.remainder(q - robot.position_lower, 2 * np.pi)
    return bool(np.all(lowest <= robot.position_upper))
