"""A carry between its samples: any place on the path, and the proof that it is free throughout.

A search judges candidates on the task's samples. What it hands on (fronts, selected and polished
trajectories) is certified along the continuous path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.collision.certify import Certificate, certify_all
from hybrid_opt.collision.checker import CollisionChecker
from symbolic.array import Array
from symbolic.errors import DualArmError
from symbolic.path.spline import path_position
from symbolic.records import POSE_SIZE, Task
from symbolic.records.task import place_redundant
from symbolic.robot.arm import REACH_TOLERANCE

TOGETHER = 8
"""Carries certified at once: enough to spare calls, few enough for their bounds to stay cached."""


class LostPathError(DualArmError):
    """An arm cannot follow the path, on its samples or between them."""


@dataclass(frozen=True)
class SampledPath:
    """A carry on its samples, from which Newton's method reaches any other place.

    Attributes:
        task: whose path it is.
        waypoints: (n_waypoints, 6 + m) of the box and the redundant joints, angles unwrapped.
        q_1, q_2: (n, joints) joint positions on samples uniform in the path parameter [rad].
    """

    task: Task
    waypoints: Array
    q_1: Array
    q_2: Array


def configurations(
    paths: Sequence[SampledPath], posture: NumericFunction, owner: NDArray[np.intp], u: Array
) -> Array:
    """Configurations (n, 6 + all joints), box pose and both arms' joints, between the samples.

    Joint positions are NaN where Newton's method does not reach a place from the samples around.

    Args:
        paths: of one task.
        posture: compiled `symbolic.robot.arm.posture_function`.
        owner: (n,) index of the path of each place.
        u: (n,) its path parameter.
    """
    basis = path_position(len(paths[0].waypoints), u)
    waypoints = np.array([path.waypoints for path in paths])
    # Summed one by one: the same bits for any number of places.
    extended = basis[:, :1] * waypoints[owner, 0]
    for k in range(1, waypoints.shape[1]):
        extended += basis[:, k : k + 1] * waypoints[owner, k]
    poses = np.ascontiguousarray(extended[:, :POSE_SIZE])
    place = u * (len(paths[0].q_1) - 1)
    before = np.clip(place.astype(int), 0, len(paths[0].q_1) - 2)
    share = (place - before)[:, None]
    sampled = (np.array([path.q_1 for path in paths]), np.array([path.q_2 for path in paths]))
    guesses = [(1.0 - share) * q[owner, before] + share * q[owner, before + 1] for q in sampled]
    place_redundant(paths[0].task, extended, guesses)
    found = posture.batch(poses, *guesses)
    placed = np.hstack([poses, found["q_1"], found["q_2"]])
    reached = np.maximum(found["residual_1"], found["residual_2"]) <= REACH_TOLERANCE
    placed[~np.ravel(reached), poses.shape[1] :] = np.nan
    return placed


def certificates(
    checker: CollisionChecker, posture: NumericFunction, paths: Sequence[SampledPath]
) -> list[Certificate]:
    """The continuous verdicts on carries of one task that are free on their samples."""
    found: list[Certificate] = []
    for first in range(0, len(paths), TOGETHER):
        some = paths[first : first + TOGETHER]
        samples = [np.linspace(0.0, 1.0, len(path.q_1)) for path in some]
        found += certify_all(checker, partial(configurations, some, posture), samples)
    return found


def failed_at(certificate: Certificate) -> float | None:
    """Path parameter where a carry is not proven free, None where it is throughout."""
    if certificate.is_free:
        return None
    return 0.0 if certificate.lost else certificate.at_parameter
