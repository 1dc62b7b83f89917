"""Where the joints are in the world, as expressions."""

from __future__ import annotations

import casadi as ca
import numpy as np

from symbolic.array import Array


def world_placements(
    T_world_root: Array, placements: tuple[ca.SX, ca.SX]
) -> list[tuple[ca.SX, ca.SX]]:
    """Rotation and position in the world of each joint frame given in the root."""
    rotations, positions = placements
    T = ca.SX(clean(T_world_root))
    return [
        (
            ca.mtimes(T[:3, :3], rotations[:, 3 * j : 3 * j + 3]),
            ca.mtimes(T[:3, :3], positions[:, j]) + T[:3, 3],
        )
        for j in range(positions.shape[1])
    ]


def clean(matrix: Array) -> Array:
    """Entries within 1e-15 of -1, 0 or 1 made exact, so that expressions simplify."""
    rounded = np.round(matrix)
    near = (np.abs(matrix - rounded) < 1e-15) & (np.abs(rounded) <= 1.0)
    return np.where(near, rounded, matrix)
