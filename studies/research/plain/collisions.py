"""Collisions written plainly: every pair of every sample goes to FCL, nothing is screened.

Which pairs can meet at all is a fact of the cell (`symbolic.geometry.pairs`), and so are the
convex pieces of a mesh. Shapes and placements are Pinocchio's own reading of the URDF.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import coal
import fcl
import numpy as np
import pinocchio as pin

from hybrid_opt.collision.checker import RESTING_TOLERANCE
from studies.research.plain.arm import held_model
from studies.research.plain.motion import box_rotation
from symbolic.array import Array
from symbolic.geometry.hulls import convex_pieces
from symbolic.geometry.pairs import build_geometry
from symbolic.geometry.pieces import ConvexShape, Hull, Piece, shrunk
from symbolic.records import Box, Cylinder, Mesh, Robot, Shape, Sphere, Workcell

PAYLOAD_GROUP = "payload"


@dataclass(frozen=True)
class PlainCollisions:
    """Collisions at the samples of a candidate, as FCL finds them.

    Attributes:
        colliding: (n,) True for samples with a collision.
        pairs: per sample the names of the colliding pairs.
        time: time in collision [s].
    """

    colliding: Array
    pairs: tuple[tuple[tuple[str, str], ...], ...]
    time: float


@dataclass
class _Solid:
    """An FCL object, and its placement in the frame of its link or body."""

    object: fcl.CollisionObject
    placement: pin.SE3

    def move(self, frame: pin.SE3) -> None:
        here = frame * self.placement
        self.object.setTransform(fcl.Transform(here.rotation, here.translation))


class PlainCollisionChecker:
    """Checker of all pairs of bodies of a workcell for collisions by FCL."""

    def __init__(self, workcell: Workcell) -> None:
        self.workcell = workcell
        self.arms = [_Arm(robot) for robot in workcell.robots]
        self.bodies = {name: solids for arm in self.arms for name, solids in arm.bodies.items()}
        self.payload = _solids(workcell.payload.solid, pin.SE3.Identity())
        self.shrunk = _shrunk_solids(workcell.payload.solid)
        self.bodies[PAYLOAD_GROUP] = self.payload
        for body in workcell.environment:
            self.bodies[body.name] = _solids(body.shape, pin.SE3(body.pose))
            for solid in self.bodies[body.name]:
                solid.move(pin.SE3.Identity())
        self.resting = self._resting_places()

    @cached_property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of the two bodies of every pair that is checked."""
        return build_geometry(self.workcell).pair_names

    def check(self, time: Array, pose: Array, q_1: Array, q_2: Array) -> PlainCollisions:
        """Check all pairs at n samples.

        Args:
            time: (n,) times [s].
            pose: (n, 6) box poses [m, rad].
            q_1, q_2: (n, joints) joint positions of each arm [rad or m].
        """
        found = []
        for k in range(len(time)):
            self.arms[0].move(q_1[k])
            self.arms[1].move(q_2[k])
            self._move_payload(pose[k])
            allowed = self._allowed(pose[k, :3])
            found.append(tuple(pair for pair in self.pairs if self._collides(pair, allowed)))
        colliding = np.array([bool(pairs) for pairs in found])
        return PlainCollisions(
            colliding, tuple(found), float(np.trapezoid(colliding.astype(float), time))
        )

    def _collides(self, pair: tuple[str, str], allowed: set[str]) -> bool:
        first, second = pair
        resting = first == PAYLOAD_GROUP and second in allowed
        tolerance = self._tolerance(PAYLOAD_GROUP in pair)
        hit = False
        for a in self.shrunk if resting else self.bodies[first]:
            for b in self.bodies[second]:
                result = fcl.CollisionResult()
                fcl.collide(a.object, b.object, fcl.CollisionRequest(), result)
                hit = hit or result.is_collision
                if tolerance > 0.0 and not resting:
                    hit = hit or fcl.distance(a.object, b.object) <= tolerance
        return hit

    def _tolerance(self, of_payload: bool) -> float:
        """Return the distance up to which two bodies count as colliding [m].

        Args:
            of_payload: True if one body is the payload, for which the uncertain position of the
                pads is added.
        """
        doubt = self.workcell.uncertainty
        displaced = doubt.pad_position if of_payload and doubt.stated else 0.0
        return self.workcell.collision.tolerance + displaced

    def _move_payload(self, pose: Array) -> None:
        world_box = pin.SE3(box_rotation(self.workcell.task.orientation, pose[3:]), pose[:3])
        for solid in (*self.payload, *self.shrunk):
            solid.move(world_box)

    def _resting_places(self) -> list[tuple[str, Array, float]]:
        """Return every contact that the workcell allows at a fixed pose of the path.

        Returns:
            For each contact the name of the body, the position (3,) of the payload [m], and the
            distance from it within which contact is allowed [m].
        """
        task, places = self.workcell.task, []
        for waypoint in task.waypoints:
            if not waypoint.is_fixed:
                continue
            self._move_payload(waypoint.lower)
            for allowed in task.allowed_contacts:
                solids = self.bodies[allowed.body]
                gap = min(fcl.distance(a.object, b.object) for a in self.payload for b in solids)
                if gap <= self._tolerance(True) + RESTING_TOLERANCE:
                    places.append((allowed.body, waypoint.lower[:3], allowed.departure))
        return places

    def _allowed(self, centre: Array) -> set[str]:
        """Return the names of the bodies that the payload may touch while its centre is at `centre`
        (3,) [m]."""
        return {
            body
            for body, place, departure in self.resting
            if np.linalg.norm(centre - place) <= departure
        }


