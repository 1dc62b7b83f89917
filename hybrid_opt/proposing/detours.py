"""Ways around what stands between start and goal that the box alone could go.

Places for robots are compared by them: from behind what the box has to come out of, or from too
near to take it back far enough, arms do not follow.
"""

from __future__ import annotations

import numpy as np

from symbolic.array import Array
from symbolic.geometry.bodies import MeshReader, shape_pieces
from symbolic.geometry.pairs import coal_distance
from symbolic.records import Workcell
from symbolic.records.poses import box_placement

LIFT = 0.03
"""How far the box is lifted off what it stands on, and lowered in the end [m]."""

ASIDE = (0.15, 0.25, 0.40)
"""How far it goes aside, level in eight directions or up [m]."""

POSES = 33
"""Of a detour."""


def free_detours(workcell: Workcell, start: Array, goal: Array) -> Array:
    """(k, POSES, 6) box poses: up a little, aside, over to beside the goal, back, down. Those of
    them on which the box meets nothing of the environment between its lifts, 0 or more.

    Args:
        start, goal: (6,) box poses.
    """
    angles = np.arange(8) * np.pi / 4.0
    ways = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(8)])
    ways = np.vstack([ways, [0.0, 0.0, 1.0]])
    found = [_detour(start, goal, away * way) for away in ASIDE for way in ways]
    straight = _detour(start, goal, np.zeros(3))
    return np.array([path for path in (straight, *found) if _free(workcell, path)]).reshape(
        -1, POSES, 6
    )


def _detour(start: Array, goal: Array, aside: Array) -> Array:
    lift = np.array([0.0, 0.0, LIFT, 0.0, 0.0, 0.0])
    beside = np.append(aside, np.zeros(3))
    corners = [start, start + lift, start + lift + beside]
    corners += [end + lift + beside * far for end, far in ((goal, 1.0), (goal, 0.0))] + [goal]
    points = np.array(corners)
    length = np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1)
    length[2] = max(length[2], 1e-3)  # a turn on the spot takes place there
    along = np.concatenate([[0.0], np.cumsum(np.maximum(length, 1e-9))])
    places = np.linspace(0.0, along[-1], POSES)
    return np.column_stack([np.interp(places, along, points[:, k]) for k in range(6)])


def _free(workcell: Workcell, path: Array) -> bool:
    """Whether the box meets nothing on a detour, its lifts at both ends left out."""
    meshes, payload = MeshReader(), workcell.payload.solid
    standing = [
        shape_pieces(body.shape, body.pose, body.name, meshes) for body in workcell.environment
    ]
    for pose, to_start, to_goal in zip(path, path - path[0], path - path[-1], strict=True):
        if min(np.abs(to_start).max(), np.abs(to_goal).max()) < LIFT:
            continue
        T_world_box = box_placement(workcell.task.orientation, pose)
        box = shape_pieces(payload, T_world_box, "the payload", meshes)
        if any(coal_distance(box, pieces) <= 0.0 for pieces in standing):
            return False
    return True
