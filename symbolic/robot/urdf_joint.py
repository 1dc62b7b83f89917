"""The joints of a URDF, and the poses of its elements, checked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from xml.etree import ElementTree

import numpy as np

from symbolic.array import Array
from symbolic.physics.pose import pose_matrix
from symbolic.robot.urdf_elements import Part
from symbolic.workcell import quantities as quantity
from symbolic.workcell.problems import shown
from symbolic.workcell.reader import read_only

JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
SMALLEST_AXIS = 1e-6
FULL_TURNS = 4.0 * np.pi
"""A continuous joint is taken as a revolute one with these limits either way [rad]."""


@dataclass(frozen=True)
class UrdfJoint:
    """A joint of the tree of links.

    Attributes:
        kind: one of `JOINT_TYPES`.
        parent, child: names of links.
        lower, upper: limits [rad or m]; of a continuous joint `FULL_TURNS` either way.
        mimics: the joint that it follows, '' where it moves by itself.
        multiplier, offset: its position is multiplier * (the other's) + offset.
    """

    kind: str
    parent: str
    child: str
    lower: float
    upper: float
    mimics: str = ""
    multiplier: float = 1.0
    offset: float = 0.0


def read_joint(joint: Part, name: str) -> tuple[ElementTree.Element, UrdfJoint]:
    """The checked element of a joint, and what it says."""
    kind = joint.choice("type", JOINT_TYPES)
    # Pinocchio gives a continuous joint two coordinates; here every moving joint has one.
    kept = ElementTree.Element(
        "joint", {"name": name, "type": "revolute" if kind == "continuous" else kind}
    )
    parent, child = joint.required("parent"), joint.required("child")
    kept.extend(origin_element(joint))
    ElementTree.SubElement(kept, "parent", parent.written("link"))
    ElementTree.SubElement(kept, "child", child.written("link"))
    axis = joint.child("axis")
    if axis is not None and kind not in ("fixed", "floating"):
        direction = axis.numbers("xyz", (quantity.DIRECTION,) * 3)
        if axis.problems.clean(axis.path) and np.linalg.norm(direction) < SMALLEST_AXIS:
            axis.problems.add(
                f"{axis.path} xyz",
                f"found {shown(axis.raw('xyz'))}, an axis without length; allowed is a direction "
                "such as '0 0 1'",
            )
        ElementTree.SubElement(kept, "axis", axis.written("xyz"))
    limit = joint.child("limit")
    if kind in ("revolute", "prismatic"):
        limit = joint.required("limit")
    lower = upper = 0.0
    if limit is not None:
        for key in ("effort", "velocity"):
            limit.number(key, quantity.JOINT_MOST)
        lower, upper = (limit.number(key, quantity.JOINT_LIMIT, "0") for key in ("lower", "upper"))
    written = {} if limit is None else limit.written("lower", "upper", "effort", "velocity")
    if kind == "continuous":
        lower, upper = -FULL_TURNS, FULL_TURNS
        written = {"effort": "0", "velocity": "0"} | written
        written |= {"lower": repr(lower), "upper": repr(upper)}
    if written:
        ElementTree.SubElement(kept, "limit", written)
    dynamics = joint.child("dynamics")
    if dynamics is not None:
        for key in ("damping", "friction"):
            dynamics.number(key, quantity.JOINT_LIMIT, "0")
        ElementTree.SubElement(kept, "dynamics", dynamics.written("damping", "friction"))
    found = UrdfJoint(kind, parent.text("link"), child.text("link"), lower, upper)
    mimic = joint.child("mimic")
    if mimic is None:
        return kept, found
    return kept, replace(
        found,
        mimics=mimic.text("joint"),
        multiplier=mimic.number("multiplier", quantity.JOINT_LIMIT, "1"),
        offset=mimic.number("offset", quantity.JOINT_LIMIT, "0"),
    )


def origin_element(part: Part) -> list[ElementTree.Element]:
    """The checked origin of an element, if it has one."""
    origin = part.child("origin")
    if origin is None:
        return []
    pose_of(part)
    return [ElementTree.Element("origin", origin.written("xyz", "rpy"))]


def pose_of(part: Part) -> Array:
    """(4, 4) of an element's origin; the identity where it has none."""
    origin = part.child("origin")
    if origin is None:
        return read_only(np.eye(4))
    xyz = origin.numbers("xyz", (quantity.POSITION,) * 3, "0 0 0")
    rpy = origin.numbers("rpy", (quantity.URDF_ANGLE,) * 3, "0 0 0")
    return read_only(pose_matrix(xyz, rpy))
