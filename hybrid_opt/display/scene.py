"""The cell in three dimensions for a browser: what `scene.js` draws, and the library it needs."""

from __future__ import annotations

import base64
import json
from collections.abc import Collection
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import Carry
from hybrid_opt.display.solids import Solid, cell_solids, extent_points
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry
from symbolic.records.poses import Orientation

_VIEWED = 12
"""About as many samples of a carry decide where its scene is looked at from."""


def scene_data(
    geometry: CellGeometry, carry: Carry, marked: Collection[str] = ()
) -> dict[str, Any]:
    """Shapes, joints and a good place to look from, as JSON values.

    Args:
        marked: names of bodies that are shown in red.
    """
    points = motion_points(geometry, carry.pose, carry.q)
    lower, upper = points.min(axis=0), points.max(axis=0)
    return {
        "arms": [
            {
                "root": arm.T_world_root.ravel().tolist(),
                "origins": [origin.ravel().tolist() for origin in arm.origins],
                "axes": arm.axes.tolist(),
                "turning": list(arm.turning),
            }
            for arm in geometry.arms
        ],
        "orientation": _orientation(geometry.workcell.task.orientation),
        "solids": [_solid(solid, solid.name in marked) for solid in cell_solids(geometry)],
        "view": {
            "centre": ((lower + upper) / 2.0).tolist(),
            "radius": float(np.linalg.norm(upper - lower)) / 2.0,
        },
    }


def motion_points(geometry: CellGeometry, pose: Array, q: Array) -> Array:
    """(k, 3) what a picture of a whole motion has to show, see `extent_points`."""
    every = slice(None, None, max(1, len(pose) // _VIEWED))
    return extent_points(geometry, cell_solids(geometry), pose[every], q[every])


def scene_js() -> str:
    """The script that draws a scene; it needs three.js before it."""
    return (files("hybrid_opt.display") / "scene.js").read_text("utf-8")


def three_js() -> str:
    """three.js with its licence line."""
    return (files("hybrid_opt.display") / "vendor" / "three.min.js").read_text("utf-8")


def embedded_json(document: Any) -> str:
    """JSON for a script element: no text in it can end the element or open another."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def packed(values: NDArray[Any], kind: type[np.generic]) -> str:
    """Little-endian numbers in base64."""
    return base64.b64encode(
        np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<")).tobytes()
    ).decode("ascii")


def _orientation(orientation: Orientation) -> dict[str, Any]:
    """How the page reads the last three numbers of a pose; the reference as x y z w."""
    reference = Rotation.from_matrix(orientation.reference).as_quat()
    return {"vector": orientation.is_vector, "reference": reference.tolist()}


def _solid(solid: Solid, marked: bool) -> dict[str, Any]:
    return {
        "group": "marked" if marked else solid.group,
        "ground": solid.is_ground,
        "kind": solid.frame.kind,
        "robot": solid.frame.robot,
        "joint": solid.frame.joint,
        "vertices": packed(solid.vertices, np.float32),
        "faces": packed(solid.faces, np.uint16),
    }
