"""The cell: robots, payload, contacts, uncertainty, handling, and its digest.

An unchanged workcell has the digest of its files. A workcell changed in memory
(`dataclasses.replace`) has a digest of its own, made from that digest and from its values. So
nothing that is cached under a digest belongs to another cell.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from symbolic.array import Array, Range, Vector
from symbolic.errors import SettingsError
from symbolic.records import quantities as quantity
from symbolic.records.content import Reading, reading_of
from symbolic.records.poses import inverse, read_only
from symbolic.records.problems import Label, text_pattern
from symbolic.records.shapes import Body, Box, Cylinder, Mesh
from symbolic.records.task import Task


def _zeros() -> Array:
    return read_only(np.zeros(3))


# --- an arm with its tool ---


@dataclass(frozen=True)
class ToolLoad:
    """Mass and inertia of a tool on the flange.

    Attributes:
        mass: mass [kg].
        centre_of_mass: (3,) centre of mass in the flange frame [m].
        inertia: (3, 3) about the centre of mass, flange axes [kg m^2].
    """

    mass: Annotated[float, quantity.MASS]
    centre_of_mass: Annotated[Vector, quantity.POSITION] = field(default_factory=_zeros)
    inertia: Array = field(default_factory=lambda: read_only(np.zeros((3, 3))))


ADDRESS = text_pattern(
    r"[A-Za-z0-9](?:[A-Za-z0-9.:-]{0,251}[A-Za-z0-9])?", "a host name or an IP address"
)
"""Host names, IPv4 and IPv6 addresses, without characters that could end a string in a robot's
language."""

PREFIX = text_pattern(r"(?:[A-Za-z][A-Za-z0-9_]{0,39})?", "letters, digits, _, with a letter first")
"""Prefixes of joint names in ROS; '' for none."""

SIGNAL = text_pattern(
    r"(?:/?[A-Za-z0-9][A-Za-z0-9_/]{0,79})?",
    "the number of a digital line, a signal's name, or a name of ROS that begins with /",
)
"""Names of the outputs and inputs of hands; '' for none."""


@dataclass(frozen=True)
class Driver:
    """Connection to an arm's controller, and what the controller can do.

    Attributes:
        address: host name or IP address; '' if unknown.
        prefix: prefix of the arm's joint names in its driver; None for the robot's name.
        rate: cycle rate of the driver [Hz]; None for the default of the bundle's target.
        lag: delay of the arm behind its command [s].
        force_control: True if the controller has its maker's optional force control: a sensor at
            the flange, and instructions that press with a force.
        stiffness: stiffness of the controlled arm at the pad, along the pad's normal [N/m]; None if
            not measured.
        grip_output: name of the output signal that switches the arm's hands; '' for none.
        grip_input: name of the input signal that is on while the hands hold; '' for none.
    """

    address: Annotated[str, ADDRESS] = ""
    prefix: Annotated[str, PREFIX] | None = None
    rate: Annotated[float, quantity.RATE] | None = None
    lag: Annotated[float, quantity.LAG] = 0.0
    force_control: bool = False
    stiffness: Annotated[float, quantity.PAD_STIFFNESS] | None = None
    grip_output: Annotated[str, SIGNAL] = ""
    grip_input: Annotated[str, SIGNAL] = ""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """One arm: its model file, base, tool and limits.

    Attributes:
        name: name of the robot, unique in the workcell.
        urdf: the model file, a URDF or a xacro file.
        package_dirs: folders in which `package://` addresses of the URDF are looked up: folders of
            the workcell file, then needed folders of ROS and of the Python environment.
        flange: name of the URDF frame on which the tool is mounted.
        locked_joints: names and fixed positions [rad or m] of joints of the URDF that do not move.
        T_world_base: (4, 4) root frame of the URDF in the world.
        T_flange_pad: (4, 4) pad frame in the flange frame.
        tool: collision bodies of the tool, in the flange frame.
        position_lower, position_upper: (n,) limits of the joint positions [rad, or m for a sliding
            joint].
        velocity_max: (n,) limits of the joint speeds [rad/s, or m/s].
        acceleration_max: (n,) limits of the joint accelerations [rad/s^2, or m/s^2].
        torque_max: (n,) limits of the joint torques [N m, or N for a sliding joint]; infinite if
            unknown.
        min_manipulability: least allowed absolute determinant of the Jacobian of the six joints
            that follow the box [m^3].
        xacro_arguments: names and values of the xacro file's arguments.
        srdf: SRDF file; pairs of links that it disables are not checked for collision.
        chain_root: link of the URDF at which the arm begins; it ends at the flange. '' if every
            joint that is not locked belongs to the arm.
        drop_links: names or patterns of links that are left out together with all links behind
            them.
        tool_load: mass and inertia of the tool; None if unknown.
        redundant_joints: names of the joints beyond six, whose paths are part of the decision
            vector; () for an arm with six joints.
        jerk_max: (n,) limits of the joint jerks [rad/s^3, or m/s^3]; None for no limits.
        driver: connection to the arm's controller, for bundles.
    """

    name: Label
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
    min_manipulability: Annotated[float, quantity.MANIPULABILITY]
    xacro_arguments: tuple[tuple[str, str], ...] = ()
    srdf: Path | None = None
    chain_root: str = ""
    drop_links: tuple[str, ...] = ()
    tool_load: ToolLoad | None = None
    redundant_joints: tuple[str, ...] = ()
    jerk_max: Array | None = None
    driver: Driver = field(default_factory=Driver)


# --- the payload, its contacts, and their uncertainty ---


@dataclass(frozen=True)
class Payload:
    """The payload, called the box.

    Attributes:
        size: (3,) edge lengths along the box axes [m]; for another shape the edge lengths of a box,
            centred at the frame, that contains the shape.
        mass: mass [kg].
        centre_of_mass: (3,) centre of mass in the box frame [m].
        inertia: (3, 3) about the centre of mass, box axes [kg m^2].
        velocity_max, acceleration_max: limits of the box's translation [m/s, m/s^2].
        angular_velocity_max, angular_acceleration_max: limits of the box's rotation [rad/s,
            rad/s^2].
        jerk_max: limit of the box's translation [m/s^3]; None for no limit.
        shape: geometry in the box frame; None for a box of edge lengths `size`.
    """

    size: Array
    mass: Annotated[float, quantity.MASS]
    centre_of_mass: Annotated[Vector, quantity.POSITION]
    inertia: Array
    velocity_max: Annotated[float, quantity.SPEED] = 1.0
    acceleration_max: Annotated[float, quantity.ACCELERATION] = 5.0
    angular_velocity_max: Annotated[float, quantity.ANGULAR_SPEED] = 2.0
    angular_acceleration_max: Annotated[float, quantity.ANGULAR_ACCELERATION] = 10.0
    jerk_max: Annotated[float, quantity.JERK] | None = None
    shape: Cylinder | Mesh | None = None

    @property
    def solid(self) -> Box | Cylinder | Mesh:
        """Geometry of the payload in the box frame; by default a box with edge lengths `size`."""
        return Box(self.size) if self.shape is None else self.shape


HandKind = Literal["pad", "cup", "magnet", "fingers"]
"""A pad holds because both arms squeeze the payload. A hand of another kind holds by its own
force."""


@dataclass(frozen=True)
class Contact:
    """The frictional contact between one robot's pad, or hand, and the box.

    Attributes:
        T_box_pad: (4, 4) pad frame in the box frame. Its z axis is the contact normal, which points
            into the box.
        friction: Coulomb coefficient.
        patch_radius: radius of a round contact patch, or half the diagonal of a rectangular patch
            [m].
        half_sides: half the sides of a rectangular patch along the pad's x and y axes [m]; None for
            a round patch.
        further: other pads of the same robot, rigidly mounted beside the first, as on a fork, in an
            array of cups or in a gripper. They have the first pad's friction, patch, kind and
            holding force.
        kind: kind of pad or hand. A cup presses along its ring-shaped lip, all others press over
            their whole patch.
        holding_force: force with which a hand pulls or clamps the payload by itself: vacuum times
            area, pull of a magnet, closing force of a gripper [N]; zero for a pad.
        layer_shear: stiffness of the elastic layer along the patch, over its stiffness normal to
            the patch; the default is the ratio of rubber, which keeps its volume.
        layer_stiffness: normal stiffness per area of the elastic layer, relative to the other pads.
    """

    T_box_pad: Array
    friction: float
    patch_radius: float
    half_sides: tuple[float, float] | None = None
    further: tuple[Contact, ...] = ()
    kind: HandKind = "pad"
    holding_force: float = 0.0
    layer_shear: float = 1.0 / 3.0
    layer_stiffness: float = 1.0

    @property
    def is_ring(self) -> bool:
        """True if the patch presses only along its rim, as a cup's lip."""
        return self.kind == "cup"

    @property
    def area(self) -> float:
        """Area of the contact patch [m^2]; of a cup the area within its lip."""
        if self.half_sides is None:
            return float(np.pi * self.patch_radius**2)
        return float(4.0 * np.prod(self.half_sides))


