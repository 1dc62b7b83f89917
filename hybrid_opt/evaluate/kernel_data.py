"""The cell's bodies and a batch's arrays as kernel.c reads them."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.collision.checker import CollisionChecker
from hybrid_opt.collision.judge import FCL_RESOLUTION
from symbolic.array import Array
from symbolic.geometry.pieces import ConvexShape, Hull
from symbolic.records import PAYLOAD, POSE_SIZE, Box, Capsule, Cylinder, Sphere, Workcell

PROOF_MARGIN = 5 * FCL_RESOLUTION
"""How clearly two shapes must be apart or intersect to be decided without FCL [m]."""

_SHAPE = np.dtype(
    [("kind", np.int64), ("first", np.int64), ("count", np.int64), ("size", np.float64, 3)]
)
_RESTING = np.dtype([("pair", np.int64), ("place", np.float64, 3), ("departure", np.float64)])


def configuration_size(workcell: Workcell) -> int:
    """Entries of a configuration: box pose, joints of the first and of the second arm."""
    return POSE_SIZE + sum(len(robot.position_lower) for robot in workcell.robots)


def open_pair(workcell: Workcell) -> np.dtype[np.void]:
    """`open_pair` of kernel.c: a pair of a sample that is left to FCL."""
    return np.dtype(
        [
            ("candidate", np.int64),
            ("sample", np.int64),
            ("pair", np.int64),
            ("configuration", np.float64, configuration_size(workcell)),
        ]
    )


class JudgeData(ctypes.Structure):
    """`judge_data` of kernel.c."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("pairs", "first_piece", "shapes", "vertices")),
        *((name, ctypes.c_void_p) for name in ("resting", "free_beyond", "tolerance")),
        *((name, ctypes.c_longlong) for name in ("n_resting", "payload_piece", "resting_piece")),
        *((name, ctypes.c_double) for name in ("apart", "overlap")),
    ]


class BatchData(ctypes.Structure):
    """`batch_data` of kernel.c."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("x", "begin")),
        *((name, ctypes.c_longlong) for name in ("n", "with_collisions", "all_forces", "room")),
        *((name, ctypes.c_void_p) for name in ("time", "violation", "violation_time")),
        *((name, ctypes.c_void_p) for name in ("first_sample", "first_reason", "reached")),
        *((name, ctypes.c_void_p) for name in ("colliding", "wanted", "open")),
        ("n_open", ctypes.c_longlong),
    ]


def judge_arrays(checker: CollisionChecker) -> dict[str, NDArray[Any]]:
    """The memory that `judge_data` points into, to be kept as long as it."""
    geometry = checker.geometry
    bodies = [body.pieces for body in geometry.bodies]
    shapes = [piece.shape for pieces in bodies for piece in pieces]
    table, vertices = shape_table([*shapes, *checker.judge.resting_shapes])
    return {
        "pairs": np.array([(p.first, p.second) for p in geometry.active], dtype=np.int64),
        "first_piece": np.cumsum([0] + [len(pieces) for pieces in bodies], dtype=np.int64),
        "shapes": table,
        "vertices": vertices,
        "resting": np.array(checker.resting_places, dtype=_RESTING),
        "free_beyond": np.ascontiguousarray(checker.free_beyond),
        "tolerance": np.ascontiguousarray(geometry.tolerance),
    }


def shape_table(shapes: Sequence[ConvexShape]) -> tuple[NDArray[np.void], Array]:
    """`shape` of prejudge.c for each, and the vertices (n, 3) [m] of those that are hulls."""
    table = np.zeros(len(shapes), _SHAPE)
    vertices = [np.zeros((0, 3))]
    for row, shape in zip(table, shapes, strict=True):
        row["kind"], row["size"] = _measures(shape)
        if isinstance(shape, Hull):
            row["first"], row["count"] = sum(map(len, vertices)), len(shape.vertices)
            vertices.append(shape.vertices)
    return table, np.concatenate(vertices)


def judge_data(checker: CollisionChecker, arrays: Mapping[str, NDArray[Any]]) -> JudgeData:
    """Pairs, shapes and margins of a cell."""
    first_piece = arrays["first_piece"]
    return JudgeData(
        n_resting=len(arrays["resting"]),
        payload_piece=int(first_piece[checker.geometry.index(PAYLOAD)]),
        resting_piece=int(first_piece[-1]),
        apart=PROOF_MARGIN,
        overlap=PROOF_MARGIN,
        **{name: array.ctypes.data for name, array in arrays.items()},
    )


def _measures(shape: ConvexShape) -> tuple[int, tuple[float, float, float]]:
    """Kind and size of a shape as prejudge.c counts them."""
    match shape:
        case Box():
            x, y, z = (float(length) / 2.0 for length in shape.size)
            return 0, (x, y, z)
        case Cylinder():
            return 1, (shape.radius, shape.length / 2.0, 0.0)
        case Sphere():
            return 2, (shape.radius, 0.0, 0.0)
        case Capsule():
            return 3, (shape.radius, shape.length / 2.0, 0.0)
        case Hull():
            return 4, (0.0, 0.0, 0.0)
