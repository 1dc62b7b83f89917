"""The description of a dual-arm cell as frozen, validated records.

Units are SI throughout: m, rad, kg, s, N, N m. A transform `T_a_b` is a (4, 4) homogeneous
matrix that maps coordinates of frame b into frame a, so that `T_a_c = T_a_b @ T_b_c`.

Frames: `world` (z up), one `base` per robot, its `flange`, its `pad` (origin at the centre of
the contact patch, z along the contact normal, pointing from the robot into the box) and the
`box` (origin at the geometric centre of the payload, axes along its edges).

Arrays are read-only. The records hold no behaviour that depends on a solver or on a file
format; `symbolic.workcell.file` reads them from TOML.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.workcell.handling import Handling
from symbolic.workcell.identity import Reading, digest_of

TimeLaw = Literal["constant", "ramped", "optimal"]
Allocation = Literal["paper", "joint"]

SEARCHED = -2
"""`Workcell.start_branch` of a robot whose branches compete."""

POSE_SIZE = 6
"""x, y, z [m], roll, pitch, yaw [rad]."""


@dataclass(frozen=True)
class Box:
    """A cuboid centred at its frame. size: (3,) full edge lengths [m]."""

    size: Array


@dataclass(frozen=True)
class Cylinder:
    """A cylinder centred at its frame, axis along z. radius, length [m]."""

    radius: float
    length: float


@dataclass(frozen=True)
class Sphere:
    """A sphere centred at its frame. radius [m]."""

    radius: float


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh file (STL, OBJ, PLY or OFF). scale: (3,) factor per axis."""

    path: Path
    scale: Array


Shape = Box | Cylinder | Sphere | Mesh


@dataclass(frozen=True)
class Body:
    """A named collision shape.

    Attributes:
        name: unique within its owner.
        shape: its geometry.
        pose: (4, 4), the shape's frame in its parent frame (world for the environment,
            flange for a tool).
    """

    name: str
    shape: Shape
    pose: Array


@dataclass(frozen=True)
class ToolLoad:
    """The tool as a rigid body on the flange.

    Attributes:
        mass: [kg].
        centre_of_mass: (3,) in the flange frame [m].
        inertia: (3, 3) about the centre of mass, flange axes [kg m^2].
    """

    mass: float
    centre_of_mass: Array
    inertia: Array


@dataclass(frozen=True)
class Robot:
    """One arm: its model file, where it stands, what it carries and what it may do.

    Attributes:
        name: unique in the workcell.
        urdf: the model file, a URDF or a xacro file.
        package_dirs: folders that `package://` addresses of the URDF are looked up in: those of
            the workcell file, then those of ROS and of the Python environment that it needs.
        flange: name of the URDF frame that the tool is mounted on.
        locked_joints: joints of the URDF held at a fixed position [rad or m].
        T_world_base: (4, 4), the URDF's root in the world.
        T_flange_pad: (4, 4), the pad frame on the flange.
        tool: collision bodies of the tool, in the flange frame.
        position_lower, position_upper: (n,) joint limits [rad, or m where a joint slides].
        velocity_max: (n,) [rad/s].
        acceleration_max: (n,) [rad/s^2].
        torque_max: (n,) [N m, or N].
        min_manipulability: least allowed |det J| of the flange-pad Jacobian of the six joints that
            follow the box [m^3].
        xacro_arguments: names and values of the xacro file's arguments.
        srdf: file whose disabled pairs of links are not checked for collision.
        chain_root: link of the URDF that the arm begins at, the flange being its other end; ''
            where every joint that is not locked belongs to the arm.
        drop_links: links, by name or pattern, that are left out with all that hangs on them.
        tool_load: mass and inertia of the tool; None where nothing is known of them.
        redundant_joints: names of the joints beyond six, whose paths are part of the decision
            vector; () where the arm has six.
    """

    name: str
    urdf: Path
    package_dirs: tuple[Path, ...]
    flange: str
    locked_joints: tuple[tuple[str, float], ...]
    T_world_base: Array
    T_flange_pad: Array
    tool: tuple[Body, ...]
    position_lower: Array
    position_upper: Array
    velocity_max: Array
    acceleration_max: Array
    torque_max: Array
    min_manipulability: float
    xacro_arguments: tuple[tuple[str, str], ...] = ()
    srdf: Path | None = None
    chain_root: str = ""
    drop_links: tuple[str, ...] = ()
    tool_load: ToolLoad | None = None
    redundant_joints: tuple[str, ...] = ()


