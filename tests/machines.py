"""Robots and cells of machines of the wheel `example-robot-data`, as it has them, for tests."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from symbolic.array import Array
from symbolic.read.arms import held_joints, link_frame, moving_joints, reduced_model
from symbolic.read.cell import load
from symbolic.read.payload import pad_rotation
from symbolic.read.urdf import read_urdf
from symbolic.records import Robot, Workcell
from symbolic.records.poses import inverse, pose_matrix
from tests.symbolic.read.samples import write

SIZE = (0.30, 0.40, 0.25)


def example_robot(name: str) -> Path:
    """A file of the wheel, by its path below the folder `robots`."""
    wheel = distribution("example-robot-data")
    folder = "cmeel.prefix/share/example-robot-data/robots"
    return Path(str(wheel.locate_file(f"{folder}/{name}")))


def ur10_urdf() -> Path:
    """The UR10."""
    return example_robot("ur_description/urdf/ur10_robot.urdf")


def robot_record(urdf: Path, T_world_base: Array | None = None) -> Robot:
    """An arm with a bare flange `tool0` and wide limits."""
    wide = np.full(6, 1e3)
    return Robot(
        name=urdf.stem,
        urdf=urdf,
        package_dirs=(),
        flange="tool0",
        locked_joints=(),
        T_world_base=np.eye(4) if T_world_base is None else T_world_base,
        T_flange_pad=np.eye(4),
        tool=(),
        position_lower=-wide,
        position_upper=wide,
        velocity_max=wide,
        acceleration_max=wide,
        torque_max=wide,
        min_manipulability=0.0,
    )


@dataclass(frozen=True)
class Arm:
    """An arm and a posture in which it can hold a box.

    Attributes:
        urdf: path below the folder `robots`.
        chain: root and tip.
        posture: positions of the joints of the chain that are not locked [rad].
        locked: joints of the chain that are held [rad].
        drop: pattern of links that are left out, '' for none.
    """

    urdf: str
    chain: tuple[str, str]
    posture: tuple[float, ...]
    locked: dict[str, float] = field(default_factory=dict)
    drop: str = ""


_UR = (0.3, -1.2, 1.6, -1.9, -1.4, 0.2)
SINGLE = {
    **{
        name: Arm(f"ur_description/urdf/{name}_robot.urdf", ("base_link", "tool0"), _UR)
        for name in ("ur3", "ur5", "ur10")
    },
    "kinova": Arm(
        "kinova_description/robots/kinova.urdf",
        ("base", "j2s6s200_end_effector"),
        (0.2, 3.6, 1.6, 0.4, 1.9, 0.3),
        drop="*finger*",
    ),
    "z1": Arm(
        "z1_description/urdf/z1.urdf",
        ("link00", "link06"),
        (0.2, 1.4, -1.3, 0.4, 0.3, 0.2),
        drop="gripper*",
    ),
    "panda": Arm(
        "panda_description/urdf/panda.urdf",
        ("panda_link0", "panda_link8"),
        (0.2, 0.3, -1.9, 0.3, 2.2, 0.4),
        {"panda_joint3": 0.1},
        "panda_hand",
    ),
    "xarm7": Arm(
        "xarm_description/urdf/xarm7.urdf",
        ("link_base", "link_eef"),
        (0.2, 0.3, 1.4, 0.3, 1.0, 0.4),
        {"joint3": 0.1},
    ),
}
"""Six- and seven-joint arms, one of the seven held; two of each make a cell."""


@dataclass(frozen=True)
class Machine:
    """Two arms of one file that hold a box.

    Attributes:
        left, right: the arms; postures are not used.
        box: x, y, z of the box's start, in the machine's root [m].
        spin: of both pads [rad].
        pad: pose of the pad in the flange frame.
    """

    left: Arm
    right: Arm
    box: tuple[float, float, float]
    spin: float
    pad: dict[str, list[float]]


def _both(
    urdf: str,
    names: tuple[str, str, str, str],
    sides: tuple[str, str],
    angles: tuple[float, float],
    box: tuple[float, float, float],
    spin: float,
    **pad: list[float],
) -> Machine:
    """A machine whose names of root, tip, locked joint and dropped links have {} for the side."""
    left, right = (
        Arm(urdf, (root, tip), (), {locked: angle}, drop)
        for side, angle in zip(sides, angles, strict=True)
        for root, tip, locked, drop in [[name.format(side) for name in names]]
    )
    return Machine(left, right, box, spin, pad)


_SIDES = ("left", "right")
_TURN = np.pi / 2.0
MACHINES = {
    "tiago_dual": _both(
        "tiago_description/robots/tiago_dual.urdf",
        ("torso_lift_link", "arm_{}_tool_link", "arm_{}_3_joint", "wrist_{}_ft_link"),
        _SIDES,
        (1.2, 1.2),
        (0.65, 0.0, 0.72),
        -_TURN,
        xyz=[0.05, 0.0, 0.0],
        rpy=[0.0, _TURN, 0.0],
    ),
    "tiago_pro": _both(
        "tiago_pro_description/robots/tiago_pro.urdf",
        ("torso_lift_link", "arm_{}_tool_link", "arm_{}_3_joint", "gripper_{}_base_link"),
        _SIDES,
        (0.6, -0.6),
        (0.65, 0.0, 1.2),
        -_TURN,
        xyz=[0.0, 0.0, 0.05],
    ),
    "talos": _both(
        "talos_data/robots/talos_reduced.urdf",
        ("torso_2_link", "wrist_{}_ft_tool_link", "arm_{}_3_joint", "gripper_{}_base_link"),
        _SIDES,
        (0.0, 0.0),
        (0.55, 0.0, 0.2),
        0.0,
        xyz=[0.0, 0.0, -0.05],
        rpy=[np.pi, 0.0, 0.0],
    ),
    "pr2": _both(
        "pr2_description/urdf/pr2.urdf",
        (
            "torso_lift_link",
            "{}_wrist_roll_link",
            "{}_upper_arm_roll_joint",
            "{}_gripper_palm_link",
        ),
        ("l", "r"),
        (0.6, -0.6),
        (0.65, 0.0, 1.0),
        -_TURN,
        xyz=[0.06, 0.0, 0.0],
        rpy=[0.0, _TURN, 0.0],
    ),
}
"""Machines with both arms in one file, their lift and torso held."""


def cell_of(name: str, folder: Path) -> Workcell:
    """The cell of an arm of `SINGLE` or of a machine of `MACHINES`."""
    if name in SINGLE:
        return load(single_cell(SINGLE[name], folder))
    return load(machine_cell(MACHINES[name], folder))


def machine_cell(machine: Machine, folder: Path) -> Path:
    """A workcell of the two arms of one machine that stands at the origin."""
    robots = [
        _robot(name, arm, {}) | {"pad": machine.pad}
        for name, arm in (("left", machine.left), ("right", machine.right))
    ]
    return _cell(folder, robots, np.array([*machine.box, 0.0, 0.0, 0.0]), machine.spin)


def single_cell(arm: Arm, folder: Path, locked: dict[str, float] | None = None) -> Path:
    """A workcell of two of the same arms, each based where its posture holds the box.

    Joints of the arms are locked as their posture has them, or as given.
    """
    urdf = read_urdf(example_robot(arm.urdf))
    held = tuple(arm.locked.items())
    moving = moving_joints(urdf, *arm.chain, held)
    model = reduced_model(urdf, held_joints(urdf, moving, held))
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.array(arm.posture))
    T_root_flange = data.oMf[link_frame(model, arm.chain[1])].homogeneous
    robots = []
    for name, side in (("left", 1), ("right", -1)):
        T_box_pad = np.eye(4)
        T_box_pad[:3, :3] = pad_rotation(np.array([0.0, -side, 0.0]), 0.0)
        T_box_pad[1, 3] = side * SIZE[1] / 2
        pad = pose_matrix(np.array([0.0, 0.0, 0.05]), np.zeros(3))
        T_world_base = T_box_pad @ inverse(pad) @ inverse(T_root_flange)
        rpy = pin.rpy.matrixToRpy(T_world_base[:3, :3])
        base = {"xyz": T_world_base[:3, 3].tolist(), "rpy": rpy.tolist()}
        cell_arm = arm if locked is None else replace(arm, locked=locked)
        robots.append(_robot(name, cell_arm, base))
    return _cell(folder, robots, np.zeros(6))


def _robot(name: str, arm: Arm, base: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": name,
        "urdf": str(example_robot(arm.urdf)),
        "chain": list(arm.chain),
        "locked_joints": arm.locked,
        "base": base,
        "pad": {"xyz": [0.0, 0.0, 0.05]},
        "min_manipulability": 1e-4,
        "drop_links": [arm.drop] if arm.drop else [],
    }


def _cell(folder: Path, robots: list[dict[str, Any]], start: Array, spin: float = 0.0) -> Path:
    """A workcell file in which a box is moved a little from its start."""
    goal = start + np.array([0.02, 0.01, 0.03, 0.0, 0.0, 0.02])
    middle = (start + goal) / 2.0
    cell = {
        "name": "machine",
        "robots": robots,
        "payload": {"size": SIZE, "mass": 1.0},
        "contacts": [
            {
                "xyz": [0.0, side * SIZE[1] / 2, 0.0],
                "spin": spin,
                "friction": 1.0,
                "patch_radius": 0.03,
            }
            for side in (1, -1)
        ],
        "task": {
            "start": start.tolist(),
            "goal": goal.tolist(),
            "samples": 12,
            "reference_speed": 0.2,
            "reference_force": 100.0,
            "waypoints": [{"lower": (middle - 0.02).tolist(), "upper": (middle + 0.02).tolist()}],
        },
    }
    return write(folder, cell)
