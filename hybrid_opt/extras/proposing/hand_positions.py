"""Positions on a box for hands that hold by themselves: faces, heights and turns, ranked by the
holding force that the payload at rest requires in every case of the uncertainty.

All hands of an arm move as one pattern, such as an array of cups or the fingers of a gripper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from hybrid_opt.extras.proposing.kinematics import covers_the_same, moved, rotate_about_normal
from hybrid_opt.robust.budget import required_at_rest
from symbolic.array import Array
from symbolic.geometry.bodies import arm_geometry, collision_bodies
from symbolic.geometry.pairs import tools_in_payload
from symbolic.read.payload import pad_rotation
from symbolic.records import Contact, Workcell
from symbolic.records.poses import inverse, pose_matrix, transform

HEIGHTS = ((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0), (1.0, 0.0), (-1.0, 0.0))
"""Tried positions of hands on opposite faces, the same for both arms, along both axes of the face.
The unit is the free distance between hands and edges; the first axis points upwards on upright
faces."""

BESIDE = tuple(k * np.array(way) for way in ((1, 0), (-1, 0), (0, 1), (0, -1)) for k in (1.0, 0.5))
"""Tried positions of the first arm's hands if both arms' hands share a face: at the edges and
halfway to them. The other arm's hands are placed opposite."""

EDGE = 0.005
"""Least distance of a patch from the edges of its face [m]."""

DOWNWARDS = -0.7
"""Vertical component of a face's outward normal below which no hand can reach the face."""

MOST_PROPOSALS = 16
"""Largest number of pairs of positions of both arms' hands that are returned."""

Both = tuple[Contact, Contact]

Entry = dict[str, Any]
"""The keys `xyz`, `spin`, `normal` and `further` of an entry of `[[contacts]]`."""


