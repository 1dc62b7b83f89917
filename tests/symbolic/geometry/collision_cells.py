"""Cells, configurations and an independent placement of bodies for the collision tests."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import trimesh

from symbolic.array import Array
from symbolic.geometry.clearance import screening_functions
from symbolic.geometry.expressions import EXACT, Softness
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.geometry.pieces import Piece
from symbolic.geometry.separation import coal_distance
from symbolic.read.cell import changed_text, load
from symbolic.records import Body, Box, Cylinder, Mesh, Robot, Sphere, Workcell
from symbolic.records.poses import pose_matrix
from symbolic.robot.model import RobotModel, build_robot_model
from tests.machines import ur10_urdf
from tests.symbolic.read.samples import GOFA, SAMPLE

Configurations = tuple[Array, Array, Array]


@cache
def rack() -> Workcell:
    """The sample cell, its tools twice as long: a rack with two GoFa 12, which nobody tunes."""
    changes = {
        "robots.urdf": str(GOFA),
        "robots.pad.xyz": [0.0, 0.0, 0.2],
        "robots.tool.length": 0.2,
        "robots.tool.xyz": [0.0, 0.0, 0.1],
    }
    return load(SAMPLE, text=changed_text(SAMPLE.read_bytes(), changes, SAMPLE.name))


def obstacle_cell(folder: Path) -> Workcell:
    """Turned bases and one obstacle of every shape, a hollow mesh included."""
    folder.mkdir(parents=True, exist_ok=True)
    hollow = folder / "angle.stl"
    shelf = trimesh.creation.box((0.3, 0.3, 0.02))
    wall = trimesh.creation.box((0.02, 0.3, 0.3))
    wall.vertices = wall.vertices + np.array([0.16, 0.0, 0.14])
    mesh = trimesh.util.concatenate([shelf, wall])
    hollow.write_bytes(trimesh.exchange.stl.export_stl(mesh))
    turned = pose_matrix([0.55, 0.1, 0.5], [0.3, 0.2, 0.7])
    environment = (
        Body("ground", Box(np.array([4.0, 4.0, 0.1])), pose_matrix([0, 0, -0.05], [0, 0, 0])),
        Body("turned box", Box(np.array([0.3, 0.2, 0.5])), turned),
        Body("post", Cylinder(0.06, 1.2), pose_matrix([-0.3, 0.3, 0.6], [0.1, 0, 0])),
        Body("ball", Sphere(0.15), pose_matrix([0.2, -0.3, 0.7], [0, 0, 0])),
        Body("angle", Mesh(hollow, np.ones(3)), pose_matrix([-0.5, -0.2, 0.4], [0, 0, 0.4])),
    )
    cell = rack()
    bases = (
        pose_matrix([0.5, 0.85, 0.0], [0, 0, -2.2]),
        pose_matrix([-0.5, -0.85, 0.0], [0, 0, 0.9]),
    )
    first, second = (
        replace(robot, T_world_base=base) for robot, base in zip(cell.robots, bases, strict=True)
    )
    return replace(cell, robots=(first, second), environment=environment)


def ur10_cell() -> Workcell:
    """The rack with two UR10, whose links are meshes."""
    cell = rack()
    packages = (ur10_urdf().parents[4],)
    limit = np.full(6, 2.0 * np.pi)
    first, second = (
        replace(
            robot,
            urdf=ur10_urdf(),
            package_dirs=packages,
            flange="tool0",
            position_lower=-limit,
            position_upper=limit,
        )
        for robot in cell.robots
    )
    return replace(cell, robots=(first, second))


@cache
def geometry_of(name: str, folder: Path = Path()) -> CellGeometry:
    """The geometry of 'rack', 'obstacles' or 'ur10', built once per session."""
    match name:
        case "rack":
            cell = rack()
        case "obstacles":
            cell = obstacle_cell(folder)
        case _:
            cell = ur10_cell()
    return build_geometry(cell)


def functions_of(geometry: CellGeometry, softness: Softness = EXACT) -> dict[str, ca.Function]:
    """The collision functions of a geometry."""
    first, second = (model_of(robot).joint_placements for robot in geometry.workcell.robots)
    return screening_functions(geometry, (first, second), softness)


def model_of(robot: Robot) -> RobotModel:
    """The kinematics of an arm, which its base does not change."""
    known = robot.urdf, robot.chain_root, robot.flange, robot.locked_joints
    if known not in _MODELS:
        _MODELS[known] = build_robot_model(robot)
    return _MODELS[known]


_MODELS: dict[tuple[Hashable, ...], RobotModel] = {}


def whole_geometry_of(name: str, folder: Path = Path()) -> CellGeometry:
    """The same where every possible pair is active, all in one block."""
    found = geometry_of(name, folder)
    return replace(found, active=found.possible, near=len(found.possible))


def random_configurations(
    geometry: CellGeometry, n: int, rng: np.random.Generator
) -> Configurations:
    """Box poses in the cell's middle and joint positions all over the limits, all unrelated."""
    centre = np.array([-0.2, 0.0, 0.8, 0.0, 0.0, 0.0])
    half = np.array([0.5, 0.3, 0.5, 1.0, 1.0, np.pi])
    first, second = (
        rng.uniform(np.fmax(arm.lower, -np.pi), np.fmin(arm.upper, np.pi), (n, 6))
        for arm in geometry.arms
    )
    return rng.uniform(centre - half, centre + half, (n, 6)), first, second


def placed_pieces(
    geometry: CellGeometry, pose: Array, q_1: Array, q_2: Array
) -> list[tuple[Piece, ...]]:
    """The pieces of every body in the world, by numeric Pinocchio, of one configuration."""
    placements = []
    for robot, q in zip(geometry.workcell.robots, (q_1, q_2), strict=True):
        model = model_of(robot).model
        data = model.createData()
        pin.forwardKinematics(model, data, q)
        placements.append([robot.T_world_base @ data.oMi[j].homogeneous for j in range(1, 7)])
    found = []
    for body in geometry.bodies:
        match body.frame.kind:
            case "world":
                T = np.eye(4)
            case "box":
                T = pose_matrix(pose[:3], pose[3:])
            case "link":
                T = placements[body.frame.robot][body.frame.joint]
        found.append(tuple(piece.moved(T) for piece in body.pieces))
    return found


def true_distances(geometry: CellGeometry, pose: Array, q_1: Array, q_2: Array) -> Array:
    """(n_pairs,) Coal's distance of every active pair in one configuration; negative: overlap."""
    pieces = placed_pieces(geometry, pose, q_1, q_2)
    return np.array(
        [coal_distance(pieces[pair.first], pieces[pair.second]) for pair in geometry.active]
    )
