"""A carry between its samples: any place on the path, and the proof that it is free throughout.

A search judges candidates on the task's samples. What it hands on (fronts, selected and polished
trajectories) is certified along the continuous path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from codegen.function import NumericFunction
from hybrid_opt.collision.certify import Certificate, certify
from hybrid_opt.collision.checker import CollisionChecker
from symbolic.array import Array
from symbolic.errors import DualArmError
from symbolic.physics.path import path_basis
from symbolic.robot.arm import REACH_TOLERANCE


class LostPathError(DualArmError):
    """An arm cannot follow the path, on its samples or between them."""


@dataclass(frozen=True)
class SampledPath:
    """A carry on its samples, from which Newton's method reaches any other place.

    Attributes:
        waypoints: (n_waypoints, 6) of the box path, angles unwrapped.
        q_1, q_2: (n, 6) joint positions on samples uniform in the path parameter [rad].
    """

    waypoints: Array
    q_1: Array
    q_2: Array


def configurations(
    path: SampledPath, posture: NumericFunction, u: Array
) -> tuple[Array, Array, Array]:
    """Box poses (n, 6) and joint positions of both arms (n, 6) at path parameters u (n,).

    Args:
        posture: compiled `symbolic.robot.arm.posture_function`.

    Raises:
        LostPathError: Newton's method does not reach a place from the samples around it.
    """
    poses = np.ascontiguousarray(path_basis(len(path.waypoints), u).position @ path.waypoints)
    samples = np.linspace(0.0, 1.0, len(path.q_1))
    guesses = [
        np.column_stack([np.interp(u, samples, q[:, joint]) for joint in range(6)])
        for q in (path.q_1, path.q_2)
    ]
    found = posture.batch(poses, *guesses)
    reached = np.maximum(found["residual_1"], found["residual_2"]) <= REACH_TOLERANCE
    if not reached.all():
        place = u[int(np.argmin(reached))]
        raise LostPathError(f"an arm does not follow the path between its samples, at u = {place}")
    return poses, found["q_1"], found["q_2"]


def certificate(
    checker: CollisionChecker, posture: NumericFunction, path: SampledPath
) -> Certificate:
    """The continuous verdict on a carry that is free on its samples.

    Raises:
        LostPathError: an arm does not follow the path between the samples.
    """
    samples = np.linspace(0.0, 1.0, len(path.q_1))
    return certify(checker, lambda u: configurations(path, posture, u), samples)
