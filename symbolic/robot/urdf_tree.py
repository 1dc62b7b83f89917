"""Whether the links and joints of a URDF are a tree, and no joint follows itself."""

from __future__ import annotations

from collections.abc import Mapping

from symbolic.workcell.problems import suggestion


def tree_problem(
    links: tuple[str, ...], joints: Mapping[str, tuple[str, str]]
) -> tuple[str, str] | None:
    """Why links and joints are no tree, as (element, text); None where they are one.

    Args:
        links: names.
        joints: parent and child link by joint.
    """
    if not links:
        return "robot", "has no links; allowed is a tree of links and joints"
    moved_by: dict[str, str] = {}
    for joint, ends in joints.items():
        for role, link in zip(("parent", "child"), ends, strict=True):
            if link not in links:
                hint = suggestion(link, links)
                return f"joint {joint!r}/{role} link", f"found {link!r}, no link of the file{hint}"
        parent, child = ends
        if parent == child:
            return f"joint {joint!r}", f"its parent and its child are the same link {child!r}"
        if child in moved_by:
            return (
                f"joint {joint!r}/child link",
                f"found {child!r}, which is the child of joint {moved_by[child]!r} already; "
                "allowed is a tree",
            )
        moved_by[child] = joint
    roots = [link for link in links if link not in moved_by]
    if not roots:
        return "robot", "every link is the child of a joint, so they form a loop; allowed is a tree"
    if len(roots) > 1:
        listed = ", ".join(map(repr, roots[:5])) + (" ..." if len(roots) > 5 else "")
        return "robot", f"found {len(roots)} links without parent ({listed}); allowed is one root"
    for start in links:
        met, link = {start}, start
        while link in moved_by:
            link = joints[moved_by[link]][0]
            if link in met:
                return f"link {link!r}", "is part of a loop of joints; allowed is a tree"
            met.add(link)
    return None


def mimic_problem(mimics: Mapping[str, str]) -> tuple[str, str] | None:
    """Why joints that follow others follow none, as (element, text); None where all is well.

    Args:
        mimics: the followed joint by the following one.
    """
    for name in mimics:
        met, followed = {name}, mimics[name]
        while followed in mimics:
            if followed in met:
                return f"joint {name!r}/mimic joint", "joints follow one another in a circle"
            met.add(followed)
            followed = mimics[followed]
    return None
