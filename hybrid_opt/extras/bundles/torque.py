"""The torque target: joint trajectory controllers that command efforts with gains, for ROS 2.

Both arms are soft joints about the path; the efforts that accelerate, carry and press go with it as
feed-forward, without gravity, which the robots or the simulator compensate. Each of these drivers
takes such efforts (jazzy, or main where that is named):

- joint_trajectory_controller adds the effort of a point to the gains' if `effort` is its only
  command interface (ros2_controllers jazzy, joint_trajectory_controller.cpp:417; validation
  :1805; Humble rejects efforts, :1587).
- franka_ros2 (jazzy): torques without gravity; topics and services in the namespace of the arm,
  the wrench with best effort (franka_robot_state_broadcaster.cpp:125); libfranka sets the load
  only while no motion runs, so the controller becomes active after it.
- ur_robot_driver: direct torque from PolyScope 5.23.0 or 10.10.0 (main, hardware_interface.cpp
  :1479; its page force_torque_control.rst requires 5.25.1 or 10.12.1), without gravity (same page);
  the wrench on `~/wrench` (force_torque_sensor_broadcaster.cpp:120); two forms of SetPayload
  (gpio_controller.cpp `setPayload` of main and of jazzy).
- gz_ros2_control and mujoco_ros2_control, with the arms' links exempt from gravity.

Hands that hold by themselves are switched by a service of std_srvs/SetBool and heard on a topic of
std_msgs/Bool, or on a UR by its digital lines: `~/set_io` with FUN_SET_DIGITAL_OUT = 1 (ur_msgs
SetIO.srv) and pins 0 to 17 (gpio_controller.cpp `setIO`), `~/io_states` with `digital_in_states` of
pin and state (same file, `publishIO`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from hybrid_opt.extras.bundles.arms import (
    FRANKA,
    SEVEN,
    SIX,
    UR,
    described,
    description,
    plan_of,
    prefixes,
    require_arms,
    ros_joints,
)
from hybrid_opt.extras.bundles.job_file import Export, job_text, pad_jacobians
from hybrid_opt.extras.bundles.programs import filled, program, programs
from hybrid_opt.job.records import Job
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from symbolic.robot.model import build_robot_model

CONTROLLER = "carry_controller"

RATES = {"simulation": 1000, "franka": 1000, "ur": 500}
"""Rate of each driver's cycle [Hz]."""

TORQUE_STEPS = (0.02, 0.01, 0.005)
"""Time steps between the points of the trajectory that are tried, in this order [s]."""

GAIN, DAMPING = 7.0, 0.7
"""Stiffness of a joint over its largest torque [1/rad], and damping ratio at its mean inertia."""

FASTEST = 250.0
"""Largest natural frequency of a joint under its gains [rad/s], half of the slowest driver's rate.
Joints with little inertia get lower gains, so that a sampled controller keeps them stable."""

MODEL_STRIDE = 10
"""Inertia and stiffness are computed at every sample of the job with this stride."""

TORQUE_RATE = 1000.0
"""Fastest change of a torque that libfranka accepts [N m/s] (kMaxTorqueRate)."""

CONTACT, SPARE_FORCE, SPARE_TORQUE = 1.5, 20.0, 5.0
"""A collision is reported if a measured force or torque exceeds this multiple of the planned one by
this force [N] or torque [N m]."""

UR_TYPE = r"(?<![a-z0-9])ur\d+e?(?![a-z0-9])"

FRANKA_TYPES = ("fer", "fp3", "fr3", "fr3v2")
"""Arms in franka_description (folder `robots`), by the prefixes of their joints' names."""


def driver_of(workcell: Workcell) -> str:
    """Return the name of the driver for both arms: 'franka', 'ur', or 'simulation' if no arm has an
    address.

    Raises:
        SettingsError: only one arm has an address, or no driver takes torques for these arms.
    """
    addresses = [robot.driver.address for robot in workcell.robots]
    if not any(addresses):
        return "simulation"
    if not all(addresses):
        raise SettingsError(
            "only one of both arms has an address: give [robots.driver] of the other one too, or "
            "of none for a simulator",
            code="one-address",
        )
    for driver, maker, axes in (("franka", FRANKA, SEVEN), ("ur", UR, SIX)):
        try:
            require_arms(workcell, "torque", maker, (axes,))
        except SettingsError:
            continue
        return driver
    raise SettingsError(
        "no driver takes torques for these arms: Franka's and Universal Robots' do, a simulator "
        "(leave out the addresses) does for all; ABB's arms are driven by abb-egm",
        code="no-driver",
    )