@dataclass(frozen=True)
class Payload:
    """The carried box.

    Attributes:
        size: (3,) edge lengths along the box axes [m].
        mass: [kg].
        centre_of_mass: (3,) in the box frame [m].
        inertia: (3, 3) about the centre of mass, box axes [kg m^2].
        velocity_max, acceleration_max: limits of the box's translation [m/s, m/s^2].
        angular_velocity_max, angular_acceleration_max: of its rotation [rad/s, rad/s^2].
    """

    size: Array
    mass: float
    centre_of_mass: Array
    inertia: Array
    velocity_max: float
    acceleration_max: float
    angular_velocity_max: float
    angular_acceleration_max: float


@dataclass(frozen=True)
class Contact:
    """The frictional contact between one robot's pad and the box.

    Attributes:
        T_box_pad: (4, 4), the pad frame in the box frame; its origin lies on a face of the
            box and its z axis is the inward normal of that face.
        friction: Coulomb coefficient.
        patch_radius: radius of the contact patch [m].
    """

    T_box_pad: Array
    friction: float
    patch_radius: float


@dataclass(frozen=True)
class Uncertainty:
    """How far from its nominal value each quantity may be while the robots hold the box.

    Attributes:
        friction: share by which either coefficient may be lower or higher.
        mass: share by which the mass may be lower or higher.
        centre_of_mass: (3,) half the width of its range along the box axes [m].
        pad_position: how far either pad may be displaced in its contact plane [m].
        disturbance: (3,) largest acceleration of the box beside the motion's, along the world's
            axes, either way [m/s^2].
    """

    friction: float = 0.0
    mass: float = 0.0
    centre_of_mass: Array = field(default_factory=lambda: np.zeros(3))
    pad_position: float = 0.0
    disturbance: Array = field(default_factory=lambda: np.zeros(3))

    def scaled(self, factor: float) -> Uncertainty:
        """All ranges times a factor."""
        return Uncertainty(
            factor * self.friction,
            factor * self.mass,
            factor * self.centre_of_mass,
            factor * self.pad_position,
            factor * self.disturbance,
        )


@dataclass(frozen=True)
class Waypoint:
    """A pose of the box path: fixed where lower equals upper, otherwise free within them.

    Attributes:
        lower, upper: (6,) x, y, z [m], roll, pitch, yaw [rad].
    """

    lower: Array
    upper: Array

    @property
    def is_fixed(self) -> bool:
        """Whether the task fixes this pose."""
        return bool(np.all(self.lower == self.upper))


@dataclass(frozen=True)
class RedundantJoint:
    """A joint beyond the six that follow the box: its path is part of the decision vector.

    Its values at the waypoints are joined by the spline of the box path. A joint that moves both
    arms of a machine is one of these, not two.

    Attributes:
        name: robot and joint, as 'north/panda_joint3'.
        drives: per robot its index among the arm's joints, -1 where it is none of them.
        lower, upper: (n_waypoints,) bounds [rad or m]; equal where it is fixed.
        initial: (n_waypoints,) its path in the hand-made trajectory [rad or m].
    """

    name: str
    drives: tuple[int, int]
    lower: Array
    upper: Array
    initial: Array


@dataclass(frozen=True)
class AllowedContact:
    """The payload may touch a named environment body near the fixed poses.

    Attributes:
        body: name of the environment body.
        departure: the contact is allowed while the box centre is within this distance of a
            fixed waypoint at which the payload touches (or is within tolerance of) the body [m].
    """

    body: str
    departure: float


