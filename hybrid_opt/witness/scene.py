"""The witness's scene as MJCF: a free box between two pads on a carriage.

Each pad is a ring of small spheres that touch the face of the box at the rim of the patch, or one
at each corner of a rectangle. The leader's pad is fixed to the carriage, the other slides along its
normal. Gravity does not act on carriage and pads, which are driven.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.geometry.pieces import Hull, Piece
from symbolic.records import Box, Capsule, Contact, Cylinder, Payload, Sphere, Workcell
from symbolic.records.poses import inverse, pose_matrix
from symbolic.records.quantities import GRAVITY

CARRIAGE_MASS = 1e5
"""[kg], and [kg m^2] about every axis: what the box does to the carriage within a step is lost in
it, and its state is set anew at each step."""

PAD_MASS = 0.1
"""[kg]; its inertia is fed forward."""

PAD_INERTIA = 5e-4
"""[kg m^2]; what its turning takes is lost in the planned moments."""

TILT_DAMPING_TIME = 2e-3
"""Damping of a pad's tilt over its stiffness [s]."""

POINT_RADIUS = 2e-3
"""Radius of the spheres [m]."""

PLATE_REACH, PLATE_THICKNESS = 3.0, 0.01
"""Half the side of a plate under a pad over the patch's radius, and its thickness [m]."""


Pads = Literal["even", "rim"]
"""Where the contact points of a pad lie."""


@dataclass(frozen=True)
class SimulationSettings:
    """How the witness simulates.

    Attributes:
        time_step: [s].
        contact_time: time constant of a contact [s]; at least a few time steps. The stiffer, the
            more a threshold depends on the time step.
        pads: 'even' for elastic pads, whose points lie evenly over their patches; 'rim' for pads
            that press where the planner's freest pressures do: at the rim of a round patch, at the
            corners of a rectangle.
        points: about how many contact points a patch has.
        noslip_iterations: of MuJoCo's solver against the creep of frictional contacts.
        tilt_stiffness: of each pad about the axes in its plane, where it is driven by the planned
            moments; None for pads that keep their planned orientation, whatever they feel
            [N m/rad].
        settle: time at rest before the carry begins [s].
        slip: displacement in the plane of a pad that counts as slip [m].
    """

    time_step: float = 2e-4
    contact_time: float = 0.01
    pads: Pads = "rim"
    points: int = 32
    noslip_iterations: int = 30
    tilt_stiffness: float | None = None
    settle: float = 0.15
    slip: float = 1e-3

    def __post_init__(self) -> None:
        if not 0.0 < 2.0 * self.time_step <= self.contact_time:
            raise SettingsError(
                f"time step {self.time_step:g} s with contacts of {self.contact_time:g} s: give a "
                "contact time of at least two time steps"
            )
        if self.points < 3 or self.noslip_iterations < 0:
            raise SettingsError("give at least three contact points and no negative iterations")
        if self.tilt_stiffness is not None and not self.tilt_stiffness > 0.0:
            raise SettingsError("give a positive stiffness of the pads' tilt, or none")
        if not (self.settle > 0.0 and self.slip > 0.0):
            raise SettingsError("give a positive time to settle and a positive slip")


def scene_text(
    workcell: Workcell, settings: SimulationSettings, leader: int, disturbance: ArrayLike
) -> str:
    """The MJCF document.

    Args:
        leader: index of the pad that is fixed to the carriage.
        disturbance: (3,) acceleration that the pads have to give the box beside the motion's,
            world frame [m/s^2]; it acts like a change of gravity.
    """
    gravity = np.array(GRAVITY) - np.asarray(disturbance)
    payload = workcell.payload
    touched = 'contype="0" conaffinity="1"'
    if presses_on_box(workcell):
        faces = f'<geom type="box" size="{mjcf_text(payload.size / 2.0)}" {touched}/>'
    else:
        faces = plates(workcell, touched)
    pads = "\n".join(
        _pad_text(contact, f"pad_{i + 1}", settings, slides=i != leader)
        for i, contact in enumerate(workcell.contacts)
    )
    return f"""
<mujoco>
  <compiler angle="radian"/>
  {solver_options(settings.time_step, settings.noslip_iterations, gravity)}
  <default>
    <geom solref="{settings.contact_time!r} 1" solimp="0.99 0.9999 0.0001" condim="3"/>
  </default>
  <worldbody>
    <body name="carriage" gravcomp="1">
      <freejoint/>
      <inertial pos="0 0 0" mass="{CARRIAGE_MASS!r}"
        diaginertia="{mjcf_text([CARRIAGE_MASS] * 3)}"/>
      {pads}
    </body>
    {box_body(payload, faces)}
  </worldbody>
</mujoco>"""


def box_body(payload: Payload, geoms: str) -> str:
    """The free body `box` with the payload's mass and inertia, and what touches it."""
    about = payload.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return f"""<body name="box">
      <freejoint name="box"/>
      <inertial pos="{mjcf_text(payload.centre_of_mass)}" mass="{payload.mass!r}"
        fullinertia="{mjcf_text(about)}"/>
      {geoms}
    </body>"""


def solver_options(time_step: float, noslip_iterations: int, gravity: Array) -> str:
    """MuJoCo's options: cones as they are, solved to many digits."""
    return f"""<option timestep="{time_step!r}" gravity="{mjcf_text(gravity)}" cone="elliptic"
    impratio="20" integrator="implicitfast" solver="Newton" iterations="200" tolerance="1e-12"
    noslip_iterations="{noslip_iterations}" noslip_tolerance="1e-12"/>"""


