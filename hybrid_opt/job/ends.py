"""Whether pads get to the box before a carry, and away from it afterwards; nothing is timed."""

from __future__ import annotations

from codegen.function import NumericFunction
from hybrid_opt.carry import joints_of
from hybrid_opt.errors import JobError
from hybrid_opt.job.collisions import JobCollisions
from hybrid_opt.job.profile import rise
from hybrid_opt.job.straight import SAMPLES, followed, lines_around
from symbolic.array import Array
from symbolic.records import Workcell

EVERY = 10
"""Stride of the samples of a straight motion that are judged."""


def what_blocks(
    workcell: Workcell,
    collisions: JobCollisions,
    posture: NumericFunction,
    pose: Array,
    q: Array,
) -> str:
    """The first straight motion around a carry that an arm does not follow, or on which something
    collides, with what does; '' where all are free on their samples.

    Args:
        workcell: two round pads of it face one another.
        collisions: of its jobs.
        posture: `symbolic.robot.arm.posture_function`.
        pose: (2, 6) of the box where the carry begins and ends.
        q: (2, joints) of both arms there [rad or m].
    """
    handling = workcell.handling
    places = (
        collisions.standing(pose[0], handling.lift_height),
        collisions.standing(pose[1], handling.set_down_height),
    )
    checker = collisions.checker(places)
    share = rise(1.0, SAMPLES).value[::EVERY]
    around = lines_around(workcell, handling, (places[0].pose, places[1].pose), pose)
    for lines, known, end in zip(around, q, (0, -1), strict=True):
        for line in lines:
            try:
                path = followed(workcell, posture, line, known, at_end=end == 0)
            except JobError as error:
                return str(error)
            poses, joints = line.at(share)[0], joints_of(workcell, path[::EVERY])
            touch = checker.check(poses, *joints, share).first_touch
            if touch is not None:
                return f"{line.name.replace('_', ' ')}: {touch.first} meets {touch.second}"
            known = path[end]
    return ""
