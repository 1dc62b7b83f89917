"""Directions along which bodies are compared beside the world's axes."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.geometry.bodies import CollisionBody
from symbolic.geometry.enclosing import axes_with_z
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import Piece, edges, support
from symbolic.geometry.placements import clean

Interval = tuple[ca.SX, ca.SX]
"""Least and largest coordinate along a direction."""


LONG = 0.25
"""Bodies longer than wide by more than this [m] are also compared along their own axes: across
the world's axes, a slanted body seems wider by up to that much."""


VAST = 2.0
"""Obstacles this many times as wide as a body is long (a floor) need no such comparison."""


@dataclass(frozen=True)
class Axes:
    """Three orthogonal directions: rows of A (3, 3)."""

    key: str
    A: ca.SX


def slanted_matters(body: CollisionBody, obstacle: Piece) -> bool:
    """Whether a body is long, and the obstacle no plane for it."""
    _, width, length = edges(body.pieces)
    return bool(length - width > LONG and edges((obstacle,))[1] < VAST * length)


def between_bases(geometry: CellGeometry) -> Axes | None:
    """Axes whose first points from one robot's base to the other's; None if the world's do."""
    first, second = (arm.T_world_root[:3, 3] for arm in geometry.arms)
    along = second - first
    distance = float(np.linalg.norm(along))
    if distance < 1e-6 or np.max(np.abs(along)) > 0.99 * distance:
        return None
    return Axes("between", ca.SX(clean(axes_with_z(along / distance)[:, [2, 0, 1]].T)))


def fixed_intervals(piece: Piece, A: Array) -> list[Interval]:
    """Along the rows of A (3, 3), of a piece that does not move."""
    high, low = support(piece, A), -support(piece, -A)
    return [(ca.SX(low[k]), ca.SX(high[k])) for k in range(3)]
