"""The description of a dual-arm cell as frozen, validated records.

Units are SI throughout: m, rad, kg, s, N, N m. A transform `T_a_b` is a (4, 4) homogeneous matrix
that maps coordinates of frame b into frame a, so that `T_a_c = T_a_b @ T_b_c`.

Frames: `world` (z up), one `base` per robot, its `flange`, its `pad` (origin at the centre of the
contact patch, z along the contact normal, pointing from the robot into the box) and the `box`
(origin at the geometric centre of the payload, axes along its edges).

Arrays are read-only. Nothing in the records depends on a solver or on a file format;
`symbolic.read.cell` reads them from TOML.
"""

from symbolic.records.cell import (
    PAYLOAD_NAME,
    SEARCHED_BRANCH,
    USUAL_UNCERTAINTY,
    CollisionSettings,
    Contact,
    Driver,
    Handling,
    IgnoredPair,
    Payload,
    Robot,
    ToolLoad,
    Uncertainty,
    Workcell,
)
from symbolic.records.shapes import Body, Box, Capsule, Cylinder, Mesh, Shape, Sphere
from symbolic.records.task import (
    POSE_SIZE,
    AllowedContact,
    RedundantJoint,
    Task,
    Waypoint,
)

__all__ = [
    "PAYLOAD_NAME",
    "POSE_SIZE",
    "SEARCHED_BRANCH",
    "USUAL_UNCERTAINTY",
    "AllowedContact",
    "Body",
    "Box",
    "Capsule",
    "CollisionSettings",
    "Contact",
    "Cylinder",
    "Driver",
    "Handling",
    "IgnoredPair",
    "Mesh",
    "Payload",
    "RedundantJoint",
    "Robot",
    "Shape",
    "Sphere",
    "Task",
    "ToolLoad",
    "Uncertainty",
    "Waypoint",
    "Workcell",
]