def require_torque(job: Job) -> None:
    """Check, for Franka arms, that the joints have the names that franka_ros2 uses, and that
    prefixes end with '_'. Other arms always pass.

    Raises:
        SettingsError: a name or a prefix is wrong, or no driver takes torques for these arms.
    """
    if driver_of(job.workcell) != "franka":
        return
    for robot, joints in zip(job.workcell.robots, job.joint_names, strict=True):
        if _franka_type(joints) not in FRANKA_TYPES:
            raise SettingsError(
                f"the joints of {robot.name!r} are called {joints[0]!r} ... {joints[-1]!r}; "
                f"franka_ros2 knows TYPE_joint1 to TYPE_joint7 of {', '.join(FRANKA_TYPES)} (a "
                "Panda is 'fer'): use franka_description's file of the arm",
                code="joint-names",
            )
        if robot.driver.prefix and not robot.driver.prefix.endswith("_"):
            raise SettingsError(
                f"the prefix {robot.driver.prefix!r} of {robot.name!r} has to end with '_': "
                "franka_description puts one behind it",
                code="prefix",
            )


def joint_stiffness(job: Job) -> Array:
    """Return the proportional gains (joints,) with which the controllers hold the joints, both arms
    side by side [N m/rad, for sliding joints N/m].

    They follow from torque limits and inertias of the joints.
    """
    largest = job.workcell.stack_joint_limits("torque_max")
    return np.minimum(GAIN * largest, FASTEST**2 * joint_inertia(job))


def pad_stiffness(job: Job) -> float:
    """Compute the stiffness of each arm at its pad along the contact normal, as it follows from the
    joint gains [N/m]. The result is the largest value along the job.

    With normal n, pad Jacobian J and gains K, an arm's compliance is c = n' J K^-1 J' n. Both arms
    act in series, so the stiffness is 2 / (c_1 + c_2).
    """
    gains, compliance = joint_stiffness(job), np.array([0.0])
    first = len(job.joint_names[0])
    for arm, robot in enumerate(job.workcell.robots):
        span = slice(0, first) if arm == 0 else slice(first, None)
        q = np.concatenate([phase.motion.q[::MODEL_STRIDE, span] for phase in job.held])
        along = robot.T_flange_pad[:3, 2] @ pad_jacobians(job.workcell, arm, q)[:, :3]
        compliance = compliance + (along**2 / gains[span]).sum(axis=1)
    return float(2.0 / compliance.min())


def torque_files(export: Export) -> dict[str, str | bytes]:
    """Return the files of the target `torque` by path: programs, controllers, and
    `config/cell.json` with the settings of the driver.

    Raises:
        SettingsError: a torque changes faster than libfranka accepts.
    """
    driver, begin = driver_of(export.workcell), 0
    config: dict[str, Any] = {}
    files: dict[str, str | bytes] = {}
    if driver == "simulation":
        files["description/cell.urdf"] = description(export.workcell, export.sampled.q[0])
        known = [("", ros_joints(export.workcell), dict[str, Any]())]
    else:
        known, make = [], _franka if driver == "franka" else _ur
        for arm in (0, 1):
            joints = {name: begin + k for k, name in enumerate(export.ros_joints(arm))}
            begin += len(joints)
            known.append((f"_{arm + 1}", joints, make(export, arm)))
    for number, joints, values in known:
        cell = json.loads(filled(f"cell_{driver}.json", **values))
        broadcasters = cell.pop("broadcasters")
        text = _controllers(export, driver, joints, broadcasters)
        files[f"config/controllers{number}.yaml"] = text
        config = {name: config.get(name, []) + entries for name, entries in cell.items()}
    if export.job.follower is None:
        config["wrench"] = [None, None]
        config["grip"] = [_grip(export, arm) for arm in (0, 1)]
    presses = any(config["wrench"])
    usual = {
        "plan": plan_of(export.workcell, "torque", "run_job.py", (0.0, 0.0), None, presses),
        "simulated": driver == "simulation",
        "lag": export.lag,
        "step": export.step,
    }
    return {
        "config/cell.json": json.dumps(usual | config, indent=1, allow_nan=False) + "\n",
        "job.json": job_text(export),
        **programs("run_job.py"),
        f"launch/{driver}.launch.py": program("cell.launch.py"),
        **files,
    }


