"""The cell in three dimensions: data for `scene.js` in a browser, and a page that plays a carry."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Collection
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import Carry
from hybrid_opt.display.objects import heading_of
from hybrid_opt.display.solids import Solid, cell_solids, motion_points
from hybrid_opt.errors import DisplayError
from symbolic.geometry.pairs import CellGeometry, build_geometry


def scene_data(
    geometry: CellGeometry, carry: Carry, marked: Collection[str] = ()
) -> dict[str, Any]:
    """Collect what `scene.js` needs to draw a cell: shapes, arms, contacts, and the region in view,
    as JSON values by name.

    Args:
        geometry: bodies of the cell.
        carry: carry whose moving bodies are to be in view.
        marked: names of bodies that are drawn in red.
    """
    points = motion_points(geometry, carry.pose, carry.q, moving=True)
    lower, upper = points.min(axis=0), points.max(axis=0)
    # How the page reads the last three numbers of a pose; the reference as x y z w.
    orientation = geometry.workcell.task.orientation
    reference = Rotation.from_matrix(orientation.reference).as_quat()
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
        "orientation": {"vector": orientation.is_vector, "reference": reference.tolist()},
        # Where each arm presses in the box's frame, and which way.
        "contacts": [
            {"at": contact.T_box_pad[:3, 3].tolist(), "along": contact.T_box_pad[:3, 2].tolist()}
            for contact in geometry.workcell.contacts
        ],
        "solids": [_solid(solid, solid.name in marked) for solid in cell_solids(geometry)],
        # A box around what moves.
        "view": {"lower": lower.tolist(), "upper": upper.tolist()},
    }


THREE, PLOTLY = "vendor/three.min.js", "vendor/plotly-basic.min.js"
"""Scripts that `scene.js` needs, and the script that draws points, lines and bars; with licence
lines."""


def asset(name: str) -> str:
    """Read the text of a script or page in the folder of `hybrid_opt.display`."""
    return (files("hybrid_opt.display") / name).read_text("utf-8")


def embedded_json(document: Any) -> str:
    """Convert JSON values to text for an HTML script element. No part of the text can end the
    element or begin another one.
    """
    text = json.dumps(document, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def packed(values: NDArray[Any], kind: type[np.generic]) -> str:
    """Encode an array as base64 text of little-endian bytes.

    Args:
        values: the array.
        kind: NumPy type in which the numbers are encoded.
    """
    return base64.b64encode(
        np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<")).tobytes()
    ).decode("ascii")


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


MAX_SAMPLES = 200
"""Largest number of samples of a carry that are played."""


@dataclass(frozen=True)
class Look:
    """First view of a carry when its page opens.

    Attributes:
        sample: index of the sample of the carry that is shown.
        text: caption of the view.
        bodies: names of the bodies that are drawn in red.
    """

    sample: int
    text: str
    bodies: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class CarryView:
    """A self-contained page that plays a carry. Drag orbits, right-drag pans, the wheel zooms.

    Attributes:
        carry: the carry.
        height: height of the notebook's cell [px].
        look: first view of the page; None for the first sample.
    """

    carry: Carry
    height: int = 480
    look: Look | None = None

    def page(self) -> str:
        """Return the text of the page. It needs no network and contains all its scripts."""
        carry = self.carry
        rows = np.unique(np.linspace(0, len(carry) - 1, min(len(carry), MAX_SAMPLES)).astype(int))
        columns = [carry.time[:, None] - carry.time[0], carry.pose, carry.q]
        samples = np.concatenate(columns, axis=1)[rows]
        look = self.look or Look(0, "")
        document = scene_data(build_geometry(carry.workcell), carry, look.bodies) | {
            "samples": packed(samples, np.float32),
            "width": samples.shape[1],
            "numbers": rows.tolist(),
            "begin": float(carry.time[look.sample] - carry.time[0]),
        }
        return Template(asset("view.html")).substitute(
            title=html.escape(heading_of(carry)),
            note=html.escape(look.text),
            data=embedded_json(document),
            three=asset(THREE).replace("</script", "<\\/script"),
            scene=asset("scene.js"),
            player=asset("view.js"),
        )

    def save(self, path: str | Path) -> None:
        """Write the page into a file.

        Args:
            path: path of the file.

        Raises:
            DisplayError: the file cannot be written.
        """
        try:
            Path(path).write_text(self.page(), encoding="utf-8")
        except OSError as error:
            raise DisplayError(
                f"{path}: cannot be written ({error.strerror})", code="not-writable"
            ) from error

    def __repr__(self) -> str:
        return (
            f"View of: {heading_of(self.carry)} (shown in a notebook; save('view.html') elsewhere)"
        )

    def _repr_html_(self) -> str:
        page = html.escape(self.page(), quote=True)
        return (
            f'<iframe srcdoc="{page}" sandbox="allow-scripts" '
            f'style="width:100%;height:{self.height}px;border:0"></iframe>'
        )
