"""Collision shapes, and bodies that have one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from symbolic.array import Array


@dataclass(frozen=True)
class Box:
    """A cuboid centred at its frame. size: (3,) full edge lengths [m]."""

    size: Array


@dataclass(frozen=True)
class Cylinder:
    """A cylinder centred at its frame, axis along z. radius, length [m]."""

    radius: float
    length: float


@dataclass(frozen=True)
class Sphere:
    """A sphere centred at its frame. radius [m]."""

    radius: float


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh file (STL, OBJ, PLY or OFF). scale: (3,) factor per axis."""

    path: Path
    scale: Array


Shape = Box | Cylinder | Sphere | Mesh


@dataclass(frozen=True)
class Body:
    """A named collision shape.

    Attributes:
        name: unique within its owner.
        shape: its geometry.
        pose: (4, 4), the shape's frame in its parent frame (world for the environment,
            flange for a tool).
    """

    name: str
    shape: Shape
    pose: Array
