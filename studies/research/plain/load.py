"""Contact forces and centres of pressure written plainly, for one sample."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from studies.research.plain.motion import box_rates, box_rotation
from symbolic.array import Array
from symbolic.records import Workcell

GRAVITY = np.array([0.0, 0.0, -9.81])


def sample_load(workcell: Workcell, pose: Array, rate: Array, second: Array) -> dict[str, Array]:
    """Every load quantity of one sample, named as in `LOAD_OUTPUTS`."""
    payload, contacts = workcell.payload, workcell.contacts
    orientation = workcell.task.orientation
    R = box_rotation(orientation, pose[3:])
    omega, alpha = box_rates(orientation, pose[3:], rate[3:], second[3:])
    to_com = R @ payload.centre_of_mass
    acceleration = second[:3] + np.cross(alpha, to_com) + np.cross(omega, np.cross(omega, to_com))
    force = payload.mass * (acceleration - GRAVITY)

    normal = R @ contacts[0].T_box_pad[:3, 2]
    f_n = float(force @ normal)
    tangent = force - f_n * normal
    f_t = float(np.linalg.norm(tangent))
    direction = tangent / f_t if f_t > 0.0 else np.zeros(3)
    n, t = allocate(f_n, f_t, (contacts[0].friction, contacts[1].friction))
    forces = (n[0] * normal + t[0] * direction, -n[1] * normal + t[1] * direction)

    inertia = R @ payload.inertia @ R.T
    moment = inertia @ alpha + np.cross(omega, inertia @ omega)
    points = [R @ (contact.T_box_pad[:3, 3] - payload.centre_of_mass) for contact in contacts]
    missing = moment - sum(np.cross(r, f) for r, f in zip(points, forces, strict=True))
    planes = [R @ contact.T_box_pad[:3, :2] for contact in contacts]
    A = np.column_stack([np.cross(planes[i][:, k], forces[i]) for i in (0, 1) for k in (0, 1)])
    d = np.linalg.pinv(A, rcond=1e-6) @ missing
    shifts = (planes[0] @ d[:2], planes[1] @ d[2:])
    return {
        "angular_velocity": omega,
        "angular_acceleration": alpha,
        "normal_force": n,
        "tangential_force": t,
        "contact_force": np.concatenate(forces),
        "pressure_shift": np.array([np.linalg.norm(shift) for shift in shifts]),
        "shift_vector": np.concatenate(shifts),
        "required_moment": moment,
        "point_moment_residual": missing,
        "moment_residual": missing - A @ d,
        "wrench_1": np.concatenate([forces[0], np.cross(shifts[0], forces[0])]),
        "wrench_2": np.concatenate([forces[1], np.cross(shifts[1], forces[1])]),
    }


def allocate(f_n: float, f_t: float, friction: tuple[float, float]) -> tuple[Array, Array]:
    """Least-effort normal forces (2,) and tangential shares (2,) of a resultant force [N]."""
    if friction[0] == friction[1]:
        return _equal_friction(f_n, f_t, friction[0])
    return _small_program(f_n, f_t, friction)


def _equal_friction(f_n: float, f_t: float, mu: float) -> tuple[Array, Array]:
    total = max(f_t / mu, abs(f_n), (mu * f_t + mu**2 * abs(f_n)) / (1.0 + mu**2))
    light = min(mu * (total - abs(f_n)) / 2.0, f_t / 2.0)
    normal = np.array([total + f_n, total - f_n]) / 2.0
    tangential = np.array([light, f_t - light] if f_n < 0.0 else [f_t - light, light])
    return normal, tangential


def _small_program(f_n: float, f_t: float, friction: tuple[float, float]) -> tuple[Array, Array]:
    """The quadratic program in N_1, N_2, t_1, t_2, by trying every set of active constraints."""
    equal = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
    # Rows that must not be positive: both friction cones, both normal forces.
    bounds = np.array(
        [
            [-friction[0], 0.0, 1.0, 0.0],
            [0.0, -friction[1], 0.0, 1.0],
            [-1.0, 0.0, 0.0, 0.0],
            [0.0, -1.0, 0.0, 0.0],
        ]
    )
    best, least = np.zeros(4), np.inf
    for active in (set_ for size in (0, 1, 2) for set_ in combinations(range(4), size)):
        rows = np.vstack([equal, bounds[list(active)]])
        right = np.concatenate([[f_n, f_t], np.zeros(len(active))])
        # The shortest vector that satisfies the active rows.
        candidate = np.linalg.lstsq(rows, right, rcond=None)[0]
        slack = 1e-12 * (abs(f_n) + f_t)
        solves = bool(np.all(np.abs(rows @ candidate - right) <= slack))
        if solves and np.all(bounds @ candidate <= slack) and candidate @ candidate < least:
            best, least = candidate, float(candidate @ candidate)
    return best[:2], best[2:]