def _grip(export: Export, arm: int) -> dict[str, Any]:
    """Describe how the hands of an arm are switched and watched in ROS.

    Returns:
        A dictionary. `name` and `kind` are name and type of the service that switches the hands,
        `on` and `off` the fields of the two requests. `input` has the `topic`, its message type
        `kind` and the `pin` with which the hands report that they hold; it is None if they report
        nothing.
    """
    driver = export.workcell.robots[arm].driver
    io = f"/{_values(export, arm)['space']}/io_and_status_controller"
    if driver.grip_output.isdecimal():
        set_io = {"fun": 1, "pin": int(driver.grip_output)}
        requests = {"on": set_io | {"state": 1.0}, "off": set_io | {"state": 0.0}}
        output = {"name": f"{io}/set_io", "kind": "ur_msgs/srv/SetIO", **requests}
    else:
        requests = {"on": {"data": True}, "off": {"data": False}}
        output = {"name": driver.grip_output, "kind": "std_srvs/srv/SetBool", **requests}
    source: dict[str, Any] | None = None
    if driver.grip_input.isdecimal():
        kind, pin = "ur_msgs/msg/IOStates", int(driver.grip_input)
        source = {"topic": f"{io}/io_states", "kind": kind, "pin": pin}
    elif driver.grip_input:
        source = {"topic": driver.grip_input, "kind": "std_msgs/msg/Bool", "pin": None}
    return output | {"input": source}


def _controllers(
    export: Export,
    driver: str,
    joints: Mapping[str, int],
    broadcasters: Mapping[str, Mapping[str, Any]],
) -> str:
    """Build the parameters of a controller manager and its controllers as JSON, which is valid
    YAML.

    Args:
        export: the job.
        driver: name of the driver.
        joints: index of each joint of the manager among the joints of both arms, by name in ROS.
        broadcasters: parameters of each further controller, by its name. Their key `type` goes to
            the manager.
    """
    cell = export.workcell
    rates = [robot.driver.rate for robot in cell.robots if robot.driver.rate is not None]
    stiffness, inertia = joint_stiffness(export.job), joint_inertia(export.job)
    damping = 2.0 * DAMPING * np.sqrt(stiffness * inertia)
    gains = {n: {"p": float(stiffness[k]), "d": float(damping[k])} for n, k in joints.items()}
    carry = {
        "type": "joint_trajectory_controller/JointTrajectoryController",
        "joints": list(joints),
        "command_interfaces": ["effort"],
        "state_interfaces": ["position", "velocity"],
        "interpolate_from_desired_state": True,
        "allow_nonzero_velocity_at_trajectory_end": False,
        "action_monitor_rate": 100.0,
        # It never gives up by itself: what it holds then presses with no effort. run_job.py
        # monitors the arms.
        "constraints": {"stopped_velocity_tolerance": 0.0, "goal_time": 0.0},
        "gains": gains,
    }
    states = {"type": "joint_state_broadcaster/JointStateBroadcaster"}
    known = {"joint_state_broadcaster": states, **broadcasters, CONTROLLER: carry}
    manager: dict[str, Any] = {n: {"type": values["type"]} for n, values in known.items()}
    manager["update_rate"] = round(min(rates, default=RATES[driver]))
    found: dict[str, Any] = {"controller_manager": {"ros__parameters": manager}}
    for name, values in known.items():
        own = {key: value for key, value in values.items() if key != "type"}
        found |= {name: {"ros__parameters": own}} if own else {}
    return json.dumps({"/**": found}, indent=1, allow_nan=False) + "\n"


