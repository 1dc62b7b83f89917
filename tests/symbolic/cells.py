"""Small workcells written by hand, for tests of laws that need odd parameters.

None of them comes from a file, so that tuning the rack cell changes no test of physics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from studies.research.plain.arm import PlainArm
from symbolic.array import Array
from symbolic.cell_model import CellModel, build_cell_model
from symbolic.functions import candidate_function
from symbolic.geometry.pairs import build_geometry
from symbolic.read.cell import load
from symbolic.records import Contact, Payload, Robot, Task, Waypoint, Workcell
from symbolic.records.poses import pose_matrix
from symbolic.robot.model import RobotModel, build_robot_model

ROOT = Path(__file__).resolve().parents[2]
GOFA = ROOT / "studies" / "robots" / "gofa12.urdf"
RACK = ROOT / "studies" / "workcells" / "rack.toml"


def standing_text(path: Path = RACK) -> str:
    """The text of a shipped cell's file, which may stand in any folder."""
    return path.read_text("utf-8").replace("../robots", str(path.parents[1] / "robots"))


SEEDS = ((3.14, -1.6, 0.4, 0.0, -1.9, 0.0), (-3.14, -1.6, 0.4, 0.0, -1.9, 0.0))
"""Rough postures of the two arms from which Newton's method finds the hand cell's start."""


def fixed(pose: ArrayLike) -> Waypoint:
    """A waypoint that the task fixes."""
    value = np.asarray(pose, dtype=float)
    return Waypoint(value, value)


def free(centre: ArrayLike, half_width: ArrayLike) -> Waypoint:
    """A free waypoint, its bounds around a centre."""
    middle, half = np.asarray(centre, dtype=float), np.asarray(half_width, dtype=float)
    return Waypoint(middle - half, middle + half)


def hand_cell() -> Workcell:
    """Two GoFa 12 and a box between them that is rotated by half a turn onto itself.

    The cell looks the same after half a turn about z with the robots exchanged.
    """
    quarter = np.pi / 2.0
    T_box_pads = [
        pose_matrix([0, 0.2, 0], [quarter, 0, 0]),
        pose_matrix([0, -0.2, 0], [quarter, 0, np.pi]),
    ]
    bases = [
        pose_matrix([0, 1.05, 0], [0, 0, -quarter]),
        pose_matrix([0, -1.05, 0], [0, 0, quarter]),
    ]
    half = [0.1, 0.05, 0.1, 0.12, 0.12, 0.12]
    centres = [[-0.40, 0.0, 0.77], [-0.52, 0.0, 0.95], [-0.40, 0.0, 1.19]]
    waypoints = (
        fixed([0.0, 0.0, 0.745, 0.0, 0.0, 0.0]),
        *(free([*centre, 0.0, 0.0, 0.0], half) for centre in centres),
        fixed([0.0, 0.0, 1.145, 0.0, 0.0, 0.0]),
    )
    return Workcell(
        name="hand-written cell",
        robots=(gofa("first", bases[0]), gofa("second", bases[1])),
        payload=Payload(
            size=np.array([0.3, 0.4, 0.25]),
            mass=10.0,
            centre_of_mass=np.zeros(3),
            inertia=solid_box(10.0, [0.3, 0.4, 0.25]),
        ),
        contacts=(Contact(T_box_pads[0], 1.0, 0.0315), Contact(T_box_pads[1], 1.0, 0.0315)),
        task=Task(
            waypoints=waypoints,
            samples=60,
            reference_speed=0.25,
            reference_force=np.array([117.68, 117.68]),
            initial=np.array([[*centre, 0.0, 0.0, 0.0] for centre in centres]),
        ),
        environment=(),
    )


def gofa(name: str, T_world_base: Array) -> Robot:
    """A GoFa 12 with its pad 0.1 m in front of the flange."""
    return Robot(
        name=name,
        urdf=GOFA,
        package_dirs=(),
        flange="tool0",
        locked_joints=(),
        T_world_base=T_world_base,
        T_flange_pad=pose_matrix([0.0, 0.0, 0.1], [0.0, 0.0, 0.0]),
        tool=(),
        position_lower=np.deg2rad([-270.0, -180.0, -225.0, -180.0, -180.0, -270.0]),
        position_upper=np.deg2rad([270.0, 180.0, 85.0, 180.0, 180.0, 270.0]),
        velocity_max=np.deg2rad([120.0, 120.0, 125.0, 200.0, 200.0, 200.0]),
        acceleration_max=np.full(6, 5.0),
        torque_max=np.array([390.0, 400.0, 160.0, 60.0, 60.0, 60.0]),
        min_manipulability=0.005,
    )


