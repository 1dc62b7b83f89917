"""The whole cell as MJCF: both arms with their links' masses, pads, box and environment.

Joints are as in the workcell's kinematic model, moved by torques. Each pad is a ring of small
spheres at the rim of its patch, or one at each corner (`hybrid_opt.witness.scene`). Pads touch the
box, the box touches the environment; everything else is there for its mass and to be looked at:
collisions of the arms are ruled out elsewhere (`hybrid_opt.collision`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio

from hybrid_opt.errors import WitnessError
from hybrid_opt.witness.scene import (
    Pads,
    box_body,
    contact_points,
    mjcf_text,
    piece_geom,
    placed,
    plates,
    presses_on_box,
    solver_options,
)
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.geometry.bodies import Frame, arm_geometry, collision_bodies
from symbolic.read.arms import arm_model, common_joints
from symbolic.records import Workcell
from symbolic.records.quantities import GRAVITY

SOFTNESS = "0.7 0.7 0.001"
"""Softness of contacts: at 0.7 MuJoCo's regularisation lets a pad give by some hundredths of a
millimetre. Much stiffer ones lose contact for single steps where accelerations jump."""

SOLID = 'contype="2" conaffinity="0"'
UNTOUCHED = 'contype="0" conaffinity="0"'


@dataclass(frozen=True)
class ArmSettings:
    """How the cell and its controllers are simulated.

    Attributes:
        time_step: of the physics [s].
        control_period: of the controllers, a multiple of the time step [s].
        contact_time: time constant of a contact [s].
        pads, points: see `hybrid_opt.witness.scene.SimulationSettings`.
        noslip_iterations: of MuJoCo's solver against the creep of frictional contacts.
        slip: displacement in the plane of a pad that counts as slip [m].
        arrival: how far from its goal the box may end [m].
        stiffness: of each joint over its largest torque [1/rad].
        damping_ratio: of each joint with the inertia that it moves at the start.
        armature: inertia of a motor seen from behind its gear, over the joint's largest torque
            [kg m^2 / (N m)]; no description of a robot states it.
        force_gain: of the integral force control [1/s].
        drift_stiffness: along the normal, of each arm where both are force-controlled [N/m].
        support_friction: between the box and what it stands on.
    """

    time_step: float = 5e-4
    control_period: float = 1e-3
    contact_time: float = 0.01
    pads: Pads = "rim"
    points: int = 32
    noslip_iterations: int = 30
    slip: float = 1e-3
    arrival: float = 5e-3
    stiffness: float = 20.0
    damping_ratio: float = 0.7
    armature: float = 5e-3
    force_gain: float = 20.0
    drift_stiffness: float = 2000.0
    support_friction: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < 2.0 * self.time_step <= self.contact_time:
            raise SettingsError(
                f"time step {self.time_step:g} s with contacts of {self.contact_time:g} s: give a "
                "contact time of at least two time steps"
            )
        steps = self.control_period / self.time_step
        if not (steps > 0.99 and abs(steps - round(steps)) < 1e-6):
            raise SettingsError("give a control period that is a multiple of the time step")
        if self.points < 3 or self.noslip_iterations < 0:
            raise SettingsError("give at least three contact points and no negative iterations")
        positive = (self.slip, self.arrival, self.stiffness, self.damping_ratio)
        other = (self.armature, self.force_gain, self.drift_stiffness, self.support_friction)
        if not (min(positive) > 0.0 and min(other) >= 0.0):
            raise SettingsError("give positive settings of the controllers")

    def joint_stiffness(self, workcell: Workcell) -> Array:
        """(all joints,) of both arms, side by side [N m/rad]."""
        return self.stiffness * joint_torque_max(workcell)

    def joint_armature(self, workcell: Workcell) -> Array:
        """(all joints,) of both arms, side by side [kg m^2]."""
        return self.armature * joint_torque_max(workcell)


def joint_torque_max(workcell: Workcell) -> Array:
    """(all joints,) largest torque of both arms' joints, side by side [N m]."""
    return np.concatenate([robot.torque_max for robot in workcell.robots])


def cell_text(workcell: Workcell, settings: ArmSettings) -> str:
    """The MJCF document.

    Joints are named `joint_ROBOT_NUMBER`, sites of the pads `pad_1` and `pad_2`, the box `box`.

    Raises:
        WitnessError: one joint moves both arms.
    """
    common = common_joints(workcell.robots)
    if common:
        raise WitnessError(f"joint {common[0]!r} moves both arms; hold it (locked_joints)")
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
  {solver_options(settings.time_step, settings.noslip_iterations, np.array(GRAVITY))}
  <default>
    <geom solref="{settings.contact_time!r} 1" solimp="{SOFTNESS}" condim="3"
      friction="{settings.support_friction!r} 0 0"/>
  </default>
  <asset>{"".join(meshes)}</asset>
  <worldbody>
    <light pos="0 0 4" directional="true"/>
    {"".join(shown.get(Frame("world"), []))}
    {arms}
    {box_body(payload, solid)}
  </worldbody>
</mujoco>"""


def _arm(workcell: Workcell, settings: ArmSettings, i: int, shown: dict[Frame, list[str]]) -> str:
    """The nested bodies of one arm, its pad on the last."""
    model, geometry = arm_model(workcell.robots[i]), arm_geometry(workcell, i)
    contact = workcell.contacts[i]
    # The pad stands where the nominal contact has it, whatever the place on the box is.
    T_joint_pad = geometry.T_joint_box @ contact.T_box_pad
    armature = settings.armature * workcell.robots[i].torque_max
    inner = f"""<site name="pad_{i + 1}" {placed(T_joint_pad)} size="0.005"/>
      {contact_points(contact, settings.pads, settings.points, T_joint_pad)}"""
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
    """Names of both arms' joints in the document, side by side."""
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
