"""MJCF of the simulated scenes: a free box between two pads on a carriage, and the whole cell.

Each pad is a set of small spheres that touch the face of the box. They are spread over the whole
patch for an elastic pad that presses evenly while an arm keeps its orientation. On the carriage the
leader's pad is fixed, the other slides along its normal. Gravity does not act on carriage and pads,
which are driven.

The whole cell has both arms with their links' masses, pads, box and environment. Joints are those
of the workcell's kinematic model, moved by torques. Pads touch the box, and the box touches the
environment. Other bodies have mass and are visible, but do not collide: `hybrid_opt.collision`
checks the arms.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal

import numpy as np
import pinocchio
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.geometry.bodies import Frame, arm_geometry, collision_bodies
from symbolic.geometry.pieces import Hull, Piece
from symbolic.read.arms import arm_model, common_joints
from symbolic.records import Box, Capsule, Contact, Cylinder, Payload, Sphere, Workcell
from symbolic.records.poses import inverse, pose_matrix
from symbolic.records.quantities import GRAVITY

CARRIAGE_MASS = 1e5
"""Mass of the carriage [kg], and its inertia about every axis [kg m^2]. It is so large that the box
hardly moves the carriage within a step, and the carriage's state is set anew at each step."""

PAD_MASS = 10.0
"""Mass of a pad [kg]; its inertia is fed forward."""

PAD_INERTIA = 2e-3
"""Inertia of a pad [kg m^2]. The moments that rotate it are negligible beside the planned
moments."""

TILT_STIFFNESS = 20.0
"""Tilt stiffness of each driven pad about the axes in its plane [N m/rad]."""

TILT_DAMPING_TIME = 2e-3
"""Damping of a pad's tilt over its stiffness [s]."""

POINT_RADIUS = 2e-3
"""Radius of the spheres at contact points [m]."""

PLATE_REACH, PLATE_THICKNESS = 3.0, 0.01
"""Half the side of a plate under a pad, over the patch's radius; and its thickness [m]."""

IMPEDANCE = 0.1
"""MuJoCo's impedance d of the pads' contacts. Smaller values reduce the effect of their
regularisation."""

LAYER_DAMPING = 0.7
"""Damping ratio of a pad's layer. With less damping the pads lose contact where accelerations jump.
With more damping a sliding pad is pushed off, which widens its pressure."""

IMPRATIO = 3e3
"""MuJoCo's impratio: the factor by which frictional contacts creep less than normal ones."""

MUJOCO_TOLERANCE = 1e-12
"""MuJoCo's tolerance of a step's solution in a cell without a carriage. MuJoCo multiplies it by the
mean inertia; with that of the carriage included, held boxes with many points drift by 0.3 mm/s."""

SUPPORT = 'solref="0.01 1" solimp="0.7 0.7 0.001"'
"""Contact parameters of the box on its support. Much stiffer contacts lose touch where
accelerations jump."""

LARGEST_TIME_STEP = 2e-3
"""Largest time step [s]. With a larger one the pads' layers are too stiff to be integrated."""

Pads = Literal["even", "driven"]

PRESSES = 1
"""Bit of MuJoCo's contact types for bodies that press on the box."""

SOLID = 'contype="2" conaffinity="0"'

UNTOUCHED = 'contype="0" conaffinity="0"'


@dataclass(frozen=True)
class ContactSettings:
    """Settings of simulated contacts, of pads alone and of whole cells.

    Attributes:
        time_step: time step of the physics [s].
        points: approximate number of contact points of a patch.
        layer: stiffness of the pads' elastic layer per area [N/m^3]; the default is that of rubber
            of 2 MPa, 5 mm thick.
        slip: displacement of the box in the plane of a pad from which on it counts as slipping [m].
    """

    time_step: float = 1e-3
    points: int = 37
    layer: float = 4e8
    slip: float = 1e-3

    def __post_init__(self) -> None:
        if not 0.0 < self.time_step <= LARGEST_TIME_STEP:
            raise SettingsError(
                f"time step {self.time_step:g} s: allowed is up to {LARGEST_TIME_STEP:g} s",
                code="time-step",
            )
        if self.points < 3 or not self.layer > 0.0:
            raise SettingsError(
                "give at least three contact points and a positive layer stiffness",
                code="contact-points",
            )
        if not self.slip > 0.0:
            raise SettingsError("give a positive slip")