@dataclass(frozen=True)
class Uncertainty:
    """Largest deviation of each quantity from its nominal value while the robots hold the box.

    Attributes:
        friction: relative deviation of either friction coefficient, up or down.
        mass: relative deviation of the mass, up or down.
        centre_of_mass: (3,) deviation of the centre of mass along the box axes, in either direction
            [m].
        pad_position: displacement of either pad in its contact plane [m].
        disturbance: (3,) additional acceleration of the box along the world axes, in either
            direction [m/s^2].
        tracking: share of the commanded normal force that may be missing.
        internal_force: tangential force with which the arms may push against each other [N].
        tilt: angle between either pad and the face that it touches [rad].
        relative_position: error of the pads' positions relative to each other, along the faces [m].
        relative_angle: error of the pads' directions relative to each other [rad].
        stiffness: tangential stiffness of either arm at its pad [N/m], which turns
            `relative_position` into a force. Zero if unknown; `relative_position` then displaces
            the pads.
        stated: True if the workcell file states the uncertainty, False for the usual uncertainty.
    """

    friction: Annotated[float, quantity.SHARE] = 0.0
    mass: Annotated[float, quantity.SHARE] = 0.0
    centre_of_mass: Annotated[Vector, quantity.DISPLACEMENT] = field(default_factory=_zeros)
    pad_position: Annotated[float, quantity.DISPLACEMENT] = 0.0
    disturbance: Annotated[Vector, quantity.DISTURBANCE] = field(default_factory=_zeros)
    tracking: Annotated[float, quantity.SHARE] = 0.0
    internal_force: Annotated[float, quantity.INTERNAL_FORCE] = 0.0
    tilt: Annotated[float, quantity.TILT] = 0.0
    relative_position: Annotated[float, quantity.DISPLACEMENT] = 0.0
    relative_angle: Annotated[float, quantity.TILT] = 0.0
    stiffness: Annotated[float, quantity.ARM_STIFFNESS] = 0.0
    stated: bool = True

    @property
    def is_empty(self) -> bool:
        """True if every range is zero."""
        return not any(np.any(getattr(self, name)) for name in RANGES)

    @property
    def title(self) -> str:
        """Name of the uncertainty in messages. It tells an uncertainty that the workcell file
        states from the usual one."""
        return "the cell's [uncertainty]" if self.stated else "the usual uncertainty"

    @property
    def opposed_force(self) -> float:
        """Largest tangential force with which the arms push against each other [N].

        It is `internal_force`, plus the force that `relative_position` causes if `stiffness` is
        known. Both arms then count as springs in series.
        """
        return self.internal_force + self.stiffness * self.relative_position / 2.0

    @property
    def apart(self) -> float:
        """Largest displacement of the pads relative to each other along the faces,
        `relative_position` [m].

        It is zero if `stiffness` is known: the displacement then becomes a part of `opposed_force`.
        """
        return 0.0 if self.stiffness else self.relative_position

    @property
    def turned(self) -> float:
        """Largest angle between a pad and the face that it touches, from `tilt` and
        `relative_angle` [rad]."""
        return self.tilt + self.relative_angle

    def scaled(self, factor: float) -> Uncertainty:
        """Return the uncertainty with every range multiplied by a factor."""
        return replace(self, **{name: factor * getattr(self, name) for name in RANGES})

    def changed(self, by: float | Mapping[str, float]) -> Uncertainty:
        """Return the uncertainty with other ranges.

        Args:
            by: factor on every range; or new values of single ranges by name, one number for all
                three axes of a vector.

        Raises:
            SettingsError: a name is not the name of a range.
        """
        if not isinstance(by, Mapping):
            return self.scaled(by)
        unknown = by.keys() - RANGES.keys() - {"stiffness"}
        if unknown:
            raise SettingsError(
                f"uncertainty: no range {', '.join(sorted(unknown))}; known are {', '.join(RANGES)}"
            )
        ranges: dict[str, Any] = {
            name: np.broadcast_to(value, 3) if np.ndim(getattr(self, name)) else value
            for name, value in by.items()
        }
        return replace(self, **ranges)

    def restrict_to(self, names: Iterable[str]) -> Uncertainty:
        """Return the uncertainty with the ranges `names` unchanged and all other ranges zero."""
        none = Uncertainty()
        others = {name: getattr(none, name) for name in RANGES if name not in names}
        return replace(self, **others)

    def __str__(self) -> str:
        said = []
        for name, (words, factor, unit) in RANGES.items():
            widths = factor * np.atleast_1d(getattr(self, name))
            same = widths.min() == widths.max()
            numbers = " / ".join(f"{width:g}" for width in (widths[:1] if same else widths))
            if widths.any():
                said.append(words.format(f"{numbers} {unit}"))
        return ", ".join(said) or "nothing"