def contact_points(contact: Contact, pads: Pads, points: int, T_body_pad: Array) -> str:
    """Spheres where a robot's patches press, touching their planes, as geoms of the body that holds
    its pads.

    Args:
        pads, points: see `SimulationSettings`.
        T_body_pad: (4, 4) of the first pad.
    """
    T_body_box = T_body_pad @ inverse(contact.T_box_pad)
    places = []
    for pad in (contact, *contact.further):
        around = pressed_places(pad, pads, points)
        in_pad = np.column_stack([around, np.full(len(around), -POINT_RADIUS)])
        T = T_body_pad if pad is contact else T_body_box @ pad.T_box_pad
        places.append(in_pad @ T[:3, :3].T + T[:3, 3])
    return "\n".join(
        f'<geom type="sphere" size="{POINT_RADIUS!r}" contype="1" conaffinity="0" priority="1" '
        f'friction="{contact.friction!r} 0 0" pos="{mjcf_text(place)}"/>'
        for place in np.concatenate(places)
    )


def pressed_places(contact: Contact, pads: Pads, points: int) -> Array:
    """(n, 2) places of a patch, in its pad's plane, that press on the payload [m].

    Those of the planner's freest pressures lie evenly around a round patch's rim, and at the
    corners of a rectangle: all that presses on its sides could be shared by them and twists less.

    Args:
        pads, points: see `SimulationSettings`.
    """
    if pads == "rim":
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
    """(3,) the middle of a robot's pads, along the axes of the first from its place [m]: what
    presses there shares itself out evenly."""
    places = np.mean([pad.T_box_pad[:3, 3] for pad in (contact, *contact.further)], axis=0)
    T = contact.T_box_pad
    return np.asarray(T[:3, :3].T @ (places - T[:3, 3]))


def rim(contact: Contact, points: int) -> Array:
    """(n, 2) places on a patch's rim in its pad's plane [m]: evenly around, or evenly along the
    sides of a rectangle, corners included."""
    if contact.half_sides is None:
        angles = 2.0 * np.pi * np.arange(points) / points
        return contact.patch_radius * np.column_stack([np.cos(angles), np.sin(angles)])
    corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]])
    per_side = -(-points // 4)
    along = np.arange(4 * per_side) / per_side
    signs = [np.interp(along, np.arange(5), corners[:, k]) for k in (0, 1)]
    return np.column_stack(signs) * contact.half_sides


def presses_on_box(workcell: Workcell) -> bool:
    """Whether all pads press on faces of a box."""
    size = workcell.payload.size
    return workcell.payload.shape is None and all(
        abs(pad.T_box_pad[:3, 2] @ (pad.T_box_pad[:3, 3] + pad.T_box_pad[:3, 2] * size / 2.0))
        < 1e-9
        and np.abs(pad.T_box_pad[:3, 2]).max() > 1.0 - 1e-9
        for pad in workcell.pads
    )


def plates(workcell: Workcell, touched: str) -> str:
    """A flat plate under each pad, as geoms of the box: what pads press on where it is no box.

    The planner takes patches for flat; a pad is moulded to what it holds.

    Args:
        touched: attributes that say what may touch them.
    """
    text = []
    for pad in workcell.pads:
        T = pad.T_box_pad @ pose_matrix([0.0, 0.0, PLATE_THICKNESS / 2.0], [0.0, 0.0, 0.0])
        reach = PLATE_REACH * pad.patch_radius
        size = mjcf_text([reach, reach, PLATE_THICKNESS / 2.0])
        text.append(f'<geom type="box" size="{size}" {placed(T)} {touched} friction="0 0 0"/>')
    return "\n".join(text)


def piece_geom(piece: Piece, touch: str, meshes: list[str]) -> str:
    """A piece as a geom; a hull's mesh is added to the assets."""
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


def tilt_names(pad: str) -> tuple[str, str]:
    """Names of the joints about a pad's x and y axes."""
    return f"{pad}_tilt_x", f"{pad}_tilt_y"


def _pad_text(contact: Contact, name: str, settings: SimulationSettings, slides: bool) -> str:
    joint = '<joint name="press" type="slide" axis="0 0 1"/>' if slides else ""
    stiffness = settings.tilt_stiffness
    if stiffness is not None:
        centre = mjcf_text(tilt_centre(contact))
        joint += "".join(
            f'<joint name="{tilt}" type="hinge" axis="{axis}" pos="{centre}" '
            f'stiffness="{stiffness!r}" '
            f'damping="{TILT_DAMPING_TIME * stiffness!r}"/>'
            for tilt, axis in zip(tilt_names(name), ("1 0 0", "0 1 0"), strict=True)
        )
    return f"""<body name="{name}" gravcomp="1" {placed(contact.T_box_pad)}>
        {joint}
        <inertial pos="0 0 0" mass="{PAD_MASS!r}" diaginertia="{mjcf_text([PAD_INERTIA] * 3)}"/>
        {contact_points(contact, settings.pads, settings.points, np.eye(4))}
      </body>"""


def placed(T: Array) -> str:
    """A transform (4, 4) as MJCF's attributes."""
    return f'pos="{mjcf_text(T[:3, 3])}" quat="{mjcf_text(quaternion(T[:3, :3]))}"'


def quaternion(rotation: Array) -> Array:
    """Unit quaternions (..., 4), real part first, of rotation matrices (..., 3, 3)."""
    last: Array = Rotation.from_matrix(rotation).as_quat()
    return last[..., [3, 0, 1, 2]]


def mjcf_text(values: ArrayLike) -> str:
    """Numbers as an attribute's value."""
    return " ".join(repr(float(value)) for value in np.ravel(values))