@dataclass(frozen=True)
class SimulationSettings(ContactSettings):
    """Settings of the simulation of pads without arms.

    Attributes:
        pads: 'even' for points all over the patches, on pads that keep their planned orientation;
            'driven' for pads as the contact model `paper` assumes them, with points at the rim of a
            round patch or the corners of a rectangle, and rotated by the planned moments.
        settle: time at rest before the carry begins [s].
    """

    pads: Pads = "even"
    settle: float = 0.15

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.settle > 0.0:
            raise SettingsError("give a positive time to settle")


@dataclass(frozen=True)
class ArmSettings(ContactSettings):
    """Settings of the simulated cell and its controllers.

    Attributes:
        control_period: period of the controllers, a multiple of the time step [s].
        arrival: largest distance from its goal at which the box may end [m].
        stiffness: stiffness of each joint over its largest torque [1/rad].
        damping_ratio: damping ratio of each joint, for the inertia about the joint at the start.
        armature: inertia of each motor, as seen at the joint, over the joint's largest torque [kg
            m^2 / (N m)]. Descriptions of robots do not state it.
        force_gain: gain of the integral force control [1/s].
        drift_stiffness: stiffness of each arm along the normal if both are force controlled [N/m].
        support_friction: friction coefficient between the box and its support.
    """

    control_period: float = 1e-3
    arrival: float = 5e-3
    stiffness: float = 20.0
    damping_ratio: float = 0.7
    armature: float = 5e-3
    force_gain: float = 20.0
    drift_stiffness: float = 2000.0
    support_friction: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        steps = self.control_period / self.time_step
        if not (steps > 0.99 and abs(steps - round(steps)) < 1e-6):
            raise SettingsError(
                "give a control period that is a multiple of the time step", code="control-period"
            )
        positive = (self.arrival, self.stiffness, self.damping_ratio)
        other = (self.armature, self.force_gain, self.drift_stiffness, self.support_friction)
        if not (min(positive) > 0.0 and min(other) >= 0.0):
            raise SettingsError("give positive settings of the controllers")


def scene_text(
    workcell: Workcell, settings: SimulationSettings, leader: int, disturbance: ArrayLike
) -> str:
    """Return the MJCF document (MuJoCo's XML) of a simulation without arms: the box between two
    pads, which are mounted on a carriage, a heavy body that the simulation moves.

    The simulation compiles the text by `compiled`.

    Args:
        workcell: the cell.
        settings: settings of the simulation.
        leader: index (0 or 1) of the pad that is fixed to the carriage. The other pad slides on it
            along the contact normal.
        disturbance: (3,) acceleration that the pads have to give the box in addition to the
            acceleration of the motion, world frame [m/s^2]. It acts like a change of gravity.
    """
    pads = "\n".join(_pad_text(workcell, settings, i, slides=i != leader) for i in (0, 1))
    return carriage_text(workcell, settings, disturbance, pads)


def carriage_text(
    workcell: Workcell,
    settings: ContactSettings,
    disturbance: ArrayLike,
    bodies: str,
    actuators: str = "",
    impratio: float = IMPRATIO,
) -> str:
    """Return the MJCF document of a free payload and a carriage, a heavy body that bears pads or
    hands.

    Args:
        workcell: the cell.
        settings: settings of the contacts.
        disturbance: (3,) acceleration that the pads have to give the payload in addition to the
            acceleration of the motion, world frame [m/s^2].
        bodies: MJCF of the bodies on the carriage.
        actuators: MJCF of the actuators.
        impratio: MuJoCo's option: the larger it is, the less frictional contacts creep.
    """
    payload, touched = workcell.payload, 'contype="0" conaffinity="1"'
    if presses_on_box(workcell):
        faces = f'<geom type="box" size="{mjcf_text(payload.size / 2.0)}" {touched}/>'
    else:
        faces = plates(workcell, touched)
    return f"""
<mujoco>
  <compiler angle="radian"/>
  {solver_options(settings, np.array(GRAVITY) - np.asarray(disturbance), CARRIAGE_MASS, impratio)}
  <worldbody>
    <body name="carriage" gravcomp="1">
      <freejoint/>
      <inertial pos="0 0 0" mass="{CARRIAGE_MASS!r}"
        diaginertia="{mjcf_text([CARRIAGE_MASS] * 3)}"/>
      {bodies}
    </body>
    {box_body(payload, faces)}
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>"""