@dataclass(frozen=True)
class Task:
    """What is to be carried where, and how a candidate is sampled and judged.

    Attributes:
        waypoints: the ordered poses of the path; the first and last are fixed.
        samples: number of samples along the path, ends included.
        time_law: 'constant' (the paper's), 'ramped' (from rest to rest) or 'optimal' (the fastest
            from rest to rest within all limits and a force limit that is a decision variable).
        reference_speed: [m/s], speed of the box centre (cruise speed of 'ramped').
        reference_angular_speed: [rad/s], for steps that mostly rotate.
        ramp_time: [s], duration of each ramp of 'ramped'.
        reference_force: (2,) [N], normalises each robot's normal force.
        initial: (n_free, 6), the hand-made trajectory's free waypoints.
        allowed_contacts: contacts that are no collisions, see AllowedContact.
        allocation: 'paper' (least forces first, then the moments) or 'joint' (the least forces
            that carry the moments as well).
        force_limit: (2,) bounds of the force limit, the last decision variable of 'optimal' [N].
        redundant: the joints whose paths are decided beside the box's, see RedundantJoint.
    """

    waypoints: tuple[Waypoint, ...]
    samples: int
    time_law: TimeLaw
    reference_speed: float
    reference_angular_speed: float
    ramp_time: float
    reference_force: Array
    initial: Array
    allowed_contacts: tuple[AllowedContact, ...]
    allocation: Allocation = "paper"
    force_limit: tuple[float, float] = (0.0, np.inf)
    redundant: tuple[RedundantJoint, ...] = ()

    @property
    def extended_size(self) -> int:
        """Entries of an extended pose: the box pose, then the redundant joints."""
        return POSE_SIZE + len(self.redundant)

    def redundant_of(self, arm: int) -> tuple[tuple[int, int], ...]:
        """Of each redundant joint of robot `arm` its index in the arm and its place in the
        extended pose."""
        return tuple(
            (joint.drives[arm], POSE_SIZE + k)
            for k, joint in enumerate(self.redundant)
            if joint.drives[arm] >= 0
        )

    @property
    def free_indices(self) -> tuple[int, ...]:
        """Positions of the free waypoints in `waypoints`."""
        return tuple(i for i, w in enumerate(self.waypoints) if not w.is_fixed)

    @property
    def n_path(self) -> int:
        """Number of variables of the path: six per free waypoint (paper Eq. 14), then the free
        values of the redundant joints, joint by joint."""
        return len(self.free_entries[0])

    @property
    def n_box(self) -> int:
        """Number of variables of the box path, the first of the decision vector."""
        return POSE_SIZE * len(self.free_indices)

    @property
    def free_entries(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns (n_path,) of the path's variables among the extended waypoints
        (n_waypoints, 6 + m), whose columns are the pose and the redundant joints."""
        free = np.array(self.free_indices, dtype=np.intp)
        rows, columns = [np.repeat(free, POSE_SIZE)], [np.tile(np.arange(POSE_SIZE), len(free))]
        for k, joint in enumerate(self.redundant):
            moving = np.flatnonzero(joint.lower < joint.upper)
            rows.append(moving)
            columns.append(np.full(len(moving), POSE_SIZE + k))
        return np.concatenate(rows), np.concatenate(columns)

    @property
    def n_var(self) -> int:
        """Number of decision variables: those of the path, then under 'optimal' the force limit."""
        return self.n_path + (self.time_law == "optimal")

    @property
    def lower(self) -> Array:
        """(n_var,) lower bounds of the decision vector."""
        return self._bounds("lower", self.force_limit[0])

    @property
    def upper(self) -> Array:
        """(n_var,) upper bounds of the decision vector."""
        return self._bounds("upper", self.force_limit[1])

    def _bounds(self, name: str, force: float) -> Array:
        parts = [getattr(self.waypoints[i], name) for i in self.free_indices]
        parts += [getattr(joint, name)[joint.lower < joint.upper] for joint in self.redundant]
        return np.concatenate(parts + ([np.array([force])] if self.time_law == "optimal" else []))


@dataclass(frozen=True)
class IgnoredPair:
    """Bodies that collision checking leaves out against one another, with the user's reason.

    Attributes:
        first, second: names of bodies, or patterns with `*` and `?` that stand for several.
        reason: shown wherever pairs are listed.
    """

    first: str
    second: str
    reason: str


@dataclass(frozen=True)
class CollisionSettings:
    """How collisions are judged.

    Attributes:
        tolerance: bodies closer than this count as colliding [m].
        ignored: pairs left out by the user.
        most_pieces: most convex pieces of all bodies together that are worked with.
    """

    tolerance: float = 0.0
    ignored: tuple[IgnoredPair, ...] = ()
    most_pieces: int = 500


@dataclass(frozen=True)
class Workcell:
    """A dual-arm cell and its task.

    Attributes:
        name: title for reports.
        robots: the two arms; robot i holds contact i.
        payload, contacts, task, environment, collision, uncertainty, handling: see their records.
        start_branch: (2,) per robot the index of the start branch among the ranked branches,
            -1 for the stated criterion's choice, or `SEARCHED`: all compete, see
            `hybrid_opt.branches`, and until then it is the criterion's choice.
        source: the file it came from.
        reading: what it was like when it was read from `source`.
    """

    name: str
    robots: tuple[Robot, Robot]
    payload: Payload
    contacts: tuple[Contact, Contact]
    task: Task
    environment: tuple[Body, ...]
    collision: CollisionSettings = field(default_factory=CollisionSettings)
    start_branch: tuple[int, int] = (-1, -1)
    source: Path = Path()
    reading: Reading | None = None
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    handling: Handling = field(default_factory=Handling)

    @cached_property
    def digest(self) -> str:
        """Identifies the cell in caches and results: SHA-256 over the file and every file it names
        (URDF, meshes), and over its values where it was changed in memory; '' without files."""
        return digest_of(self, self.reading)
