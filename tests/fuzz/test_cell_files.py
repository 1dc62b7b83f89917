"""Damaged workcell files, URDFs and meshes: read soundly or refused, never anything else."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from symbolic.geometry.meshes import CollisionModelWarning, convex_pieces
from symbolic.geometry.pairs import build_geometry
from symbolic.robot.urdf import arm_model
from symbolic.workcell.file import load
from symbolic.workcell.records import Workcell
from tests.fuzz.damage import Bytes, Tree, byte_damage, tree_damage, xml_damage
from tests.fuzz.promises import kept
from tests.symbolic.workcell.samples import GOFA, RACK, sample_data, write

FEW, MANY = 40, 1000
SOUND = RACK.read_bytes().replace(b"../robots/gofa12.urdf", str(GOFA).encode())

quick = settings(max_examples=FEW, suppress_health_check=list(HealthCheck))
thorough = settings(max_examples=MANY, suppress_health_check=list(HealthCheck))


def sound_cell(cell: Workcell) -> None:
    """An accepted cell holds finite numbers, and its geometry is built or refused."""
    assert len(cell.digest) == 64
    assert np.isfinite(cell.task.initial).all()
    for robot in cell.robots:
        model = arm_model(robot)
        q = np.clip(np.zeros(6), robot.position_lower, robot.position_upper)
        torque = pin.rnea(model, model.createData(), q, np.zeros(6), np.zeros(6))
        assert np.isfinite(torque).all()
    kept(lambda: build_geometry(cell), "collision", "link", "tool", "mesh", "bodies", "pieces")


def workcell_text(damaged: Bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.toml"
        path.write_bytes(damaged(SOUND))
        cell = kept(lambda: load(path), str(path))
        if cell is not None:
            sound_cell(cell)


def workcell_tree(damaged: Tree) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), damaged(sample_data()))
        cell = kept(lambda: load(path), str(path))
        if cell is not None:
            sound_cell(cell)


def urdf(damaged: Bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "arm.urdf").write_bytes(damaged(GOFA.read_bytes()))
        data: dict[str, Any] = sample_data()
        for robot in data["robots"]:
            robot["urdf"] = "arm.urdf"
        path = write(Path(folder), data)
        cell = kept(lambda: load(path), str(path))
        if cell is not None:
            sound_cell(cell)


def mesh(kind: str, damaged: Bytes) -> None:
    sound = trimesh.creation.box((0.3, 0.2, 0.1)).export(file_type=kind)
    content = sound.encode() if isinstance(sound, str) else sound
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", CollisionModelWarning)
        path = Path(folder) / f"mesh.{kind.removesuffix('_ascii')}"
        path.write_bytes(damaged(content))
        pieces = kept(lambda: convex_pieces(path, np.ones(3)), str(path))
        for piece in pieces or ():
            assert np.isfinite(piece.vertices).all()


TESTS: dict[str, tuple[Callable[..., None], tuple[st.SearchStrategy[Any], ...]]] = {
    "workcell, bytes": (workcell_text, (byte_damage(),)),
    "workcell, values": (workcell_tree, (tree_damage(),)),
    "urdf, bytes": (urdf, (byte_damage(),)),
    "urdf, elements": (urdf, (xml_damage(),)),
    "mesh": (mesh, (st.sampled_from(["stl", "stl_ascii", "obj", "ply", "off"]), byte_damage())),
}


@pytest.mark.parametrize("kind", TESTS)
def test_damage_is_told(kind: str) -> None:
    check, strategies = TESTS[kind]
    quick(given(*strategies)(check))()


@pytest.mark.slow
@pytest.mark.parametrize("kind", TESTS)
def test_much_damage_is_told(kind: str) -> None:
    check, strategies = TESTS[kind]
    thorough(given(*strategies)(check))()
