"""Runs of a cell with a known truth: a box held by two wrists, worked out by balances of its own.

It shares nothing with what estimates but the cell's description: forces of least norm that balance
the weight at a given squeeze, told about the pads with offset, crosstalk and noise. Arms are placed
by the plain reference's kinematics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hybrid_opt.extras.calibrating.recording import Labels, Recording
from studies.research.plain.arm import PlainArm
from symbolic.array import Array
from symbolic.read.cell import load
from tests.symbolic.cells import RACK

CELL = load(RACK)
PLACE = np.array([-0.45, 0.0, 0.90])
HOLD, BETWEEN, FREE = 2.0, 0.6, 1.0
"""Seconds of a hold, between two, and before the first."""

RATE = 50.0


@dataclass(frozen=True)
class Truth:
    """What the generator knows: crosstalk into what is the vertical while the box is level."""

    mass: float = 4.4
    centre: tuple[float, float, float] = (0.010, -0.005, 0.015)
    crosstalk: tuple[float, float] = (0.065, 0.070)
    force_noise: float = 1.0
    moment_noise: float = 0.1
    lag: float = 0.1


TILT = np.radians(14.0)
LEVEL = ((0.0, 0.0),)
TILTED = ((0.0, 0.0), (TILT, 0.0), (-TILT, 0.0), (0.0, TILT), (0.0, -TILT))
SQUEEZES = (50.0, 75.0, 100.0)


@cache
def posture(arm: int, roll: float, pitch: float) -> Array:
    """Joints that put an arm's pad on the box."""
    plain = PlainArm(CELL.robots[arm], CELL.contacts[arm])
    target = plain.flange_target(np.array([*PLACE, roll, pitch, 0.0])).homogeneous
    rng = np.random.default_rng(7)
    near = None if (roll, pitch) == (0.0, 0.0) else posture(arm, 0.0, 0.0)

    def error(q: Array) -> Array:
        place = plain.place(q).homogeneous
        turn = Rotation.from_matrix(place[:3, :3].T @ target[:3, :3]).as_rotvec()
        return np.concatenate([place[:3, 3] - target[:3, 3], turn])

    for _ in range(200):
        begin = rng.uniform(-2.5, 2.5, plain.model.nq) if near is None else near
        found = least_squares(error, begin, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        if np.abs(found.fun).max() < 1e-7:
            return np.asarray(found.x)
    raise AssertionError("the arm does not reach the box")


def readings(truth: Truth, roll: float, pitch: float, squeeze: float) -> Array:
    """(2, 6) that acts on the arms, about the pads and along their axes, without noise."""
    turned = Rotation.from_euler("xyz", [roll, pitch, 0.0]).as_matrix()
    weight = turned.T @ [0.0, 0.0, -9.81 * truth.mass]
    balance, right = np.zeros((7, 12)), np.zeros(7)
    right[:3], right[3:6] = -weight, -np.cross(truth.centre, weight)
    for i, contact in enumerate(CELL.contacts):
        x, y, z = contact.T_box_pad[:3, 3]
        part = balance[:, 6 * i : 6 * i + 6]
        part[:3, :3] = part[3:6, 3:] = np.eye(3)
        part[3:6, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    balance[6, 6:9], right[6] = CELL.contacts[1].T_box_pad[:3, 2], squeeze
    both = -np.linalg.lstsq(balance, right)[0].reshape(2, 2, 3)
    found = np.empty((2, 6))
    for i, contact in enumerate(CELL.contacts):
        axes = contact.T_box_pad[:3, :3]
        force, moment = axes.T @ both[i, 0], axes.T @ both[i, 1]
        upwards = axes.T @ [0.0, 0.0, 1.0]
        force = force - truth.crosstalk[i] * force[2] * upwards
        found[i] = [*force, *moment]
    return found


def run(
    seed: int,
    orientations: Sequence[tuple[float, float]] = TILTED,
    squeezes: Sequence[float] = SQUEEZES,
    truth: Truth | None = None,
    name: str = "run.csv",
    weighed: float | None = None,
) -> Recording:
    """A run: free, tare, then every orientation at every squeeze."""
    truth = truth or Truth()
    rng = np.random.default_rng(seed)
    cases = [(roll, pitch, force) for roll, pitch in orientations for force in squeezes]
    starts = FREE + BETWEEN + (HOLD + BETWEEN) * np.arange(len(cases))
    time = np.arange(0.0, starts[-1] + HOLD + FREE, 1.0 / RATE)
    corners = np.concatenate([[0.0, FREE], np.column_stack([starts, starts + HOLD]).ravel()])

    def through(values: Array, at: Array) -> Array:
        columns = np.asarray(values, dtype=float).reshape(len(corners), -1).T
        return np.column_stack([np.interp(at, corners, column) for column in columns])

    def knots(values: list[Array], before: Array) -> Array:
        return np.array([before, before, *np.repeat(values, 2, axis=0)])

    joints = []
    for arm in range(2):
        held = [posture(arm, roll, pitch) for roll, pitch, _ in cases]
        joints.append(through(knots(held, held[0]), time))
    noise = [truth.force_noise] * 3 + [truth.moment_noise] * 3
    clean = [readings(truth, *case) for case in cases]
    # The arms follow their force late: labels begin when they are there.
    wrench = through(knots(clean, np.zeros((2, 6))), time - truth.lag).reshape(-1, 2, 6)
    wrench += rng.normal(size=wrench.shape) * noise
    wrench += rng.uniform(-8.0, 8.0, (2, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    asked = [-each[:, 2] for each in clean]
    labels = Labels(
        weighed, False, (0.5,), tuple((s + 2 * truth.lag, s + HOLD) for s in starts.tolist()), ()
    )
    return Recording(
        name=name,
        time=time,
        steps=np.full(2, 1.0 / RATE),
        joints=(joints[0], joints[1]),
        wrench=wrench,
        commanded=through(knots(asked, np.zeros(2)), time),
        lost=(),
        frame="pad",
        largest=np.full(2, np.inf),
        labels=labels,
    )


def side_file(made: Recording, arms: Sequence[str] = ()) -> str:
    """What lies beside a run that `write` wrote."""
    labels = made.labels
    arms = arms or [f'joints = "q{i}_"\nwrench = "w{i}_"\ncommanded = "n{i}"' for i in (1, 2)]
    lines = [
        f'frame = "{made.frame}"',
        f"tare = {list(labels.tare)}",
        f"held = {[list(span) for span in labels.held]}",
        f"slip_at = {list(labels.slip_at)}",
        *([f"mass = {labels.mass}"] if labels.mass is not None else []),
        *(f"[[arms]]\n{arm}" for arm in arms),
    ]
    return "\n".join(lines)


def write(made: Recording, folder: Path) -> Path:
    """A run as CSV with its side file."""
    columns = {"time": made.time}
    for i in range(2):
        columns |= {f"q{i + 1}_{k}": column for k, column in enumerate(made.joints[i].T)}
        columns |= {f"w{i + 1}_{k}": column for k, column in enumerate(made.wrench[:, i].T)}
        columns[f"n{i + 1}"] = made.commanded[:, i]
    path = folder / made.name
    values = np.column_stack(list(columns.values()))
    np.savetxt(path, values, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    path.with_suffix(".toml").write_text(side_file(made))
    return path


def write_bag(made: Recording, folder: Path) -> Path:
    """A run as rosbag2's folder with an MCAP file and a side file; wrenches half a step late."""
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    stamp = kinds["builtin_interfaces/msg/Time"](0, 0)
    header = kinds["std_msgs/msg/Header"](stamp, "")
    vector = kinds["geometry_msgs/msg/Vector3"]
    names = [
        f"{robot.name}_{joint}"
        for robot in CELL.robots
        for joint in PlainArm(robot, CELL.contacts[0]).model.names[1:]
    ]
    none = np.empty(0)
    path = folder / made.name.partition(".")[0]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:

        def channel(topic: str, kind: str) -> Callable[[float, object], None]:
            connection = writer.add_connection(topic, kind, typestore=store)

            def put(time: float, message: object) -> None:
                data = store.serialize_cdr(message, kind)
                writer.write(connection, round(1e9 * (1.7e9 + time)), data)

            return put

        states = channel("/joint_states", "sensor_msgs/msg/JointState")
        felt = [channel(f"/{i}/wrench", "geometry_msgs/msg/WrenchStamped") for i in (1, 2)]
        asked = channel("/2/force", "std_msgs/msg/Float64")
        state = kinds["sensor_msgs/msg/JointState"]
        for k, time in enumerate(made.time.tolist()):
            both = np.concatenate([q[k] for q in made.joints])
            states(time, state(header, names, both, none, none))
            for put, each in zip(felt, made.wrench[k], strict=True):
                parts = [vector(*part) for part in each.reshape(2, 3).tolist()]
                wrench = kinds["geometry_msgs/msg/Wrench"](*parts)
                message = kinds["geometry_msgs/msg/WrenchStamped"](header, wrench)
                put(time + 0.5 / RATE, message)
            asked(time, kinds["std_msgs/msg/Float64"](float(made.commanded[k, 1])))
    arms = ['wrench = "/1/wrench"', 'wrench = "/2/wrench"\ncommanded = "/2/force"']
    path.with_suffix(".toml").write_text(side_file(made, arms))
    return path