RANGES = {
    "friction": ("friction off by {}", 100.0, "%"),
    "mass": ("mass by {}", 100.0, "%"),
    "centre_of_mass": ("centre of mass by {}", 1e3, "mm"),
    "pad_position": ("pads by {}", 1e3, "mm"),
    "disturbance": ("disturbance by {}", 1.0, "m/s^2"),
    "tracking": ("{} of the force missing", 100.0, "%"),
    "internal_force": ("arms against one another by {}", 1.0, "N"),
    "tilt": ("pads tilted by {}", 1.0, "rad"),
    "relative_position": ("arms off by {}", 1e3, "mm"),
    "relative_angle": ("turned by {}", 1.0, "rad"),
}
"""Ranges of an `Uncertainty` by name: the words for messages, and the factor to the unit in these
words."""

USUAL_UNCERTAINTY = Uncertainty(
    friction=0.20,  # slips of one pair of surfaces spread by 10 %; twice that for another day
    mass=0.05,  # wrist sensors, zeroed: -10 to +5 %; a box that was weighed
    centre_of_mass=np.broadcast_to(0.005, 3),  # calibrated by tilts: 1.3 to 1.8 mm rms; 3 times it
    pad_position=0.003,  # 2.2 mm rms at the grasp, with touch-off; without it take 0.010
    disturbance=np.broadcast_to(0.2, 3),  # above 1 Hz: 99 % below 0.08 to 0.20 m/s^2
    tracking=0.14,  # the best slow loop was above 0.86 of its reference in 99 %; the worst 0.65
    internal_force=12.0,  # 12 to 18 N a pad in logs of two stiff arms
    tilt=0.035,  # 2 to 3 degrees, 6 at most
    relative_position=0.004,  # drift of the pads in motion: 4 to 20 mm rms
    stated=False,
)
"""Uncertainty of a cell that states none, if it was set up with care. Derived from logs of two UR5e
that squeeze boxes (adamweinhardt/dual-arm-manipulation, commit 6699139, 206 runs). The tilt in
these logs contains the arms' relative angle. docs/explanation/robust.md says more."""


