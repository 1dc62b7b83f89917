"""An arm as the workcell describes it, with its tool."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from symbolic.array import Array
from symbolic.workcell.records.shapes import Body


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
        jerk_max: (n,) [rad/s^3], or None without limits.
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
    jerk_max: Array | None = None