def compiled(mujoco: ModuleType, text: str, damping: float = LAYER_DAMPING) -> tuple[Any, str]:
    """Compile an MJCF document.

    Args:
        mujoco: the simulator's Python module.
        text: the document.
        damping: damping ratio of the elastic layers at the pads' contact points.

    Returns:
        MuJoCo's model, and the document as MuJoCo reads it.
    """
    scene = mujoco.MjSpec.from_string(text)
    model = scene.compile()
    box = int(model.body("box").id)
    for geom in scene.geoms:
        if geom.contype != PRESSES:
            continue
        pad = int(model.geom_bodyid[geom.id])
        inverse_mass = float(model.body_invweight0[[pad, box], 0].sum())
        pulled = -float(geom.solref[0]) * inverse_mass * (1.0 - IMPEDANCE) / IMPEDANCE
        damped = 2.0 * damping * np.sqrt(pulled)
        geom.solref = [-pulled * IMPEDANCE, -damped * IMPEDANCE]
    return scene.compile(), scene.to_xml()


def box_body(payload: Payload, geoms: str) -> str:
    """Return the free body `box` as MJCF, with mass and inertia of the payload.

    Args:
        payload: the payload.
        geoms: MJCF of its geoms.
    """
    about = payload.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return f"""<body name="box">
      <freejoint name="box"/>
      <inertial pos="{mjcf_text(payload.centre_of_mass)}" mass="{payload.mass!r}"
        fullinertia="{mjcf_text(about)}"/>
      {geoms}
    </body>"""


def solver_options(
    settings: ContactSettings, gravity: Array, heaviest: float = 1.0, impratio: float = IMPRATIO
) -> str:
    """Return MuJoCo's options as MJCF. They select elliptic friction cones, a small tolerance of
    the solver, and a large `impratio`, which keeps frictional contacts from creeping.

    Args:
        settings: settings of the contacts.
        gravity: (3,) gravity in the world [m/s^2].
        heaviest: mass of the heaviest body, if it is much heavier than the box [kg].
        impratio: MuJoCo's option: the larger it is, the less frictional contacts creep.
    """
    return f"""<option timestep="{settings.time_step!r}" gravity="{mjcf_text(gravity)}"
    cone="elliptic" impratio="{impratio!r}" integrator="implicitfast" solver="Newton"
    iterations="200" tolerance="{MUJOCO_TOLERANCE / heaviest!r}"/>"""


def contact_points(
    contact: Contact, settings: ContactSettings, T_body_pad: Array, pads: Pads = "even"
) -> str:
    """Return spheres at the contact points of a robot's pads, as MJCF geoms of one body. The
    spheres touch the planes of the patches.

    Args:
        contact: contact of the robot.
        settings: settings of the contacts.
        T_body_pad: (4, 4) pose of the first pad in the frame of the body.
        pads: kind of pads, as in `SimulationSettings`.
    """
    T_body_box = T_body_pad @ inverse(contact.T_box_pad)
    text = []
    for pad in (contact, *contact.further):
        around = pressed_points(pad, pads, settings.points)
        T = T_body_pad if pad is contact else T_body_box @ pad.T_box_pad
        text.append(point_geoms(pad, settings.layer, around, T))
    return "\n".join(text)


def point_geoms(pad: Contact, layer: float, points: Array, T_body_pad: Array) -> str:
    """Return spheres that touch the plane of a pad, as MJCF geoms of one body.

    Args:
        pad: the pad.
        layer: stiffness of its elastic layer per area [N/m^3].
        points: (n, 2) points in the plane of the pad [m].
        T_body_pad: (4, 4) pose of the pad in the frame of the body.
    """
    in_pad = np.column_stack([points, np.full(len(points), -POINT_RADIUS)])
    stiffness = layer * pad.area / len(points)
    return "\n".join(
        f'<geom type="sphere" size="{POINT_RADIUS!r}" contype="{PRESSES}" conaffinity="0" '
        f'priority="1" friction="{pad.friction!r} 0 0" pos="{mjcf_text(place)}" '
        f'solref="{-stiffness!r} -1" solimp="{IMPEDANCE!r} {IMPEDANCE!r} 0.001"/>'
        for place in in_pad @ T_body_pad[:3, :3].T + T_body_pad[:3, 3]
    )