PARTNER_TIME = 0.3
"""Time in which an arm at full speed covers the distance by which it still moves after the other
arm has stopped (assumed) [s]: 0.21 s to notice and report the stop, a lag of 0.03 s, and half of a
stop of 0.12 s. Bundles compute their own."""


@dataclass(frozen=True)
class Handling:
    """Motion of the robots before and after the carry.

    Attributes:
        stand_off: distance of both pads from the box, along the contact normals, before the box is
            gripped and after it is released [m].
        pressing_speed: largest speed of the pads between the stand-off and the box [m/s].
        pressing_rate: largest rate of the normal forces while pressing and releasing [N/s].
        lifting_speed: largest speed of the box while it is lifted and set down [m/s].
        lift_height: height by which the box is lifted from its support to the carry's start [m];
            None for the height above the body beneath the box.
        set_down_height: height by which the box is lowered from the carry's goal to its support
            [m]; None for the height above the body beneath the box.
        partner_stop: largest distance by which the pads may move apart along the path if one arm
            stops on its own, until the other arm has stopped too [m]; None for no limit.
        grip_time: time from switching the outputs of hands until the hands hold, or have released
            [s].
        grip_limit: longest additional wait for the inputs of hands [s].
    """

    stand_off: Annotated[float, quantity.STAND_OFF] = 0.05
    pressing_speed: Annotated[float, quantity.SPEED] = 0.05
    pressing_rate: Annotated[float, quantity.FORCE_RATE] = 100.0
    lifting_speed: Annotated[float, quantity.SPEED] = 0.05
    lift_height: Annotated[float, quantity.LIFT] | None = None
    set_down_height: Annotated[float, quantity.LIFT] | None = None
    partner_stop: Annotated[float, quantity.SEPARATION] | None = None
    grip_time: Annotated[float, quantity.GRIP_TIME] = 0.5
    grip_limit: Annotated[float, quantity.GRIP_TIME] = 3.0

    @property
    def speed_max(self) -> float:
        """Largest allowed speed of the box [m/s]; infinite if `partner_stop` is None.

        At this speed the pads move apart by `partner_stop` if one arm stops on its own and the
        other arm stops `PARTNER_TIME` later.
        """
        return np.inf if self.partner_stop is None else self.partner_stop / PARTNER_TIME