class _Arm:
    """Collision shapes of a robot's links and tools, placed by Pinocchio's forward kinematics."""

    def __init__(self, robot: Robot) -> None:
        self.base = pin.SE3(robot.T_world_base)
        full, held, q = held_model(robot)
        folders = [str(folder) for folder in robot.package_dirs]
        geometry = pin.buildGeomFromUrdf(
            full, str(robot.urdf), pin.GeometryType.COLLISION, package_dirs=folders
        )
        links = [full.frames[item.parentFrame].name for item in geometry.geometryObjects]
        self.model, geometry = pin.buildReducedModel(full, geometry, held, q)
        self.data = self.model.createData()
        self.bodies: dict[str, list[_Solid]] = {}
        self.carried: list[tuple[_Solid, int]] = []
        for link, item in zip(links, geometry.geometryObjects, strict=True):
            self._add(f"{robot.name}/{link}", _urdf_shape(item), item.placement, item.parentJoint)
        flange = self.model.frames[self.model.getFrameId(robot.flange, pin.FrameType.BODY)]
        for tool in robot.tool:
            placement = flange.placement * pin.SE3(tool.pose)
            self._add(f"{robot.name}/{tool.name}", tool.shape, placement, flange.parentJoint)

    def _add(self, name: str, shape: Shape | coal.Capsule, pose: pin.SE3, joint: int) -> None:
        solids = _solids(shape, pose)
        self.bodies.setdefault(name, []).extend(solids)
        self.carried += [(solid, joint) for solid in solids]

    def move(self, q: Array) -> None:
        pin.forwardKinematics(self.model, self.data, q)
        for solid, joint in self.carried:
            solid.move(self.base * self.data.oMi[joint])


def _urdf_shape(item: pin.GeometryObject) -> Shape | coal.Capsule:
    """Convert the shape of a link, as Pinocchio read it, to a shape of this project or a capsule of
    Coal."""
    shape = item.geometry
    match shape:
        case coal.Box():
            return Box(2.0 * shape.halfSide)
        case coal.Cylinder():
            return Cylinder(shape.radius, 2.0 * shape.halfLength)
        case coal.Sphere():
            return Sphere(shape.radius)
        case coal.Capsule():
            return shape
    return Mesh(Path(item.meshPath), np.asarray(item.meshScale))


def _shrunk_solids(shape: Box | Cylinder | Mesh) -> list[_Solid]:
    """Return a payload's shape as FCL objects, smaller by `RESTING_TOLERANCE` on every side."""
    less = 2.0 * RESTING_TOLERANCE
    match shape:
        case Box():
            return [_solid(Box(shape.size - less))]
        case Cylinder():
            return [_solid(Cylinder(shape.radius - less / 2.0, shape.length - less))]
    hulls = convex_pieces(shape.path, shape.scale)
    return [
        _hull(shrunk(Piece(hull, np.eye(4)), less / 2.0).shape, pin.SE3.Identity())
        for hull in hulls
    ]


def _solids(shape: Shape | coal.Capsule, placement: pin.SE3) -> list[_Solid]:
    if not isinstance(shape, Mesh):
        return [_solid(shape, placement)]
    return [_hull(hull, placement) for hull in convex_pieces(shape.path, shape.scale)]


def _hull(hull: ConvexShape, placement: pin.SE3) -> _Solid:
    assert isinstance(hull, Hull)
    counted = np.array([[len(face), *face] for face in hull.faces])
    solid = fcl.Convex(np.array(hull.vertices), len(hull.faces), counted.ravel())
    return _Solid(fcl.CollisionObject(solid), placement)


def _solid(
    shape: Box | Cylinder | Sphere | coal.Capsule, placement: pin.SE3 | None = None
) -> _Solid:
    match shape:
        case Box():
            solid = fcl.Box(*shape.size)
        case Cylinder():
            solid = fcl.Cylinder(shape.radius, shape.length)
        case Sphere():
            solid = fcl.Sphere(shape.radius)
        case _:
            solid = fcl.Capsule(shape.radius, 2.0 * shape.halfLength)
    return _Solid(fcl.CollisionObject(solid), placement or pin.SE3.Identity())