def patch_area(contact: Contact) -> float:
    """Compute the area of all pads of a robot's contact [m^2]."""
    return sum(pad.area for pad in (contact, *contact.further))


def pressed_points(contact: Contact, pads: Pads, points: int) -> Array:
    """Compute the points (n, 2) of a patch that press on the payload, in the plane of the pad [m].

    Points of pads of the kind 'driven' lie evenly around the rim of a round patch, or at the
    corners of a rectangle. The corners can carry every load of the sides, with the largest lever
    for torsion.

    Args:
        contact: the pad.
        pads: kind of pads, as in `SimulationSettings`.
        points: approximate number of points.
    """
    if pads == "driven":
        return rim(contact, points if contact.half_sides is None else 4)
    if contact.half_sides is None:
        # Sunflower: equal areas, each turned on by the golden angle.
        k = np.arange(points)
        angle = k * np.pi * (3.0 - np.sqrt(5.0))
        reach = contact.patch_radius * np.sqrt((k + 0.5) / points)
        return np.column_stack([reach * np.cos(angle), reach * np.sin(angle)])
    x, y = contact.half_sides
    rows = max(2, round(float(np.sqrt(points * y / x))))
    columns = max(2, round(points / rows))
    across, along = ((2.0 * np.arange(n) + 1.0) / n - 1.0 for n in (columns, rows))
    return np.asarray([(x * a, y * b) for a in across for b in along])


def tilt_centre(contact: Contact) -> Array:
    """Compute the middle of a robot's pads (3,) in the frame of its first pad [m]. A normal force
    that acts there is shared evenly by all pads.
    """
    places = np.mean([pad.T_box_pad[:3, 3] for pad in (contact, *contact.further)], axis=0)
    T = contact.T_box_pad
    return np.asarray(T[:3, :3].T @ (places - T[:3, 3]))