def pattern_entry(entry: Entry, thickness: float) -> Entry:
    """Return the table of a contact in a file, with positions and normals of all its hands added.

    They are in the frame of the first hand, whose z axis points into the payload.

    Args:
        entry: table of the contact in the problem file, without `xyz`. The `xyz` of the hands in
            `further` are already relative to the first hand.
        thickness: thickness of the payload [m]. It decides where the opposite finger of a gripper
            is, if the table has no `further`.
    """
    further = entry.get("further", [])
    if entry.get("kind") == "fingers" and not further:
        further = [{"xyz": [0.0, 0.0, thickness]}]
    normals = [[0.0, 0.0, -1.0 if other["xyz"][2] > EDGE / 2.0 else 1.0] for other in further]
    further = [other | {"normal": n} for other, n in zip(further, normals, strict=True)]
    first = {"xyz": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
    return entry | first | ({"further": further} if further else {})


def contact_entry(contact: Contact, with_normals: bool = False) -> Entry:
    """Return the keys of a contact's table in a file that state where its hands or pads are on the
    box: `xyz`, `spin` and `further`.

    Args:
        contact: the contact.
        with_normals: True to include the key `normal`.
    """
    entries: list[Entry] = []
    for pad in (contact, *contact.further):
        R = pad.T_box_pad[:3, :3]
        x, y, _ = pad_rotation(R[:, 2], 0.0).T @ R[:, 0]
        entry: Entry = {"xyz": _plain(pad.T_box_pad[:3, 3]), "spin": _plain(np.arctan2(y, x))}
        entries.append(entry | ({"normal": _plain(R[:, 2])} if with_normals else {}))
    first, *further = entries
    return first | ({"further": further} if further else {})


def hand_positions(
    patterns: Sequence[Contact],
    size: Array,
    rotations: Array,
    along: Array,
    workcell: Callable[[list[Entry]], Workcell],
) -> list[list[Entry]]:
    """Propose positions of both arms' hands on a box.

    Positions with which the box at rest needs a small share of the hands' holding force come first.
    Positions with which the arms would cross are left out.

    Args:
        patterns: contact of each arm, with its hands placed relative to the first one as by
            `pattern_entry`.
        size: (3,) edges of the box [m].
        rotations: (n, 3, 3) R_world_box at the ends of the carry.
        along: (3,) vector from robot 2 to robot 1 in the box frame; zeros if unknown.
        workcell: function that reads the cell with given tables of both contacts.

    Returns:
        For each proposal the tables of both contacts, as in a file.
    """
    pairs = [
        (first, second)
        for first, second in _pairs(patterns, size, rotations)
        if (_points(first).mean(axis=0) - _points(second).mean(axis=0)) @ along > -EDGE
    ]
    if not pairs:
        return []
    cell = workcell([contact_entry(contact) for contact in pairs[0]])
    pairs = list(_with_tools_outside(cell, pairs))

    def share(pair: Both) -> float:
        required = required_at_rest(replace(cell, contacts=pair))
        return round(float((required / cell.task.reference_force).max()), 3)

    best = sorted(pairs, key=share)[:MOST_PROPOSALS]
    return [[contact_entry(contact) for contact in pair] for pair in best]


def _with_tools_outside(cell: Workcell, pairs: Sequence[Both]) -> Iterator[Both]:
    """Yield those pairs of contacts at which neither robot's tool enters the payload.

    Args:
        cell: cell with the robots, tools and payload. Its own contacts serve only to find the pose
            of each pad in the frame of its arm's last joint.
        pairs: contacts of both arms, one pair per proposal.
    """
    bodies, arms = collision_bodies(cell), [arm_geometry(cell, arm) for arm in (0, 1)]
    T_joint_pad = [
        arm.T_joint_box @ contact.T_box_pad
        for arm, contact in zip(arms, cell.contacts, strict=True)
    ]
    for pair in pairs:
        held = [
            T @ inverse(contact.T_box_pad) for T, contact in zip(T_joint_pad, pair, strict=True)
        ]
        if not any(tools_in_payload(bodies, held)):
            yield pair


def _pairs(patterns: Sequence[Contact], size: Array, rotations: Array) -> Iterator[Both]:
    """Yield contacts of both arms on faces of a box that are free at both ends of the carry.

    Cups and magnets are placed on opposite faces or together on one face; fingers around the edges
    of the thinnest side.

    Args:
        patterns: contact of each arm, with its hands placed relative to the first one.
        size: (3,) edges of the box [m].
        rotations: (n, 3, 3) R_world_box at the ends of the carry.
    """
    quarters = np.pi / 2.0 * np.arange(4)
    turned = [rotate_about_normal(pattern, quarters[1]) for pattern in patterns]
    is_same = all(map(covers_the_same, patterns, turned))
    grips = any(pattern.kind == "fingers" for pattern in patterns)
    turns = [(turn, turn) for turn in quarters[: 1 if is_same else 2]]
    for axis, side in product(range(3), (1.0, -1.0)):
        outward = side * np.eye(3)[axis]
        upward = (rotations @ outward)[:, 2]
        pairs: list[tuple[Array, Array]] = []
        if grips and size[axis] == size.min():
            turns = list(product(quarters, quarters))
            pairs = [(outward, -way) for way in BESIDE[::2]]
        if not grips and upward.min() >= DOWNWARDS:
            pairs = [(outward, -way) for way in BESIDE]
            if upward.max() <= -DOWNWARDS:
                pairs += [(-outward, way) for way in map(np.array, HEIGHTS)]
        for (face, way), (one, other) in product(pairs, turns):
            own_way = way if face is not outward else -way
            first = _placed(patterns[0], outward, size, one, own_way)
            second = _placed(patterns[1], face, size, other, way)
            if first and second and not _overlap(first, second):
                yield first, second


def _placed(
    pattern: Contact, outward: Array, size: Array, turn: float, at: Array
) -> Contact | None:
    """Return a contact with its hands on a face of a box; None if the face has too little room.

    Args:
        pattern: contact with its hands placed relative to the first one.
        outward: (3,) outward normal of the face in the box frame, along one of its axes.
        size: (3,) edges of the box [m].
        turn: rotation of the hands about the normal of the face [rad].
        at: (2,) position of the hands on the face, along the face's two axes: 0 is its middle,
            -1 and 1 are its edges.
    """
    face = pad_rotation(-outward, 0.0)
    rotation = face @ pose_matrix(np.zeros(3), np.array([0.0, 0.0, turn]))[:3, :3]
    reach = np.array([_reach(pad) for pad in (pattern, *pattern.further)])
    low = (_points(pattern)[:, :2] - reach).min(axis=0)
    high = (_points(pattern)[:, :2] + reach).max(axis=0)
    half = np.abs(rotation[:, :2]) @ (high - low) / 2.0
    room = np.abs(face[:, :2].T) @ (size / 2.0 - half) - EDGE
    if (room < 0.0).any():
        return None
    middle = outward * size / 2.0 + face[:, :2] @ (room * at)
    return moved(pattern, transform(rotation, middle - rotation[:, :2] @ (low + high) / 2.0))


def _reach(pad: Contact) -> Array:
    """Compute half the extent (2,) of a pad's patch along the x and y axes of the pad frame [m]."""
    if pad.half_sides is None:
        return np.full(2, pad.patch_radius)
    return np.asarray(np.abs(pad.T_box_pad[:2, :2]) @ pad.half_sides)


def _points(contact: Contact) -> Array:
    return np.array([pad.T_box_pad[:3, 3] for pad in (contact, *contact.further)])


def _overlap(one: Contact, other: Contact) -> bool:
    """Return True if the circles around the patches of two contacts intersect.

    Args:
        one: a contact, with all its hands.
        other: another contact, with all its hands.
    """
    apart = np.linalg.norm(_points(one)[:, None] - _points(other), axis=2)
    return bool(apart.min() < one.patch_radius + other.patch_radius)


def _plain(values: Any) -> Any:
    return (np.round(values, 9) + 0.0).tolist()