def joint_inertia(job: Job) -> Array:
    """Compute the mean inertia (joints,) about each joint over a job, without the payload [kg m^2,
    for sliding joints kg].

    These are the diagonal entries of the inertia matrices of both arms, side by side.
    """
    found, begin = [], 0
    for robot, joints in zip(job.workcell.robots, job.joint_names, strict=True):
        model = build_robot_model(robot).model
        data, span = model.createData(), slice(begin, begin + len(joints))
        q = np.concatenate([phase.motion.q[::MODEL_STRIDE, span] for phase in job.phases])
        found.append(np.mean([np.diag(pin.crba(model, data, row)) for row in q], axis=0))
        begin += len(joints)
    return np.concatenate(found)


def _values(export: Export, arm: int) -> dict[str, Any]:
    """Return the values of the placeholders that are common to the templates of all makers, by
    name."""
    robot, prefix = export.workcell.robots[arm], prefixes(export.workcell)[arm]
    mass, centre = export.tool_load(arm)
    spaces = [prefix.rstrip("_") for prefix in prefixes(export.workcell)]
    if not all(spaces) or spaces[0] == spaces[1]:
        spaces = ["arm_1", "arm_2"]
    return {
        "arm": arm,
        "number": arm + 1,
        "space": spaces[arm],
        "prefix": prefix,
        "address": json.dumps(robot.driver.address),
        "axis": robot.T_flange_pad[:3, 2].tolist(),
        "mass": mass,
        "centre": centre.tolist(),
        "centre_of_gravity": json.dumps(dict(zip("xyz", centre.tolist(), strict=True))),
    }


def _franka(export: Export, arm: int) -> dict[str, Any]:
    """Return the values of the placeholders in a Franka arm's template, by name.

    Raises:
        SettingsError: a torque changes faster than libfranka accepts.
    """
    rate = np.abs(np.diff(export.effort - export.gravity, axis=0))
    rate /= np.diff(export.sampled.time)[:, None]
    if rate.max() > TORQUE_RATE:
        raise SettingsError(
            f"a joint torque changes by {rate.max():.0f} N m/s; libfranka takes "
            f"{TORQUE_RATE:.0f}: limit the jerk (jerk_max), or choose a slower timing"
        )
    load = export.workcell.robots[arm].tool_load
    inertia = np.zeros((3, 3)) if load is None else load.inertia
    torque, (force, moment) = _contact(export.job, arm)
    most = {
        "torque": (CONTACT * torque + SPARE_TORQUE).tolist(),
        "force": [CONTACT * force + SPARE_FORCE] * 3 + [CONTACT * moment + SPARE_TORQUE] * 3,
    }
    thresholds = {
        f"{end}_{what}_thresholds_{when}": most[what]
        for when in ("acceleration", "nominal")
        for what in ("torque", "force")
        for end in ("lower", "upper")
    }
    values = _values(export, arm)
    return values | {
        "kind": _franka_type(export.job.joint_names[arm]),
        "prefix": values["prefix"].removesuffix("_"),
        "inertia": inertia.T.ravel().tolist(),
        "thresholds": json.dumps(thresholds),
    }


def _franka_type(joints: Sequence[str]) -> str:
    """Return TYPE if an arm's joints are called TYPE_joint1 to TYPE_joint7, else ''."""
    kind = joints[0].removesuffix("_joint1")
    return kind if list(joints) == [f"{kind}_joint{k}" for k in range(1, 8)] else ""


def _contact(job: Job, arm: int) -> tuple[Array, tuple[float, float]]:
    """Compute the largest load of an arm by its contact with the box.

    Returns:
        - Largest torque (n_joints,) of each joint [N m, for sliding joints N].
        - Largest force [N] and largest moment [N m] at the pad.
    """
    first = len(job.joint_names[0])
    span = slice(0, first) if arm == 0 else slice(first, None)
    torque = [np.abs(p.motion.contact_effort(p.force.wrench)[:, span]).max(0) for p in job.phases]
    wrench = np.concatenate([phase.force.wrench[:, arm] for phase in job.phases])
    size = [float(np.linalg.norm(part, axis=1).max()) for part in (wrench[:, :3], wrench[:, 3:])]
    return np.max(torque, axis=0), (size[0], size[1])


def _ur(export: Export, arm: int) -> dict[str, Any]:
    """Return the values of the placeholders in a UR arm's template, by name."""
    found = re.search(UR_TYPE, described(export.workcell.robots[arm]))
    return _values(export, arm) | {"kind": found.group() if found else "ur10e"}