def rim(contact: Contact, points: int) -> Array:
    """Compute points (n, 2) on the rim of a patch in the plane of the pad [m]: evenly around a
    round patch, or evenly along the sides of a rectangle, corners included.

    Args:
        contact: the pad.
        points: number of points.
    """
    if contact.half_sides is None:
        angles = 2.0 * np.pi * np.arange(points) / points
        return contact.patch_radius * np.column_stack([np.cos(angles), np.sin(angles)])
    corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]])
    per_side = -(-points // 4)
    along = np.arange(4 * per_side) / per_side
    signs = [np.interp(along, np.arange(5), corners[:, k]) for k in (0, 1)]
    return np.column_stack(signs) * contact.half_sides


def presses_on_box(workcell: Workcell) -> bool:
    """Return True if the cell's payload is a box and all pads press on its faces."""
    size = workcell.payload.size
    return workcell.payload.shape is None and all(
        abs(pad.T_box_pad[:3, 2] @ (pad.T_box_pad[:3, 3] + pad.T_box_pad[:3, 2] * size / 2.0))
        < 1e-9
        and np.abs(pad.T_box_pad[:3, 2]).max() > 1.0 - 1e-9
        for pad in workcell.pads
    )


def plates(workcell: Workcell, touched: str) -> str:
    """Return a flat plate under each pad, as MJCF geoms of the box, to be the contact surface of a
    payload that is not a box.

    Args:
        workcell: the cell.
        touched: MJCF attributes that state which bodies may touch the plates.
    """
    text = []
    for pad in workcell.pads:
        T = pad.T_box_pad @ pose_matrix([0.0, 0.0, PLATE_THICKNESS / 2.0], [0.0, 0.0, 0.0])
        reach = PLATE_REACH * pad.patch_radius
        size = mjcf_text([reach, reach, PLATE_THICKNESS / 2.0])
        text.append(f'<geom type="box" size="{size}" {placed(T)} {touched} friction="0 0 0"/>')
    return "\n".join(text)


def piece_geom(piece: Piece, touch: str, meshes: list[str]) -> str:
    """Return a convex solid as an MJCF geom.

    Args:
        piece: the solid.
        touch: MJCF attributes that state which bodies it may touch.
        meshes: list of MJCF assets, to which the mesh of a convex hull is added.
    """
    shape = piece.shape
    match shape:
        case Box():
            kind = f'type="box" size="{mjcf_text(np.asarray(shape.size) / 2.0)}"'
        case Cylinder():
            kind = f'type="cylinder" size="{mjcf_text([shape.radius, shape.length / 2.0])}"'
        case Sphere():
            kind = f'type="sphere" size="{float(shape.radius)!r}"'
        case Capsule():
            kind = f'type="capsule" size="{mjcf_text([shape.radius, shape.length / 2.0])}"'
        case Hull():
            name = f"hull_{len(meshes) + 1}"
            # Its own vertices, about their own frame: MuJoCo moves a mesh to its centre otherwise.
            meshes.append(f'<mesh name="{name}" vertex="{mjcf_text(shape.vertices)}"/>')
            kind = f'type="mesh" mesh="{name}"'
    return f"<geom {kind} {placed(piece.pose)} {touch}/>"


def tilt_names(robot: int) -> tuple[str, str]:
    """Return the names of the joints that rotate a robot's pad about its x and its y axis.

    Args:
        robot: index of the robot.
    """
    return f"tilt_x_{robot + 1}", f"tilt_y_{robot + 1}"


def pad_site(robot: int, T_body_pad: Array) -> str:
    """Return the site of a robot's first pad as MJCF.

    Args:
        robot: index of the robot.
        T_body_pad: (4, 4) pose of the pad in the frame of the body.
    """
    return f'<site name="pad_{robot + 1}" {placed(T_body_pad)} size="0.005"/>'


def _pad_text(workcell: Workcell, settings: SimulationSettings, i: int, slides: bool) -> str:
    contact = workcell.contacts[i]
    centre = mjcf_text(tilt_centre(contact))
    joints = '<joint name="press" type="slide" axis="0 0 1"/>' if slides else ""
    if settings.pads == "driven":
        joints += "".join(
            f'<joint name="{tilt}" type="hinge" axis="{axis}" pos="{centre}" '
            f'stiffness="{TILT_STIFFNESS!r}" damping="{TILT_DAMPING_TIME * TILT_STIFFNESS!r}"/>'
            for tilt, axis in zip(tilt_names(i), ("1 0 0", "0 1 0"), strict=True)
        )
    return f"""<body gravcomp="1" {placed(contact.T_box_pad)}>
        {joints}
        <inertial pos="{centre}" mass="{PAD_MASS!r}" diaginertia="{mjcf_text([PAD_INERTIA] * 3)}"/>
        {pad_site(i, np.eye(4))}
        {contact_points(contact, settings, np.eye(4), settings.pads)}
      </body>"""


def placed(T: Array) -> str:
    """Return a transform T (4, 4) as position and orientation attributes of MJCF."""
    turn = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    return f'pos="{mjcf_text(T[:3, 3])}" quat="{mjcf_text(turn)}"'


def mjcf_text(values: ArrayLike) -> str:
    """Return numbers as the value of an MJCF attribute."""
    return " ".join(repr(float(value)) for value in np.ravel(values))


def cell_text(workcell: Workcell, settings: ArmSettings) -> str:
    """Return the MJCF document of a whole cell, for `compiled`.

    Joints in the document are named `joint_ROBOT_NUMBER`, sites of the pads `pad_1` and `pad_2`,
    the box `box`. A joint that moves both arms occurs in the document once per arm, with its link;
    a constraint keeps both copies equal. The effort of each copy includes the whole weight of the
    link.

    Args:
        workcell: the cell.
        settings: settings of the simulation.
    """
    meshes: list[str] = []
    shown: dict[Frame, list[str]] = {}
    for body in collision_bodies(workcell):
        touch = SOLID if body.group == "environment" else UNTOUCHED
        if body.frame.kind != "box":
            look = f'{touch} group="1" density="0"'
            geoms = [piece_geom(piece, look, meshes) for piece in body.pieces]
            shown.setdefault(body.frame, []).extend(geoms)
    payload = workcell.payload
    look = 'friction="0 0 0" rgba="0.8 0.6 0.3 1"'
    if presses_on_box(workcell):
        size = mjcf_text(payload.size / 2.0)
        solid = f'<geom type="box" size="{size}" contype="0" conaffinity="3" {look}/>'
    else:
        held = next(body for body in collision_bodies(workcell) if body.frame.kind == "box")
        touch = f'contype="0" conaffinity="2" {look} density="0"'
        solid = "\n".join(piece_geom(piece, touch, meshes) for piece in held.pieces)
        solid += plates(workcell, 'contype="0" conaffinity="1" group="3" density="0"')
    arms = "\n".join(_arm(workcell, settings, i, shown) for i in (0, 1))
    return f"""
<mujoco>
  <compiler angle="radian" boundmass="0.001" boundinertia="0.000001" balanceinertia="true"/>
  {solver_options(settings, np.array(GRAVITY))}
  <default>
    <geom {SUPPORT} friction="{settings.support_friction!r} 0 0"/>
  </default>
  <asset>{"".join(meshes)}</asset>
  <worldbody>
    <light pos="0 0 4" directional="true"/>
    {"".join(shown.get(Frame("world"), []))}
    {arms}
    {box_body(payload, solid)}
  </worldbody>
  <equality>{"".join(_ties(workcell))}</equality>
</mujoco>"""


def _ties(workcell: Workcell) -> Iterator[str]:
    """Yield MJCF constraints, as stiff as the time step allows, that keep both copies of a joint
    equal, for each joint that moves both arms of the cell.
    """
    names = [tuple(arm_model(robot).names)[1:] for robot in workcell.robots]
    for name in common_joints(workcell.robots):
        first, second = (_name("joint", i, own.index(name)) for i, own in enumerate(names))
        yield f'<joint joint1="{first}" joint2="{second}" solref="{2.0 * LARGEST_TIME_STEP!r} 1"/>'


def _arm(workcell: Workcell, settings: ArmSettings, i: int, shown: dict[Frame, list[str]]) -> str:
    """Return the links of one arm as nested bodies of MJCF. The body of the last joint bears the
    arm's pads.

    Args:
        workcell: the cell.
        settings: settings of the simulation.
        i: index of the arm.
        shown: MJCF geoms of the bodies that are only shown, by frame.
    """
    model, geometry = arm_model(workcell.robots[i]), arm_geometry(workcell, i)
    contact = workcell.contacts[i]
    # The pad stands at the nominal contact, wherever the box is displaced to.
    T_joint_pad = geometry.T_joint_box @ contact.T_box_pad
    armature = settings.armature * workcell.robots[i].torque_max
    inner = f"""{pad_site(i, T_joint_pad)}
      {contact_points(contact, settings, T_joint_pad)}"""
    for j in reversed(range(len(geometry.axes))):
        kind = "hinge" if geometry.turning[j] else "slide"
        T = geometry.origins[j] if j else geometry.T_world_root @ geometry.origins[0]
        inner = f"""<body name="{_name("link", i, j)}" {placed(T)}>
      <joint name="{_name("joint", i, j)}" type="{kind}" axis="{mjcf_text(geometry.axes[j])}"
        armature="{float(armature[j])!r}"/>
      {_inertial(model.inertias[j + 1])}
      {"".join(shown.get(Frame("link", i, j), []))}
      {inner}
    </body>"""
    return inner


def _name(kind: str, robot: int, joint: int) -> str:
    return f"{kind}_{robot + 1}_{joint + 1}"


def joint_names(workcell: Workcell) -> list[str]:
    """Return the names of both arms' joints in the MJCF document, first those of arm 1."""
    counts = [len(robot.torque_max) for robot in workcell.robots]
    return [_name("joint", i, j) for i, count in enumerate(counts) for j in range(count)]


def _inertial(inertia: pinocchio.Inertia) -> str:
    about = np.asarray(inertia.inertia)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    mass = float(inertia.mass)
    if not mass > 0.0:
        return '<inertial pos="0 0 0" mass="0.001" diaginertia="0.000001 0.000001 0.000001"/>'
    return (
        f'<inertial pos="{mjcf_text(inertia.lever)}" mass="{mass!r}" '
        f'fullinertia="{mjcf_text(about)}"/>'
    )