# --- the whole cell ---


OFFSET_TOLERANCE = 1e-9
"""Contacts count as laterally offset from this distance on, seen along their normals [m]."""

OPPOSITE = 1e-9
"""Two unit normals count as opposite if their sum is shorter than this."""

SEARCHED_BRANCH = -2
"""Value in `Workcell.start_branch` of a robot whose branches all compete in the search."""


@dataclass(frozen=True)
class IgnoredPair:
    """Two bodies, or groups of bodies, that are not checked for collision against each other.

    Attributes:
        first, second: names of bodies, or patterns with `*` and `?` that stand for several bodies.
        reason: the user's reason, shown wherever pairs are listed.
    """

    first: Label
    second: Label
    reason: Label


@dataclass(frozen=True)
class CollisionSettings:
    """Settings of collision checking.

    Attributes:
        tolerance: distance below which two bodies count as colliding [m].
        ignored: pairs of bodies that the user left out of the check.
        most_pieces: largest accepted number of convex pieces of all bodies together.
    """

    tolerance: Annotated[float, quantity.TOLERANCE] = 0.0
    ignored: tuple[IgnoredPair, ...] = ()
    most_pieces: Annotated[int, Range(1, 20_000)] = 500


@dataclass(frozen=True, eq=False)
class Workcell:
    """A dual-arm cell and its task. Two records are equal only if they are the same object, so that
    results can be cached by workcell.

    Attributes:
        name: title for reports.
        robots: the two arms; robot i holds contact i.
        payload, contacts, task, environment, collision, uncertainty, handling: records of the parts
            of the cell.
        start_branch: for each robot the index of its start branch, counted from the best of the
            ranking. -1 selects the best. `SEARCHED_BRANCH` lets all branches compete
            (`hybrid_opt.branches`); until then the best is used.
        source: the file that the workcell was read from.
        reading: digests of the workcell when it was read from `source`; None if it was not read.
        text: content that was read in place of the file's content; None for the file's content.
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
    uncertainty: Uncertainty = USUAL_UNCERTAINTY
    handling: Handling = field(default_factory=Handling)
    text: bytes | None = field(default=None, repr=False)

    def stack_joint_limits(self, name: str) -> Array:
        """Return the joint limits `name`, an attribute of `Robot` such as 'velocity_max', of both
        robots in one array (all joints,)."""
        return np.concatenate([getattr(robot, name) for robot in self.robots])

    @cached_property
    def has_facing_pads(self) -> bool:
        """True if two round pads with opposite normals hold the payload."""
        return self.has_opposite_pads and not any(c.half_sides for c in self.contacts)

    @cached_property
    def has_opposite_pads(self) -> bool:
        """True if two pads with opposite normals hold the payload, with patches of any shape."""
        if any(contact.further for contact in self.contacts):
            return False
        first, second = (contact.T_box_pad[:3, 2] for contact in self.contacts)
        return bool((np.abs(first + second) <= OPPOSITE).all())

    @cached_property
    def pad_distance(self) -> float:
        """Distance of the two contact points along the normal of contact 1 [m]."""
        first, second = (contact.T_box_pad[:3, 3] for contact in self.contacts)
        return abs(float((first - second) @ self.contacts[0].T_box_pad[:3, 2]))

    @cached_property
    def pad_offset(self) -> float:
        """Distance of the two contact points perpendicular to the normal of contact 1 [m]."""
        first, second = (contact.T_box_pad[:3, 3] for contact in self.contacts)
        normal, apart = self.contacts[0].T_box_pad[:3, 2], first - second
        return float(np.linalg.norm(apart - (apart @ normal) * normal))

    @cached_property
    def has_offset_pads(self) -> bool:
        """True if the contacts are offset perpendicular to the normal of contact 1."""
        return self.pad_offset > OFFSET_TOLERANCE

    @cached_property
    def pads(self) -> tuple[Contact, ...]:
        """All pads of both contacts: those of the first robot, then those of the second."""
        return tuple(pad for contact in self.contacts for pad in (contact, *contact.further))

    @cached_property
    def pad_robots(self) -> tuple[int, ...]:
        """For each of `pads` the index of its robot."""
        return tuple(i for i, c in enumerate(self.contacts) for _ in range(1 + len(c.further)))

    @cached_property
    def digest(self) -> str:
        """Key of the cell in caches and results: SHA-256 over the workcell file and every file that
        it names (URDF, meshes), and over the values if the cell was changed in memory.

        It is '' if the workcell was not read from a file, or names other files than it was read
        with.
        """
        if self.reading is None:
            return ""
        files, now = self.reading.files, reading_of(self, "")
        if now.values == self.reading.values:
            return files
        if not now.named <= self.reading.named:  # other files than were read describe it
            return ""
        return hashlib.sha256(f"{files} {now.values}".encode()).hexdigest()


def box_flange(robot: Robot, contact: Contact) -> Array:
    """Compute the flange frame in the box frame, T_box_flange (4, 4), while a robot holds the box
    with its pad in the contact `contact`."""
    known: Array | None = getattr(robot, "T_box_flange", None)  # of numbers that are symbols
    return contact.T_box_pad @ inverse(robot.T_flange_pad) if known is None else known


def flange_lever(robot: Robot, contact: Contact) -> Array:
    """Compute the vector (3,) from a robot's flange to the nominal contact point, box axes [m],
    while the robot holds the box."""
    known: Array | None = getattr(robot, "lever", None)
    return contact.T_box_pad[:3, 3] - box_flange(robot, contact)[:3, 3] if known is None else known


PAYLOAD_NAME = "payload"
"""Name of the payload's body."""
