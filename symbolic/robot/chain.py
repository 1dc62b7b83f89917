"""A chain of joints picked from a robot's description; every other joint is held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType
from xml.etree import ElementTree

import numpy as np

from symbolic.errors import RobotModelError
from symbolic.robot.urdf_file import Urdf
from symbolic.robot.urdf_joint import UrdfJoint
from symbolic.workcell.patterns import matching
from symbolic.workcell.problems import suggestion

Held = tuple[tuple[str, float], ...]


def chain_joints(urdf: Urdf, root: str, tip: str) -> tuple[str, ...]:
    """The joints between two links that move, from the root to the tip.

    Raises:
        RobotModelError: a link does not exist, or the tip does not hang on the root.
    """
    links = urdf.links
    for link in (root, tip):
        if link not in links:
            raise RobotModelError(
                f"found {link!r}, no link of {urdf.file}"
                f"{suggestion(link, links) or f'; it has {listed(links)}'}"
            )
    moved_by = {joint.child: name for name, joint in urdf.joints.items()}
    found: list[str] = []
    link = tip
    while link != root:
        if link not in moved_by:
            raise RobotModelError(
                f"{tip!r} does not hang on {root!r}; allowed are two links one behind the other"
            )
        found.append(moved_by[link])
        link = urdf.joints[moved_by[link]].parent
    return tuple(name for name in reversed(found) if urdf.joints[name].kind != "fixed")


def held_joints(urdf: Urdf, moving: Sequence[str], locked: Held) -> Held:
    """Every joint of a description that does not move, with the position it is held at.

    That is the one of `locked`, else zero or the nearest that its limits allow; a joint that
    mimics another stands where that one puts it.

    Args:
        urdf: the description.
        moving: joints that move.
        locked: joints and positions that the user gives [rad or m].

    Raises:
        RobotModelError: a locked joint does not exist, or a joint mimics one that moves.
    """
    given = dict(locked)
    for name in given:
        _require_joint(urdf, name)
    positions: dict[str, float] = {}

    def position(name: str) -> float:
        if name not in positions:
            positions[name] = _held_at(name, urdf.joints[name])
        return positions[name]

    def _held_at(name: str, joint: UrdfJoint) -> float:
        if name in given:
            return given[name]
        if not joint.mimics:
            return float(np.clip(0.0, joint.lower, joint.upper))
        if joint.mimics in moving:
            raise RobotModelError(
                f"joint {name!r} mimics {joint.mimics!r}, which moves; hold it (locked_joints) or "
                "drop its links (drop_links)"
            )
        return joint.multiplier * position(joint.mimics) + joint.offset

    for name in moving:
        if urdf.joints[name].mimics:
            raise RobotModelError(
                f"joint {name!r} of the chain mimics {urdf.joints[name].mimics!r}; allowed are "
                "joints that move by themselves"
            )
    return tuple(
        (name, position(name))
        for name, joint in urdf.joints.items()
        if joint.kind != "fixed" and name not in moving
    )


def _require_joint(urdf: Urdf, name: str) -> None:
    moving = [other for other, joint in urdf.joints.items() if joint.kind != "fixed"]
    if name not in moving:
        raise RobotModelError(
            f"no moving joint {name!r} in {urdf.file}"
            f"{suggestion(name, moving) or f'; it has {listed(moving)}'}"
        )


def without_links(urdf: Urdf, patterns: tuple[str, ...]) -> Urdf:
    """A description without some links, all that hangs on them, and the joints that move these.

    Args:
        urdf: the description.
        patterns: names of links, or patterns with `*` and `?`.

    Raises:
        RobotModelError: a pattern matches no link, or every link would go.
    """
    dropped: set[str] = set()
    for pattern in patterns:
        found = matching(pattern, urdf.links)
        if not found:
            raise RobotModelError(
                f"found {pattern!r}, which matches no link of {urdf.file}"
                f"{suggestion(pattern, urdf.links) or f'; it has {listed(urdf.links)}'}"
            )
        dropped.update(found)
    waiting = list(dropped)
    while waiting:
        parent = waiting.pop()
        behind = {j.child for j in urdf.joints.values() if j.parent == parent} - dropped
        dropped |= behind
        waiting += behind
    if len(dropped) == len(urdf.links):
        raise RobotModelError(f"every link of {urdf.file} would be dropped; keep the arm")
    joints = {name: joint for name, joint in urdf.joints.items() if joint.child not in dropped}
    tree = ElementTree.fromstring(urdf.kinematics)
    for element in list(tree):
        kept = joints.keys() if element.tag == "joint" else set(urdf.links) - dropped
        if element.get("name") not in kept:
            tree.remove(element)
    return replace(
        urdf,
        links=tuple(link for link in urdf.links if link not in dropped),
        joints=MappingProxyType(joints),
        collisions=MappingProxyType(
            {link: found for link, found in urdf.collisions.items() if link not in dropped}
        ),
        visuals=MappingProxyType(
            {link: found for link, found in urdf.visuals.items() if link not in dropped}
        ),
        kinematics=ElementTree.tostring(tree, encoding="unicode"),
    )


def listed(names: Sequence[str], most: int = 20) -> str:
    """Names for a message, the first of many."""
    text = ", ".join(repr(name) for name in names[:most]) or "none"
    return f"{text} and {len(names) - most} more" if len(names) > most else text
