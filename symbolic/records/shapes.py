"""Collision shapes, and bodies that have one."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np

from symbolic.array import Array, BroadcastScalar, Vector
from symbolic.records import quantities as quantity
from symbolic.records.poses import read_only


@dataclass(frozen=True)
class Box:
    """A cuboid centred at its frame.

    Attributes:
        size: (3,) full edge lengths [m].
    """

    size: Annotated[Vector, quantity.SHAPE_SIZE]


@dataclass(frozen=True)
class Cylinder:
    """A cylinder centred at its frame, with its axis along z.

    Attributes:
        radius: radius [m].
        length: length along z [m].
    """

    radius: Annotated[float, quantity.SHAPE_SIZE]
    length: Annotated[float, quantity.SHAPE_SIZE]


@dataclass(frozen=True)
class Sphere:
    """A sphere centred at its frame.

    Attributes:
        radius: radius [m].
    """

    radius: Annotated[float, quantity.SHAPE_SIZE]


Scale = Annotated[Vector, quantity.SCALE, BroadcastScalar()]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh file (STL, OBJ, PLY or OFF).

    Attributes:
        path: path of the file.
        scale: (3,) factors from the file's coordinates to metres, one per axis.
    """

    path: Path
    scale: Scale = field(default_factory=lambda: read_only(np.ones(3)))


Shape = Box | Cylinder | Sphere | Mesh


@dataclass(frozen=True)
class Body:
    """A named collision shape.

    Attributes:
        name: name of the body, unique within the cell or the robot.
        shape: geometry of the body.
        pose: (4, 4) frame of the shape in its parent frame: the world for a body of the
            environment, the flange for a body of a tool.
    """

    name: str
    shape: Shape
    pose: Array


@dataclass(frozen=True)
class Capsule:
    """A line segment along z, centred at its frame and thickened by a radius.

    Attributes:
        radius: radius [m].
        length: distance between the centres of the end spheres [m].
    """

    radius: Annotated[float, quantity.SHAPE_SIZE]
    length: Annotated[float, quantity.SHAPE_SIZE]
