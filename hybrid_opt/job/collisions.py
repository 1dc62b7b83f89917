"""Collisions of a whole job: pads that are not at the box, and a box that stands on something.

Contact rules. A body of an arm's last link that lies behind the plane of its pad may touch the box:
at the grasp, and wherever the pad is moved away from it along the contact normal, that plane
separates both. Every other body of an arm has to stay clear of the box, also those that a grasp
keeps apart. The box may touch the bodies that it stands on until it is lifted off, and sink into
them by no more than `RESTING_TOLERANCE`.

`what_blocks` says whether pads get to the box before a carry, and away from it afterwards, before
anything is timed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from codegen.function import NumericFunction
from hybrid_opt.carry import joints_of
from hybrid_opt.collision.checker import RESTING_TOLERANCE, CollisionChecker
from hybrid_opt.collision.judge import FCL_RESOLUTION, Judge
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.errors import JobError
from hybrid_opt.job.motions import SAMPLES, followed, lines_around, rise
from symbolic.array import Array
from symbolic.geometry.bodies import CollisionBody
from symbolic.geometry.pairs import ActivePair, CellGeometry, build_geometry, ignored_pairs
from symbolic.geometry.pieces import support
from symbolic.geometry.screen import screen_of
from symbolic.records import PAYLOAD, AllowedContact, Waypoint, Workcell

if TYPE_CHECKING:
    import casadi as ca

    from symbolic.cell_model import CellModel

LARGEST_DROP = 0.3
"""How far below the carry's ends something to stand on is looked for [m]."""

MOST_STEPS = 300
BEHIND_PAD = "behind the pad: the contact plane keeps them apart"

EVERY = 10
"""Stride of the samples of a straight motion that are judged."""


@dataclass(frozen=True)
class Standing:
    """Where a box stands.

    Attributes:
        pose: (6,) of the box [m, rad].
        height: how far below the carry's end it is [m].
        bodies: names of what it stands on, empty where nothing is beneath.
    """

    pose: Array
    height: float
    bodies: tuple[str, ...]


class JobCollisions:
    """The collision model of one workcell's jobs. Not to be shared between threads.

    Attributes:
        geometry: bodies and pairs; beside those of the carry, both arms' against the box.
    """

    def __init__(self, compiled: CompiledCell) -> None:
        """Load or build the compiled bounds.

        Raises:
            DualArmError: the model cannot be built.
        """
        self._workcell = compiled.workcell
        self.geometry = job_geometry(compiled.workcell)
        job = screen_of(self.geometry)
        pairs = {name: getattr(job, name) for name in ("active", "own", "slanted")}

        def make(model: CellModel) -> Mapping[str, ca.Function]:
            # Not imported at the top: a warm start needs no CasADi.
            from symbolic.geometry.clearance import with_more_pairs

            placements = (model.robots[0].joint_placements, model.robots[1].joint_placements)
            screen = replace(model.screen, **pairs)
            known = model.screening, model.geometry
            return with_more_pairs(*known, self.geometry, placements, screen)

        self._functions = compiled.functions("job", make, str(pairs), lanes=0)

    def standing(self, pose: Array, height: float | None) -> Standing:
        """Where the box stands below a pose (6,).

        Args:
            height: how far below [m]; None to lower it until it touches something, and not at all
                where nothing is found within `LARGEST_DROP`.
        """
        judge = Judge(self.geometry, RESTING_TOLERANCE)
        payload = self.geometry.index(PAYLOAD)
        below = self._fixed_bodies(payload)
        still = [np.zeros((1, len(robot.torque_max))) for robot in self._workcell.robots]

        def gaps(drop: float) -> Array:
            lowered = _lowered(pose, drop)
            placed = self._functions["piece_poses"].batch(lowered[None], *still)
            judge.set_placements(placed["quaternions"], placed["positions"])
            return np.array([judge.separation(0, payload, body) for body in below])

        found = 0.0 if height is None else height
        if height is None and below:
            for _ in range(MOST_STEPS):
                gap = float(gaps(found).min())
                found += gap
                if gap <= FCL_RESOLUTION or found > LARGEST_DROP:
                    break
            found = 0.0 if found > LARGEST_DROP else found
        touched = gaps(found) <= RESTING_TOLERANCE if below else np.zeros(0, dtype=bool)
        names = [self.geometry.bodies[body].name for body in np.array(below)[touched].tolist()]
        return Standing(_lowered(pose, found), found, tuple(names))

    def checker(self, places: Sequence[Standing]) -> CollisionChecker:
        """The checker of a job whose box stands at these places before and after the carry."""
        task = self._workcell.task
        poses = tuple(Waypoint(place.pose, place.pose) for place in places)
        contacts = tuple(
            AllowedContact(body, place.height + RESTING_TOLERANCE)
            for place in places
            for body in place.bodies
        )
        task = replace(
            task,
            waypoints=(*task.waypoints, *poses),
            allowed_contacts=(*task.allowed_contacts, *contacts),
        )
        cell = replace(self._workcell, task=task)
        return CollisionChecker(replace(self.geometry, workcell=cell), self._functions)

    def _fixed_bodies(self, payload: int) -> list[int]:
        """Bodies that stand still and that the box must not run into."""
        found = []
        for pair in self.geometry.active:
            if payload in (pair.first, pair.second):
                other = pair.first + pair.second - payload
                if self.geometry.bodies[other].frame.kind == "world":
                    found.append(other)
        return found


def job_geometry(workcell: Workcell) -> CellGeometry:
    """Bodies and pairs of a cell whose box is not always held; see the module's contact rules.

    Raises:
        CollisionModelError: a shape is unusable, or an ignored pair names no body.
    """
    geometry = build_geometry(workcell)
    bodies, payload = geometry.bodies, geometry.index(PAYLOAD)
    ignored = ignored_pairs(workcell, bodies)
    active, excluded = list(geometry.active), []
    for pair in geometry.excluded:
        of_box = payload in (pair.first, pair.second)
        other = bodies[pair.first + pair.second - payload] if of_box else None
        if (
            other is None
            or not other.group.startswith("robot")
            or frozenset((other.name, PAYLOAD)) in ignored
        ):
            excluded.append(pair)
        elif _behind_pad(other, geometry):
            excluded.append(replace(pair, reason=BEHIND_PAD))
        else:
            active.append(ActivePair(pair.first, pair.second))
    return replace(geometry, active=tuple(active), excluded=tuple(excluded))


def _behind_pad(body: CollisionBody, geometry: CellGeometry) -> bool:
    """Whether a body moves with its arm's pad and lies behind its plane."""
    arm = body.frame.robot
    if arm < 0 or body.frame.joint != len(geometry.arms[arm].axes) - 1:
        return False
    T_joint_pad = geometry.arms[arm].T_joint_box @ geometry.workcell.contacts[arm].T_box_pad
    normal, origin = T_joint_pad[:3, 2], T_joint_pad[:3, 3]
    ahead = max(float(support(piece, normal[None])[0]) for piece in body.pieces)
    return bool(ahead - normal @ origin <= RESTING_TOLERANCE)


def _lowered(pose: Array, drop: float) -> Array:
    lowered = np.array(pose, dtype=float)
    lowered[2] -= drop
    return lowered


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