def solid_box(mass: float, size: ArrayLike) -> Array:
    """Inertia (3, 3) of a uniform cuboid about its centre [kg m^2]."""
    a, b, c = np.asarray(size, dtype=float) ** 2
    return mass / 12.0 * np.diag([b + c, a + c, a + b])


def with_payload(cell: Workcell, **changes: Any) -> Workcell:
    """The cell with other values of its payload."""
    return replace(cell, payload=replace(cell.payload, **changes))


def with_task(cell: Workcell, **changes: Any) -> Workcell:
    """The cell with other values of its task."""
    return replace(cell, task=replace(cell.task, **changes))


def with_contacts(
    cell: Workcell,
    friction: tuple[float, float] | None = None,
    patch_radius: tuple[float, float] | None = None,
) -> Workcell:
    """The cell with other friction coefficients or patch radii."""
    first, second = (
        replace(
            contact,
            friction=friction[i] if friction else contact.friction,
            patch_radius=patch_radius[i] if patch_radius else contact.patch_radius,
        )
        for i, contact in enumerate(cell.contacts)
    )
    return replace(cell, contacts=(first, second))


def start_posture(
    cell: Workcell, seeds: tuple[ArrayLike, ArrayLike] = SEEDS
) -> tuple[Array, Array]:
    """Joints (6,) of both arms that hold the box at the first waypoint, near the seeds."""
    postures = []
    for robot, contact, seed in zip(cell.robots, cell.contacts, seeds, strict=True):
        arm = PlainArm(robot, contact, orientation=cell.task.orientation)
        target = arm.flange_target(cell.task.waypoints[0].lower)
        q = np.asarray(seed, dtype=float)
        for _ in range(30):
            q = arm.newton_step(q, target)
        assert arm.residual(q, target) < 1e-12, "the seed does not lead to the start pose"
        postures.append(q)
    return postures[0], postures[1]


@cache
def gofa_model() -> RobotModel:
    """The GoFa 12's symbolic model; all hand-written cells share it."""
    return build_robot_model(gofa("gofa", np.eye(4)))


def hand_model(cell: Workcell) -> CellModel:
    """A hand-written cell with its start postures, found without the branch search."""
    model = replace(gofa_model(), orientation=cell.task.orientation)
    return CellModel(
        workcell=cell,
        robots=(model, model),
        geometry=build_geometry(cell),
        branches=((), ()),
        start=start_posture(cell),
    )


@cache
def rack_cell() -> Workcell:
    """The rack cell as it is shipped."""
    return load(RACK)


@cache
def rack_model() -> CellModel:
    """The symbolic model of it, with the start postures that are found."""
    return build_cell_model(rack_cell())


Evaluator = Callable[[Array], dict[str, Array]]


def interpreted(model: CellModel) -> Evaluator:
    """The symbolic evaluator of a cell, called with NumPy arrays: x (n_var,) to named outputs."""
    function = candidate_function(model)
    return lambda x: call(function, x)


def call(function: ca.Function, *inputs: ArrayLike) -> dict[str, Array]:
    """Named outputs of a CasADi function as (samples, dim), single rows and columns as (n,)."""
    results = function.call([ca.DM(np.asarray(value, dtype=float).T) for value in inputs])
    named = zip(function.name_out(), results, strict=True)
    return {name: _dense(value) for name, value in named}


def _dense(value: ca.DM) -> Array:
    array = np.array(value.full().T)
    return array.reshape(-1) if 1 in array.shape else array


def random_candidates(
    task: Task, count: int, rng: np.random.Generator, widen: float = 1.0
) -> Array:
    """Decision vectors (count, n_var), uniform within the bounds, these widened by a factor."""
    middle, half = (task.lower + task.upper) / 2.0, (task.upper - task.lower) / 2.0
    return middle + widen * half * rng.uniform(-1.0, 1.0, (count, task.n_var))
