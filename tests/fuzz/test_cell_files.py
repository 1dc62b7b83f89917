"""Damaged workcell files, URDFs and meshes: read soundly or refused, never anything else."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from hypothesis import strategies as st

from symbolic.geometry.hulls import CollisionModelWarning, convex_pieces
from symbolic.geometry.pairs import build_geometry
from symbolic.read.arms import arm_model
from symbolic.read.cell import load
from symbolic.read.scenes import read_scene
from symbolic.read.tables import TableReader, read_body
from symbolic.records import Workcell
from symbolic.records.problems import Problems
from tests.fuzz.damage import (
    MANY,
    Bytes,
    Checks,
    Tree,
    all_kept,
    byte_damage,
    kept,
    tree_damage,
    xml_damage,
)
from tests.symbolic.read.samples import GOFA, RACK, sample_data, write
from tests.symbolic.read.test_scenes import FRAMES, MESSAGE, NEW, SAVED, sdf

FEW, FEW_PROCESSES = 20, 4
SOUND = RACK.read_bytes().replace(b"../robots/gofa12.urdf", str(GOFA).encode())

XACRO_NAMESPACE = "http://www.ros.org/wiki/xacro"
ElementTree.register_namespace("xacro", XACRO_NAMESPACE)
INCLUDED = f"""<robot xmlns:xacro="{XACRO_NAMESPACE}">
<xacro:arg name="tool" default="tool"/><xacro:property name="mass" value="2.5"/>
<xacro:macro name="part" params="name size:='0.1 0.1 ${{mass / 10}}' *at"><link name="${{name}}">
<inertial><mass value="${{mass}}"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>
</inertial><collision><xacro:insert_block name="at"/><geometry><box size="${{size}}"/></geometry>
</collision></link></xacro:macro></robot>"""
XACRO = GOFA.read_text().replace(
    "</robot>",
    """<xacro:include filename="parts.xacro"/><xacro:if value="${mass > 1}"><xacro:part
    name="$(arg tool)"><origin xyz="0 0 ${mass / 10}"/></xacro:part></xacro:if><joint name="j"
    type="fixed"><parent link="tool0"/><child link="$(arg tool)"/></joint></robot>""",
)
XACRO = XACRO.replace("<robot ", f'<robot xmlns:xacro="{XACRO_NAMESPACE}" ')
SRDF = b"""<?xml version="1.0"?><robot name="gofa"><group name="arm"><chain base_link="base_link"
tip_link="tool0"/></group><group_state name="home" group="arm"><joint name="joint_1" value="0"/>
</group_state><disable_collisions link1="link_1" link2="link_3" reason="Never"/>
<disable_collisions link1="link_2" link2="link_4" reason="Never"/></robot>"""


_SPEC = mujoco.MjSpec.from_file(str(GOFA))
_SPEC.compiler.fusestatic = False
_SPEC.compile()
MJCF = _SPEC.to_xml().encode()


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


def judged(folder: Path, content: bytes) -> None:
    """A workcell file of this content: a sound cell, or refused."""
    path = folder / "cell.toml"
    path.write_bytes(content)
    cell = kept(lambda: load(path), str(path))
    if cell is not None:
        sound_cell(cell)


def workcell(damaged: Bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        judged(Path(folder), damaged(SOUND))


def values(damaged: Tree) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), damaged(sample_data()))
        judged(Path(folder), path.read_bytes())


FILES: dict[str, tuple[bytes, dict[str, Any]]] = {
    "arm.urdf": (GOFA.read_bytes(), {"urdf": "arm.urdf"}),
    "arm.xacro": (XACRO.encode(), {"urdf": "arm.xacro"}),
    "parts.xacro": (INCLUDED.encode(), {"urdf": "arm.xacro"}),
    "arm.srdf": (SRDF, {"srdf": "arm.srdf"}),
    "arm.xml": (MJCF, {"urdf": "arm.xml", "velocity_max": 2.0}),
}
"""What a cell names, and how: URDFs are those of both robots, an SRDF of the first."""


def description(name: str, damaged: Bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for each, (content, _) in FILES.items():
            (Path(folder) / each).write_bytes(damaged(content) if each == name else content)
        data: dict[str, Any] = sample_data()
        _, named = FILES[name]
        for robot in data["robots"] if "urdf" in named else data["robots"][:1]:
            robot |= named
        judged(Path(folder), write(Path(folder), data).read_bytes())


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


def scene(kind: str, damaged: Bytes) -> None:
    """Bodies of a scene that is accepted are those of an environment."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene.{kind}"
        path.write_bytes(damaged(SCENES[kind].encode()))
        found = kept(lambda: read_scene(path), path.name)
        tables = found.tables(Path(folder), Path(folder)) if found else ()
        for name, content in found.files.items() if found else ():
            (Path(folder) / name).write_bytes(content)
        for table in tables:
            problems = Problems()
            read_body(TableReader(table, "", problems), Path(folder))
            assert problems.found == []


SCENES = {"sdf": sdf(FRAMES), "yaml": MESSAGE, "scene": SAVED.format(**NEW)}

EXPANDED = st.sampled_from(["arm.xacro", "parts.xacro"])
TESTS: Checks = {
    "workcell, bytes": (workcell, (byte_damage(),)),
    "workcell, values": (values, (tree_damage(),)),
    "urdf, bytes": (description, (st.just("arm.urdf"), byte_damage())),
    "urdf, elements": (description, (st.just("arm.urdf"), xml_damage())),
    "xacro, bytes": (description, (EXPANDED, byte_damage())),
    "xacro, elements": (description, (EXPANDED, xml_damage())),
    "mjcf, bytes": (description, (st.just("arm.xml"), byte_damage())),
    "mjcf, elements": (description, (st.just("arm.xml"), xml_damage())),
    "srdf, bytes": (description, (st.just("arm.srdf"), byte_damage())),
    "srdf, elements": (description, (st.just("arm.srdf"), xml_damage())),
    "scene, bytes": (scene, (st.sampled_from([*SCENES]), byte_damage())),
    "scene, elements": (scene, (st.just("sdf"), xml_damage())),
    "mesh": (mesh, (st.sampled_from(["stl", "stl_ascii", "obj", "ply", "off"]), byte_damage())),
}


@pytest.mark.parametrize("name", FILES)
def test_what_is_damaged_is_sound_at_first(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Workcell] = []
    monkeypatch.setattr("tests.fuzz.test_cell_files.sound_cell", seen.append)
    description(name, lambda content: content)
    assert len(seen) == 1


@pytest.mark.parametrize("many", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", TESTS)
def test_damage_is_told(kind: str, many: bool) -> None:
    few = FEW_PROCESSES if kind.startswith("xacro") else FEW
    all_kept(TESTS, kind, MANY if many else few)
